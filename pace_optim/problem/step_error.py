"""What the physics step itself does to the simulation."""

from __future__ import annotations

from dataclasses import replace

import torch

from pace_optim.problem.problem import Problem
from pace_optim.recording.windows import Windows


def step_error(problem: Problem, physical: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """RMS change of each joint when the physics step is halved, (n,) [rad], in windows of the recordings.

    Zero where it cannot be simulated, or nothing counts.

    Args:
        physical: One candidate, (size,).
        where: Which samples count, (T, R) bool.
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
