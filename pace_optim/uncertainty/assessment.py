"""A result looked at once more: its error bars and its trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pace_optim.optimizers.jacobian import Colouring, Jacobian
from pace_optim.optimizers.least_squares import Descent
from pace_optim.problem.evaluator import Evaluator, Residuals
from pace_optim.problem.problem import Problem
from pace_optim.uncertainty.uncertainty import Uncertainty, estimate_uncertainty

_INITIAL_STEP = 1e-5
"""Change of the first position for its derivative [rad]; where the motion is rough, the error that is left."""
_LOOKS = 3
"""Times that derivatives are taken where the motion turns out rough, the last over steps as wide as the error."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Assessment:
    """What is known of a vector."""

    uncertainty: Uncertainty
    """Its error bars."""
    residuals: Residuals
    """On all samples, m = 1."""
    jacobian: Jacobian
    """On the training samples of the recordings that are trained on."""


def assess(
    problem: Problem,
    evaluator: Evaluator,
    colouring: Colouring,
    x: torch.Tensor,
    held: Sequence[str] = (),
    ended: Descent | None = None,
) -> Assessment:
    """Error bars at x from the training samples, where some labels are held, and x's residuals on all samples.

    Args:
        problem: What was fitted.
        evaluator: Simulates all recordings.
        colouring: Which entries are perturbed together.
        x: Normalised, (size,).
        held: Labels of what is held where it is.
        ended: What ended there or near it: where it found the motion rough, its wide steps are good there too.
    """
    data, here = problem.dataset, Descent(x=x)
    if ended is not None:
        here.directions, here.score = ended.directions, ended.score
    looks = 1 if here.directions is not None else 1 + _LOOKS
    for _ in range(looks):
        shake = _INITIAL_STEP if here.directions is None else (here.score / len(problem.joint_names)) ** 0.5
        around = here.around(x, colouring)
        probes = make_probes(x, around, problem.trees, problem.joint_names, shake)
        every = evaluator.residuals(problem.space.to_physical(probes.vectors), data.sampled, probes.offset)
        recordings = data.trained()
        train = data.train[every.step][:, recordings]
        steps = train.any(dim=1)
        error = every.error[:, steps][:, :, recordings] * train[steps][None, :, :, None]
        trained = Residuals(error=error, where=train[steps], step=every.step[steps])
        here.score = float(trained.rows(0, 1).score[0])
        here.look(x, trained, probes.step, colouring)
        if here.directions is None:
            break
    assert here.jacobian is not None  # over wide steps it always is
    initial = probes.initial(trained.error)
    uncertainty = estimate_uncertainty(here.jacobian, problem.space, x, initial, probes.initial_joints, held)
    residuals = Residuals(error=every.error[:1], where=every.where, step=every.step)
    return Assessment(uncertainty=uncertainty, residuals=residuals, jacobian=here.jacobian)


def error_bars(problem: Problem, evaluator: Evaluator, there: Jacobian, x: torch.Tensor) -> Uncertainty:
    """Error bars at x from derivatives that are known: only first positions are moved once more.

    Args:
        problem: What was fitted.
        evaluator: Simulates the recordings that are trained on.
        there: Residuals at x and derivatives there or near it, on the training samples.
        x: Normalised, (size,).
    """
    residuals = there.residuals
    shake = (float(residuals.score[0]) / len(problem.joint_names)) ** 0.5 if there.is_wide else _INITIAL_STEP
    offset, joints = _shaken(problem.trees, problem.joint_names, shake)
    shaken = evaluator.residuals(problem.space.to_physical(x.repeat(len(joints), 1)), initial_offset=offset)
    initial = (shaken.error - residuals.error) / shake
    return estimate_uncertainty(there, problem.space, x, initial, joints)


@dataclass(frozen=True, kw_only=True, eq=False)
class Probes:
    """The simulations that say how the residuals depend on the parameters and on the first positions."""

    vectors: torch.Tensor
    """Normalised: x, its neighbours for the derivatives, then x once per set of joints, (m, size)."""
    offset: torch.Tensor
    """Added to the first positions, (m, n) [rad]."""
    step: torch.Tensor
    """Of the neighbours, (size,) or, over wide steps, (size, size)."""
    initial_joints: tuple[tuple[int, ...], ...]
    """Joints whose first position is moved together: the i-th of each tree."""
    shake: float
    """How far it is moved [rad]."""

    def initial(self, error: torch.Tensor) -> torch.Tensor:
        """Derivatives by the first positions of ``initial_joints``, (sets, …), of residuals (m, …)."""
        return (error[-len(self.initial_joints) :] - error[:1]) / self.shake


def make_probes(
    x: torch.Tensor,
    around: tuple[torch.Tensor, torch.Tensor],
    trees: Sequence[Sequence[str]],
    joint_names: Sequence[str],
    shake: float = _INITIAL_STEP,
) -> Probes:
    """What to simulate for the error bars at x.

    Args:
        x: Normalised vector, (size,).
        around: Neighbours of x, (k, size), and their steps.
        trees: Groups of joints that do not influence each other.
        joint_names: All joints, in order.
        shake: How far first positions are moved [rad].
    """
    neighbours, step = around
    moved, joints = _shaken(trees, joint_names, shake)
    vectors = torch.cat([x[None], neighbours, x.repeat(len(joints), 1)])
    offset = torch.cat([torch.zeros(len(vectors) - len(joints), len(joint_names), dtype=torch.float64), moved])
    return Probes(vectors=vectors, offset=offset, step=step, initial_joints=joints, shake=shake)


def _shaken(
    trees: Sequence[Sequence[str]], joint_names: Sequence[str], shake: float
) -> tuple[torch.Tensor, tuple[tuple[int, ...], ...]]:
    """Changes of the first positions, (sets, n) [rad], and which joints each of them moves: the i-th of each tree."""
    index = {name: i for i, name in enumerate(joint_names)}
    depth = max(len(tree) for tree in trees)
    joints = tuple(tuple(index[tree[i]] for tree in trees if i < len(tree)) for i in range(depth))
    offset = torch.zeros(depth, len(joint_names), dtype=torch.float64)
    for row, own in zip(offset, joints, strict=True):
        row[list(own)] = shake
    return offset, joints


def trajectories(problem: Problem, residuals: Residuals) -> dict[str, Any]:
    """Commanded, measured and simulated encoder positions of one candidate, recording by recording."""
    data, result = problem.dataset, []
    for r, recording in enumerate(data.recordings):
        at = residuals.where[:, r]
        measured = torch.as_tensor(recording.dof_pos)[: int(at.sum())]
        enabled = recording.torque_enable
        on = torch.ones(len(measured), dtype=torch.bool) if enabled is None else torch.as_tensor(enabled).bool()
        result.append(
            {
                "name": recording.name,
                "time": torch.as_tensor(recording.time)[: len(measured)],
                "des_dof_pos": torch.as_tensor(recording.sampled_command)[: len(measured)],
                "dof_pos": measured,
                "sim_dof_pos": measured + residuals.error[0, at, r],
                "train": data.train[residuals.step][at, r],
                "torque_enable": on[: len(measured)],
            }
        )
    return {"joint_names": list(problem.joint_names), "recordings": result}
