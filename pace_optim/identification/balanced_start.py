"""Where a fit begins: at what the balance of torques along the recordings gives, without a simulation.

For each joint, everything but the delay is linear (:mod:`pace_optim.identification.log_checks.balance`):

    τ_drive(t - delay) = τ_links + a q̈ + d q̇ + f sign(q̇) + b + δ τ̇_drive

The armature a, viscous friction d and Coulomb friction f are a start. The delay is the one that leaves least over all
joints, δ what it lacks; b takes what encoder biases do to gravity. The smoothing that makes q̈ usable leaves
errors, of up to a half in a small armature, which the fit takes away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from pace_envs.tasks.pace import GLOBAL
from pace_optim.identification.log_checks.balance import FEWEST, Links, View, moving, views_of
from pace_optim.problem.bounded_least_squares import bounded_least_squares
from pace_optim.problem.problem import Problem

_FOUND = ("armature", "viscous_friction", "friction")
_UNEXPLAINED = 0.5
"""Part of a torque's variance without which a joint keeps its start."""


def balanced_start(problem: Problem) -> torch.Tensor:
    """The start of the parameters, normalised (size,), with what the training recordings give in its place."""
    views, space = views_of(problem), problem.space
    seen = [(view, Links.of(view)) for view in (views[r] for r in problem.dataset.trained())]
    counts = [moving(view, links) for view, links in seen]
    joints = [j for j in range(len(problem.joint_names)) if sum(each[:, j].sum() for each in counts) >= FEWEST]
    physical, best = space.to_physical(space.start), np.inf
    for delay in range(views[0].most_delay + 1) if joints else ():
        solved = [_solved(seen, counts, j, delay) for j in joints]
        if (left := sum(part for _, part in solved)) >= best:
            continue
        best, late = left, float(np.median([values[-1] for values, _ in solved]))
        found = {f"delay/{GLOBAL}": delay + late / problem.control_dt}
        for j, (values, part) in zip(joints, solved, strict=True):
            if part > _UNEXPLAINED:
                continue
            # one at its bound is not known: from no friction at all, a descent may not get away
            known = {name: value for name, value in zip(_FOUND, values, strict=False) if value > 0}
            found |= {f"{name}/{problem.joint_names[j]}": value for name, value in known.items()}
    for i, label in enumerate(space.labels if joints else ()):
        physical[i] = found.get(label, float(physical[i]))
    return space.to_normalised(physical).clamp(-1.0, 1.0)


def _solved(
    seen: Sequence[tuple[View, Links]], counts: Sequence[np.ndarray], j: int, delay: int
) -> tuple[np.ndarray, float]:
    """Armature, viscous friction, friction, a constant and the delay's rest [s], and the torque left."""
    tables, torques = [], []
    for (view, links), count in zip(seen, counts, strict=True):
        rows, given = links.rows[count[:, j]], view.smooth_given(j, delay)
        columns = [series[count[:, j], j] for series in (links.acceleration, links.speed, links.direction)]
        slope = (given[rows + 1] - given[rows - 1]) / (2 * view.dt)
        tables.append(np.column_stack([*columns, np.ones(len(rows)), slope]))
        torques.append(given[rows] - links.torque[count[:, j], j])
    table, torque, half = np.concatenate(tables), np.concatenate(torques), 0.5 * seen[0][0].control_dt
    lower, upper = np.array([0.0, 0.0, 0.0, -np.inf, -half]), np.array([np.inf, np.inf, np.inf, np.inf, half])
    values, left = bounded_least_squares(table, torque, lower, upper)
    return values, left / max(float(np.square(torque - torque.mean()).sum()), 1e-300)
