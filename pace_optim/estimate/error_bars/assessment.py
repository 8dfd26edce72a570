"""A result looked at once more: its error bars and its trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from pace_optim.estimate.derivatives import TIMES_NOISE, Jacobian, Stencil, stencil
from pace_optim.estimate.error_bars.uncertainty import Uncertainty, estimate_uncertainty
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, by_chords
from pace_optim.problem.evaluator import Evaluator, Residuals
from pace_optim.problem.free_phases import FreePhases
from pace_optim.problem.problem import Problem

_MOST_LOOKS = 3
"""After the first."""
_LATE = 1e-4
"""Standard deviation of the time from a row of a walk's log to the forces that act on its joints [s]."""
_INITIAL_STEP = 1e-5
"""Change of the first position for its derivative [rad]; more where the simulation's own noise is more than that."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Assessment:
    """What is known of a vector."""

    x: torch.Tensor
    """The vector, normalised (size,)."""
    uncertainty: Uncertainty
    """Its error bars."""
    residuals: Residuals
    """On all samples, m = 1."""
    jacobian: Jacobian
    """On the training samples of the recordings that are trained on."""
    noise: float
    """The simulation's own noise [rad]."""
    initial: Initial
    """On the same samples as the Jacobian."""
    phases: FreePhases | None
    """What its residuals have taken out of free phases; ``None`` where no base moves."""

    def moved(self, evaluator: Evaluator, training: Evaluator, x: torch.Tensor, held: Sequence[str] = ()) -> Assessment:
        """The same of a vector nearby, with these derivatives.

        Args:
            held: Labels of what is held where it is.
        """
        residuals = training.residuals(training.space.to_physical(x)[None])
        there = replace(self.jacobian, residuals=residuals)
        return _assessment(evaluator, training, x, there, self.initial, self.noise, held)


def assess(
    problem: Problem,
    evaluator: Evaluator,
    x: torch.Tensor,
    ended: Descent | None = None,
    training: Evaluator | None = None,
) -> Assessment:
    """Error bars at x from the training samples, and x's residuals on all samples.

    Derivatives take the physics step that those of the descent took. Where that is longer than the fit's own, the
    descent ended early, and x goes on to the minimum here.

    Args:
        ended: What ended there or near it, which knows the principal directions; ``None``: they are looked for.
        training: Simulates what is trained on; ``None``: the problem's own.
    """
    training = training or problem.training_evaluator()
    hessian, noise, score = (None, 0.0, 0.0) if ended is None else (ended.hessian, ended.noise, ended.score)
    own_step = ended is not None and ended.own_step
    ended_early = ended is not None and bool(ended.stop_reason) and training.looks_coarser
    for _ in range(1 + _MOST_LOOKS):
        training.look_at_phases(problem.space.to_physical(x), anew=True)
        around = stencil(x, training.colouring, hessian, noise, score)
        shake = max(_INITIAL_STEP, min(TIMES_NOISE * noise, score**0.5))
        probes = make_probes(x, around, problem.trees, problem.joint_names, shake)
        here, every = training.look_around(
            problem.space.to_physical(probes.vectors), own_step=own_step, initial_offset=probes.offset
        )
        there, noise, score = replace(around.jacobian(every), residuals=here), around.noise(every), float(here.score[0])
        blind, initial = hessian is None, probes.initial(every.error)
        if ended_early:
            x, there, _ = by_chords(training, x, there)
        gained = score - float(there.residuals.score[0])
        if not blind and gained <= LeastSquaresCfg().near_enough * score:
            break
        hessian, _ = there.normal_equations()
    return _assessment(evaluator, training, x, there, initial, noise)


def _assessment(
    evaluator: Evaluator,
    training: Evaluator,
    x: torch.Tensor,
    there: Jacobian,
    initial: Initial,
    noise: float,
    held: Sequence[str] = (),
) -> Assessment:
    """Error bars from derivatives at x or near it."""
    middle = None
    if training.phases is not None and there.residuals.weight is not None:
        late = _late_forces(there, training, x)
        middle = _middle_of_swings(there, training.phases, training.dataset.train) + np.outer(late, late)
    uncertainty = estimate_uncertainty(there, training.space, x, initial.derivatives, initial.joints, held, middle)
    physical = evaluator.space.to_physical(x)
    if evaluator.dataset.num_recordings == training.dataset.num_recordings:
        evaluator.phases = training.phases
    else:
        evaluator.look_at_phases(physical, anew=True)
    return Assessment(
        x=x,
        uncertainty=uncertainty,
        residuals=evaluator.residuals(physical[None], evaluator.dataset.sampled),
        jacobian=there,
        noise=noise,
        initial=initial,
        phases=training.phases,
    )


def _middle_of_swings(jacobian: Jacobian, phases: FreePhases, trained: torch.Tensor) -> np.ndarray:
    """JᵀΣJ, (size, size), with Σ the covariance of each swing's errors, and none between swings.

    Residuals are whitened by C, which a fit follows. What lasts in them is in Σ = L⁻¹ C' L⁻ᵀ, with C' all that is not
    known of a swing. If the errors of a swing are above C', its Σ is as many times as large: each swing is a cluster
    with its own variance (Liang and Zeger, Biometrika 73, 1986).

    Args:
        phases: What is not known of swings.
        trained: Where these samples are, (T, R) bool.
    """
    residuals, colouring = jacobian.residuals, jacobian.colouring
    total = np.zeros((len(colouring.joints), len(colouring.joints)))
    if residuals.weight is None:
        return total
    for block, begin, end, expected in phases.expected_of(residuals.step, trained):
        r, joints = block.recording, block.joints
        kept = residuals.where[begin:end, r]
        if not bool(kept.any()):
            continue
        at, rows = torch.arange(begin, end)[kept], kept[:, None].expand(-1, len(joints)).flatten()
        scale = (residuals.weight[at, r][:, joints] * phases.floor[r, joints]).flatten()
        entries = colouring.moving(joints)
        own = jacobian.columns[[colouring.row_of[entry] for entry in entries]][:, at, r][..., joints].flatten(1) * scale
        error = residuals.error[0, at, r][:, joints].flatten() / scale.clamp(min=1e-300)
        spread = expected[rows][:, rows]
        larger = max(1.0, float(error.square().sum() / spread.diagonal().sum()))
        total[np.ix_(entries, entries)] += larger * (own @ spread @ own.T).numpy()
    return total


