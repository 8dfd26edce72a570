"""What a motion would say about the parameters, tree by tree, from one simulation of all their neighbours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pace_optim.estimate.derivatives import NARROW, stencil
from pace_optim.estimate.error_bars.assessment import Probes, make_probes
from pace_optim.estimate.error_bars.uncertainty import Uncertainty, uncertainty_of
from pace_optim.motion.design.motion_check import MotionFinding, MotionLimits, check_command, check_simulated
from pace_optim.motion.signals import Trajectory
from pace_optim.problem.parameter_space import Colouring
from pace_optim.problem.problem import Problem

ProblemOf = Callable[[Sequence[Trajectory]], Problem]
"""Makes the problem whose recordings follow trajectories; their measured positions do not matter but for the first."""

_MEMORY = 2**28  # bytes of positions kept at once


@dataclass(frozen=True, kw_only=True, eq=False)
class Information:
    """Of one trajectory: for each tree of joints, the two matrices of the error bars' sandwich.

    With J_t the derivatives of tree t's positions by all parameters, and S_t those by its joints' first positions,

        hessian_t = J_tᵀ J_t,    middle_t = J_tᵀ (I + S_t S_tᵀ) J_t

    Both add over trees. White noise of variance σ² in every sample gives the parameters the covariance σ² H⁻¹ M H⁻¹
    (see ``pace_optim.estimate.error_bars.uncertainty``).
    """

    hessian: np.ndarray
    """(trees, size, size), normalised [rad²]."""
    middle: np.ndarray
    """(trees, size, size), normalised [rad²]."""
    findings: tuple[MotionFinding, ...]
    """Where the motion, as commanded or as simulated, leaves a limit."""

    def total(self) -> tuple[np.ndarray, np.ndarray]:
        """H and M of all trees together, each (size, size)."""
        return self.hessian.sum(axis=0), self.middle.sum(axis=0)

    def with_tree(self, t: int, other: Information) -> Information:
        """That of a motion in which tree t moves as in another one; exact, since trees do not move each other."""
        hessian, middle = self.hessian.copy(), self.middle.copy()
        hessian[t], middle[t] = other.hessian[t], other.middle[t]
        return replace(self, hessian=hessian, middle=middle)


def information_of(
    problem_of: ProblemOf, trajectories: Sequence[Trajectory], limits: MotionLimits, x: torch.Tensor
) -> list[Information]:
    """Simulate trajectories with the parameters x and with their neighbours, all in few batches.

    Args:
        x: Where the parameters are expected to be, normalised (size,).
    """
    problem = problem_of(trajectories[:1])
    around = stencil(x, problem.colouring, first=NARROW)
    probes = make_probes(x, around, problem.trees, problem.joint_names)
    steps = around.steps.diagonal()
    at_once = max(1, _MEMORY // (len(probes.vectors) * trajectories[0].des_dof_pos.nbytes))
    result: list[Information] = []
    for start in range(0, len(trajectories), at_once):
        part = trajectories[start : start + at_once]
        result += _simulated(problem_of(part), part, limits, probes, steps)
    return result


def _simulated(
    problem: Problem,
    trajectories: Sequence[Trajectory],
    limits: MotionLimits,
    probes: Probes,
    steps: torch.Tensor,
) -> list[Information]:
    encoder, torque = _positions(problem, probes)
    bias = problem.space.to_physical(probes.vectors[0])[problem.space["encoder_bias"]].numpy()
    index = {name: j for j, name in enumerate(problem.joint_names)}
    trees = [[index[name] for name in tree] for tree in problem.trees]
    result = []
    for r, trajectory in enumerate(trajectories):
        position = encoder[0, :, r].numpy() + bias
        initial = probes.initial(encoder[:, :, r]).derivatives
        derivatives = encoder[1 : 1 + len(problem.colouring.colours), :, r] - encoder[0, :, r]
        blocks = [_block(derivatives, initial, tree, steps, problem.colouring) for tree in trees]
        findings = [
            *check_command(trajectory, limits),
            *check_simulated(trajectory.time, position, torque[1:, r].numpy(), limits),
        ]
        result.append(
            Information(
                hessian=np.stack([hessian for hessian, _ in blocks]),
                middle=np.stack([middle for _, middle in blocks]),
                findings=tuple(findings),
            )
        )
    return result


def _positions(problem: Problem, probes: Probes) -> tuple[torch.Tensor, torch.Tensor]:
    """Encoder positions (m, T, R, n) [rad], and the torques of the first vector that led there (T, R, n) [N m]."""
    data, m, n = problem.dataset, len(probes.vectors), len(problem.joint_names)
    count, steps = data.num_recordings, len(data.command)
    rollout = problem.evaluator().rollout(m)
    physical = problem.space.to_physical(probes.vectors)
    rollout.start(physical, data.sampled, initial_offset=probes.offset)
    bias = physical[:, None, problem.space["encoder_bias"]]
    encoder = torch.zeros(m, steps, count, n, dtype=torch.float64)
    torque = torch.zeros(steps, count, n, dtype=torch.float64)
    for k, (position, _) in enumerate(rollout):
        torch.sub(position.view(m, count, n), bias, out=encoder[:, k])
        torque[k] = rollout.robot.data.applied_torque[:count]
    rollout.env.close()
    return encoder, torque


def _block(
    derivatives: torch.Tensor, initial: torch.Tensor, tree: list[int], step: torch.Tensor, colouring: Colouring
) -> tuple[np.ndarray, np.ndarray]:
    """JᵀJ and Jᵀ(I + SSᵀ)J of one tree's joints.

    Args:
        derivatives: Change of the positions by each colour's step, (colours, T, n) [rad].
        initial: Derivatives by the first positions, (sets, T, n).
        step: Signed step of every entry, (size,).
    """
    size = len(step)
    entries = [entry for entry in range(size) if set(tree) & set(colouring.joints[entry])]
    columns = derivatives[[colouring.row_of[entry] for entry in entries]][..., tree].flatten(1) / step[entries, None]
    first = initial[..., tree].flatten(1)[: len(tree)]  # the i-th set moves this tree's i-th joint
    hessian, effect = columns @ columns.T, columns @ first.T
    at = np.ix_(entries, entries)
    full, middle = np.zeros((size, size)), np.zeros((size, size))
    full[at], middle[at] = hessian.numpy(), (hessian + effect @ effect.T).numpy()
    return full, middle


_UNIFORM = 12.0 / 2.0**2
"""Precision of what is known before: anywhere within the bounds, [-1, 1]."""


def mean_log_error(hessian: np.ndarray, middle: np.ndarray, noise: float, free: np.ndarray) -> float:
    """The criterion: mean over the parameters of log(standard deviation / bound range).

        C = A⁻¹ (M/σ² + P) A⁻¹,   A = H/σ² + P,   criterion = mean_i log(√C_ii / 2)

    in normalised parameters, whose range is 2. P is the precision of a uniform distribution over the bounds (12/range²
    each): it keeps C finite where a motion says nothing. The exponential of the criterion is the geometric mean of the
    error bars as shares of the ranges. Such a mean does not depend on units, as the determinant of D-optimality does
    not, and weighs every parameter's own error bar, as A-optimality does (Atkinson, Donev and Tobias, Optimum
    Experimental Designs, 2007, ch. 10; with a prior: Chaloner and Verdinelli, Statistical Science 10, 1995).

    Args:
        hessian: H, (size, size) [rad²].
        middle: M, (size, size) [rad²].
        noise: σ [rad].
        free: Entries that can vary, (size,) bool.
    """
    at = np.ix_(free, free)
    prior = _UNIFORM * np.eye(int(free.sum()))
    inverse = np.linalg.inv(hessian[at] / noise**2 + prior)
    variance = np.einsum("ij,jk,ki->i", inverse, middle[at] / noise**2 + prior, inverse, optimize=True)
    return float(np.mean(np.log(np.sqrt(variance) / 2)))


def expected_uncertainty(
    problem: Problem, hessian: np.ndarray, middle: np.ndarray, noise: float, x: torch.Tensor
) -> Uncertainty:
    """The error bars that a fit would state.

    Args:
        hessian: H, (size, size) [rad²].
        middle: M, (size, size) [rad²].
        noise: σ, standard deviation of the encoder's white noise [rad].
        x: Where the parameters are expected to be, normalised (size,).
    """
    samples = int(problem.dataset.sampled.sum())
    return uncertainty_of(hessian, noise**2 * middle, samples, problem.colouring, problem.space, x)
