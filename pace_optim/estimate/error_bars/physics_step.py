"""What the physics step does to a simulation, and to what a fit finds with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from pace_optim.estimate.derivatives import Jacobian
from pace_optim.estimate.error_bars.uncertainty import SURE, autocovariance, filtered, inverse_of
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.free_phases import FreePhases
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.recording.windows import Windows

FINER = 4
"""A step this many times finer stands for none: what is left then is a third of what changes (an error of first order,
as that of friction that turns within a step, whatever the integrator)."""
TO_NO_STEP = FINER / (FINER - 1)


def step_error(problem: Problem, physical: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """RMS change of each joint when the physics step is halved, (n,) [rad], in windows of the recordings.

    Zero where it cannot be simulated, or nothing counts.
    """
    if not bool(where.any()):
        return torch.zeros(len(problem.joint_names), dtype=torch.float64)
    windows = Windows.of(problem.dataset, problem.control_dt).with_samples(where)
    problem, counts = replace(problem, dataset=windows.cut(problem.dataset)), windows.mask(where)
    finer = problem.with_physics_dt(problem.physics_dt / 2)
    evaluator, fine = problem.evaluator(), finer.evaluator()
    coarse = evaluator.residuals(physical[None], counts)
    fine.phases = evaluator.phases
    change = (coarse.error[0] - fine.residuals(physical[None], counts).error[0])[coarse.where]
    return change.square().mean(dim=0).sqrt().nan_to_num(nan=0.0, posinf=0.0)


def change_without_step(
    problem: Problem, physical: torch.Tensor, there: Residuals, phases: FreePhases | None = None
) -> torch.Tensor | None:
    """How the motion would change if the physics had no step, on the training samples, (K, R, n) [rad].

    Args:
        phases: What these have taken out of free phases.

    Returns:
        The change; ``None`` where the finer simulation diverges.
    """
    finer = problem.with_physics_dt(problem.physics_dt / FINER)
    evaluator = finer.training_evaluator()
    evaluator.phases = phases
    change = TO_NO_STEP * (evaluator.residuals(physical[None]).error[0] - there.error[0])
    return change if bool(change.isfinite().all()) else None


def step_share(
    there: Jacobian, change: torch.Tensor, space: ParameterSpace, x: torch.Tensor, known: np.ndarray
) -> np.ndarray:
    """The part of each value that comes from the step, physical (size,): the value less that of a fit without a step.

    The residuals r at the result change by c when the step goes, and the result moves, in the linear map of its error
    bars, by - (JᵀJ)⁻¹ Jᵀ c. It does so only if the recording has no such step in it: what no parameter makes up for,
    c' = c + J times that move, then stands in the residuals, r = - c' + noise. A recording that this very step made has
    nothing of it. The share of c' that the residuals hold, α = - r c' / c' c', separates the two cases.

    Args:
        there: At the result, on the training samples.
        change: Of the residuals when the step goes, (K, R, n) [rad].
        known: Which parameters have an error bar, (size,) bool; the others stay.
    """
    result = np.where(known, 0.0, np.nan)
    free = np.flatnonzero(known)
    if not len(free):
        return result
    hessian, _ = there.normal_equations()
    inverse, _ = inverse_of(hessian.numpy()[np.ix_(free, free)])
    move = torch.zeros(space.size, dtype=torch.float64)
    move[free] = torch.from_numpy(-inverse @ there.transposed_times(change).numpy()[free])
    if not has_no_step(there.residuals.error[0], change + there.times(move), there.residuals.where):
        return result
    result[free] = -(move * space.slope(x)).numpy()[free]
    return result


def has_no_step(residuals: torch.Tensor, left: torch.Tensor, where: torch.Tensor) -> bool:
    """Whether the recording may be of physics without the step: not if less than half of c' is surely in r.

    Args:
        residuals: r, (K, R, n) [rad].
        left: c', (K, R, n) [rad].
        where: Samples that count, (K, R) bool.
    """
    total = float(left.square().sum())
    if total == 0:
        return False
    part, variance = -float((residuals * left).sum()) / total, 0.0
    for r in range(where.shape[1]):
        at = where[:, r]
        for joint in range(left.shape[-1]) if bool(at.any()) else ():
            own, error = left[None, at, r, joint].numpy(), residuals[at, r, joint].numpy()
            variance += float((own * filtered(own, autocovariance(error))).sum())
    return part + SURE * np.sqrt(max(variance, 0.0)) / total > 0.5