def _late_forces(jacobian: Jacobian, evaluator: Evaluator, x: torch.Tensor) -> np.ndarray:
    """Jᵀc, (size,), with c how residuals change if forces act later than a walk's rows say, by :data:`_LATE`.

    A joint that feels kp (q* - q) - (kd + d) q̇ of a time τ ago moves, to first order, as one with the parameters

        d - kp τ        a - (kd + d) τ        delay + τ

    of which no log shows τ. A simulator whose step h is semi-implicit logs positions that are h / 2 ahead.
    """
    rollout, space = evaluator.rollout(1), evaluator.space
    physical, slope = space.to_physical(x), space.slope(x)
    change, viscous = torch.zeros_like(jacobian.residuals.error[0]), space["viscous_friction"]
    for r in range(jacobian.residuals.num_recordings):
        kp, kd = torch.zeros(2, rollout.robot.num_joints, dtype=torch.float64)
        for drive in rollout.robot.actuators.values():
            kp[drive.joint_indices], kd[drive.joint_indices] = drive.stiffness[r].double(), drive.damping[r].double()
        move = torch.zeros(space.size, dtype=torch.float64)
        move[viscous], move[space["armature"]] = -kp * _LATE, -(kd + physical[viscous]) * _LATE
        move[space["delay"]] = _LATE / rollout.env.step_dt
        columns = jacobian.residuals.columns_of(r)
        change[:, columns] = jacobian.times(torch.where(slope > 0, move / slope, 0.0))[:, columns]
    return (jacobian.transposed_times(change) * jacobian.residuals.where.sum()).numpy()


@dataclass(frozen=True, kw_only=True, eq=False)
class Probes:
    """The simulations that say how the residuals depend on the parameters and on the first positions."""

    vectors: torch.Tensor
    """Normalised: x, those around it, then x once per set of joints, (m, size)."""
    offset: torch.Tensor
    """Added to the first positions, (m, n) [rad]."""
    initial_joints: tuple[tuple[int, ...], ...]
    """Joints whose first position is moved together: the i-th of each tree."""
    shake: float
    """How far it is moved [rad]."""

    def initial(self, error: torch.Tensor) -> Initial:
        """What residuals (m, …) of these vectors show of the first positions."""
        derivatives = (error[-len(self.initial_joints) :] - error[:1]) / self.shake
        return Initial(derivatives=derivatives, joints=self.initial_joints)


@dataclass(frozen=True, kw_only=True, eq=False)
class Initial:
    """How the residuals depend on the first positions."""

    derivatives: torch.Tensor
    """Derivatives of the residuals, (sets, K, R, n)."""
    joints: tuple[tuple[int, ...], ...]
    """Joints whose first position is moved together, set by set."""


def make_probes(
    x: torch.Tensor,
    around: Stencil,
    trees: Sequence[Sequence[str]],
    joint_names: Sequence[str],
    shake: float = _INITIAL_STEP,
) -> Probes:
    """What to simulate for the error bars at x.

    Args:
        around: Vectors around x that give the derivatives.
        trees: Groups of joints that do not influence each other.
        shake: How far first positions are moved [rad].
    """
    moved, joints = _shaken(trees, joint_names, shake)
    vectors = torch.cat([x[None], around.vectors, x.repeat(len(joints), 1)])
    offset = torch.cat([torch.zeros(len(vectors) - len(joints), len(joint_names), dtype=torch.float64), moved])
    return Probes(vectors=vectors, offset=offset, initial_joints=joints, shake=shake)


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
    data, residuals, result = problem.dataset, residuals.positions, []
    for r, recording in enumerate(data.recordings):
        at, also = residuals.where[:, r], {}
        measured = torch.as_tensor(recording.dof_pos)[: int(at.sum())]
        enabled = recording.torque_enable
        error = residuals.error[0, at, r]
        if residuals.weight is not None:
            error = error / residuals.weight[at, r].clamp(min=1.0)
        on = torch.ones(len(measured), dtype=torch.bool) if enabled is None else torch.as_tensor(enabled).bool()
        if data.settling is not None:
            also["settling"] = data.settling[residuals.step][at, r]
        path, base = problem.base_paths[r], {}
        if path is not None:
            base = {
                "base": torch.as_tensor(path.pose)[: len(measured)],
                "standing": torch.as_tensor(path.standing)[: len(measured)],
                "feet": [{"body": body, "pos": place} for body, place in path.feet],
            }
        result.append(
            base
            | {
                "name": recording.name,
                "time": torch.as_tensor(recording.time)[: len(measured)],
                "des_dof_pos": torch.as_tensor(recording.sampled_command)[: len(measured)],
                "dof_pos": measured,
                "sim_dof_pos": measured + error,
                "train": data.train[residuals.step][at, r],
                "torque_enable": on[: len(measured)],
            }
            | also
        )
    return {"joint_names": list(problem.joint_names), "recordings": result}
