"""Other parameters on a run's recordings, simulated as in its fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from pace_optim.estimate.error_bars.assessment import trajectories
from pace_optim.run.open import open_problem


def replay(run: Path, physical: torch.Tensor, task: str | None = None) -> dict[str, Any]:
    """Simulate one parameter vector on the recordings of a run.

    Args:
        physical: The parameters in the layout of the run's ``config.pt``, (size,).
        task: Another environment than the run's own.

    Returns:
        Trajectories as in ``best_trajectory.pt``.
    """
    problem = open_problem(run, task=task)
    if tuple(physical.shape) != (problem.space.size,):
        raise ValueError(
            f"The parameters have the shape {tuple(physical.shape)}, expected ({problem.space.size},) for "
            f"{problem.task}. They belong to another task, or it has changed since."
        )
    every = problem.evaluator().residuals(physical[None].double(), problem.dataset.sampled)
    return trajectories(problem, every)
