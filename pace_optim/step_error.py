"""What the physics step itself does to the simulation."""

from __future__ import annotations

import torch

from pace_optim.problem import Problem


def step_error(problem: Problem, physical: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """RMS change of each joint when the physics step is halved, (n,) [rad]; zero where it cannot be simulated.

    Args:
        problem: What is simulated.
        physical: One candidate, (size,).
        where: Which samples count, (T, R) bool.
    """
    finer = problem.with_physics_dt(problem.physics_dt / 2)
    coarse, fine = (p.evaluator().residuals(physical[None], where) for p in (problem, finer))
    change = (coarse.error[0] - fine.error[0])[coarse.where]
    return change.square().mean(dim=0).sqrt().nan_to_num(nan=0.0, posinf=0.0)
