"""A result looked at once more: its error bars and its trajectories."""

from __future__ import annotations

from typing import Any

import torch

from pace_optim.evaluator import Evaluator, Residuals
from pace_optim.jacobian import Colouring, jacobian, perturbed
from pace_optim.problem import Problem
from pace_optim.uncertainty import Uncertainty, estimate_uncertainty

_INITIAL_STEP = 1e-5
"""Change of the first position for its derivative [rad]."""


def assess(
    problem: Problem, evaluator: Evaluator, colouring: Colouring, x: torch.Tensor
) -> tuple[Uncertainty, Residuals]:
    """Error bars at x from the training samples, and x's residuals on all samples."""
    neighbours, step = perturbed(x, colouring)
    data, n = problem.dataset, len(problem.joint_names)
    shaken = _initial_joints(problem)
    vectors = torch.cat([x[None], neighbours, x.repeat(len(shaken), 1)])
    offset = torch.zeros(len(vectors), n, dtype=torch.float64)
    for row, joints in zip(offset[1 + len(neighbours) :], shaken, strict=True):
        row[list(joints)] = _INITIAL_STEP
    every = evaluator.residuals(problem.space.to_physical(vectors), data.sampled, offset)
    train = data.train[every.step]
    steps = train.any(dim=1)
    trained = Residuals(
        error=every.error[:, steps] * train[steps][None, :, :, None], where=train[steps], step=every.step[steps]
    )
    initial = (trained.error[1 + len(neighbours) :] - trained.error[:1]) / _INITIAL_STEP
    uncertainty = estimate_uncertainty(jacobian(trained, step, colouring), problem.space, x, initial, shaken)
    return uncertainty, Residuals(error=every.error[:1], where=every.where, step=every.step)


def _initial_joints(problem: Problem) -> list[tuple[int, ...]]:
    """Joints whose first position is moved together: the i-th of each tree."""
    index = {name: i for i, name in enumerate(problem.joint_names)}
    depth = max(len(tree) for tree in problem.trees)
    return [tuple(index[tree[i]] for tree in problem.trees if i < len(tree)) for i in range(depth)]


def trajectories(problem: Problem, residuals: Residuals) -> dict[str, Any]:
    """Commanded, measured and simulated encoder positions of one candidate, recording by recording."""
    data, result = problem.dataset, []
    for r, recording in enumerate(data.recordings):
        at = residuals.where[:, r]
        measured = torch.as_tensor(recording.dof_pos)[: int(at.sum())]
        result.append(
            {
                "name": recording.name,
                "time": torch.as_tensor(recording.time)[: len(measured)],
                "des_dof_pos": torch.as_tensor(recording.des_dof_pos)[: len(measured)],
                "dof_pos": measured,
                "sim_dof_pos": measured + residuals.error[0, at, r],
                "train": data.train[residuals.step][at, r],
            }
        )
    return {"joint_names": list(problem.joint_names), "recordings": result}
