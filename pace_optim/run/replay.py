"""Other parameters on a run's recordings, simulated as in its fit."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import torch

from pace_optim.problem.problem import load_problem
from pace_optim.run.settings import FitSettings
from pace_optim.uncertainty.assessment import trajectories


def replay(run: Path, physical: torch.Tensor) -> dict[str, Any]:
    """Simulate one parameter vector on the recordings of a run.

    Args:
        run: The run's folder.
        physical: The parameters in the layout of the run's ``config.pt``, (size,).

    Returns:
        Trajectories as in ``best_trajectory.pt``.

    Raises:
        ValueError: If a recording has gone, or the vector does not fit.
    """
    settings, _ = FitSettings.load(run / "settings.json")
    wanted = [name for name in inspect.signature(load_problem).parameters if hasattr(settings, name)]
    problem = load_problem(**{name: getattr(settings, name) for name in wanted})
    if tuple(physical.shape) != (problem.space.size,):
        raise ValueError(
            f"The parameters have the shape {tuple(physical.shape)}, expected ({problem.space.size},) for "
            f"{settings.task}. They belong to another task, or it has changed since."
        )
    every = problem.evaluator().residuals(physical[None].double(), problem.dataset.sampled)
    return trajectories(problem, every)
