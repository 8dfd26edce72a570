"""Where a fit begins: at what the balance of torques along the recordings gives, without a simulation.

For each joint, everything but the delay is linear (:mod:`pace_optim.identification.log_checks.balance`):

    τ_drive(t - delay) = τ_links + a q̈ + d q̇ + f sign(q̇) + b + δ τ̇_drive

The armature a, viscous friction d and Coulomb friction f are a start. The delay is the one that leaves least over all
joints, δ what it lacks; b takes what encoder biases do to gravity. The smoothing that makes q̈ usable leaves
errors, of up to a half in a small armature, which the fit takes away.

Links that are sought come first. The torque of a link is linear in its pseudo-inertia J
(:mod:`pace_envs.link_inertia`), so that of ten point masses on it makes that of any J. The joints' own terms are
projected out, and τ_links(J(θ)) is fitted by the free parameters θ of all sought links. Without this, armatures and
frictions take up a tool that the file lacks, and the fit ends in their valley.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np
import torch
from scipy.optimize import least_squares

from pace_envs.link_inertia import FIELDS, NAMES, PARTS, Reference, fields_of, pseudo_inertia_of
from pace_envs.tasks.pace import GLOBAL
from pace_optim.identification.log_checks.balance import FEWEST, Links, View, moving, views_of
from pace_optim.problem.inverse_dynamics import bounded_least_squares
from pace_optim.problem.problem import Problem

_FOUND = ("armature", "viscous_friction", "friction")
_UNEXPLAINED = 0.5
"""Part of a torque's variance without which a joint keeps its start."""
_BALANCES = 0.1
"""Part of a torque, in its standard deviation, that may be left by smoothing and noise alone."""
_WEAKEST = 0.2
"""Part of its stiffness that a position loop has left, at least, against the slope of gravity."""
_SHIFT = 1e-2
"""Of a position, to see that slope [rad]."""
_PRIOR = 1e-3
"""Weight of the prior of links against the whole torque: it holds what the motion does not show."""
_POINTS = np.array(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1], [1, 1, 0], [1, 0, 1], [0, 1, 1]]
)
"""Places whose point masses make any pseudo-inertia."""
_UPPER = np.triu_indices(4)
"""Its ten entries."""


def balanced_start(problem: Problem) -> tuple[torch.Tensor, float]:
    """Where a fit begins, and what no parameter can take away.

    Returns:
        The start of the parameters, normalised (size,), with what the training recordings give in its place; the score
        that missing physics leaves [rad²]: see :func:`_left_over`.
    """
    views, space = views_of(problem), problem.space
    trained, links = [views[r] for r in problem.dataset.trained()], problem.env_cfg.sim2real.links
    found = _links(trained, links) if links else {}
    if found:
        changes = {each.link: _change(each, found[each.link]) for each in links}
        trained = [_changed(view, changes) for view in trained]
    seen = [(view, Links.of(view)) for view in trained]
    counts = [moving(view, links) for view, links in seen]
    joints = _judged(counts)
    of_links = {f"{name}/{link}": value for link, own in found.items() for name, value in own.items()}
    best, late_by, of_joints = np.inf, 0, dict[str, float]()
    for delay in range(views[0].most_delay + 1) if joints else ():
        solved = [_solved(*_balance(seen, counts, j, delay), 0.5 * problem.control_dt) for j in joints]
        if (left := sum(part for _, part in solved)) >= best:
            continue
        late_by = delay
        best, late = left, float(np.median([numbers[-1] for numbers, _ in solved]))
        of_joints = {f"delay/{GLOBAL}": delay + late / problem.control_dt}
        for j, (numbers, part) in zip(joints, solved, strict=True):
            if part > _UNEXPLAINED:
                continue
            # one at its bound is not known: from no friction at all, a descent may not get away
            known = {name: value for name, value in zip(_FOUND, numbers, strict=False) if value > 0}
            of_joints |= {f"{name}/{problem.joint_names[j]}": value for name, value in known.items()}
    values, physical = of_links | of_joints, space.to_physical(space.start)
    for i, label in enumerate(space.labels):
        physical[i] = values.get(label, float(physical[i]))
    start = space.to_normalised(physical).clamp(-1.0, 1.0)
    return start, _left_over(seen, counts, joints, late_by, 0.5 * problem.control_dt)


def _left_over(
    seen: Sequence[tuple[View, Links]], counts: Sequence[np.ndarray], joints: Sequence[int], delay: int, half: float
) -> float:
    """Score that is left with the torques that no parameter of the base model makes [rad²].

    A position loop gives way by e = τ / (kp + g') to a torque τ that is slow against it, with g' the slope of what the
    links take. Encoder biases take the place of the constant: they change the torques of links alone. Joints whose
    torques balance count nothing, nor do those without a position loop.
    """
    result, slopes = 0.0, [_slopes(*each) for each in seen]
    most = seen[0][0].most_bias
    for j in joints:
        loops = [view.stiffness[j] for view, _ in seen]
        if not min(loops) > 0:
            continue
        table, torque = _balance(seen, counts, j, delay)
        biases = np.concatenate([each[count[:, j], j] for each, count in zip(slopes, counts, strict=True)])
        table = np.column_stack([table[:, :3], table[:, 4], biases])
        lower, upper = np.array([0.0, 0.0, 0.0, -half, *-most]), np.array([np.inf, np.inf, np.inf, half, *most])
        values, left = bounded_least_squares(table, torque, lower, upper)
        if left <= _BALANCES**2 * np.square(torque - torque.mean()).sum():
            continue
        holds = [max(kp + each[:, j, j].mean(), _WEAKEST * kp) for kp, each in zip(loops, slopes, strict=True)]
        missing = (torque - table @ values) / np.repeat(holds, [count[:, j].sum() for count in counts])
        result += float(np.square(missing).mean())
    return result


def _slopes(view: View, links: Links) -> np.ndarray:
    """How the torques of the links change with the positions, (N, n, n) [N m/rad]."""
    shifts = _SHIFT * np.eye(len(view.joints))
    moved = [Links.of(replace(view, position=view.position + shift)).torque for shift in shifts]
    return np.stack([(each - links.torque) / _SHIFT for each in moved], axis=-1)


def _judged(counts: Sequence[np.ndarray]) -> list[int]:
    """The joints that move at enough instants."""
    return [j for j in range(counts[0].shape[1]) if sum(each[:, j].sum() for each in counts) >= FEWEST]


def _balance(
    seen: Sequence[tuple[View, Links]], counts: Sequence[np.ndarray], j: int, delay: int
) -> tuple[np.ndarray, np.ndarray]:
    """What a joint's own terms multiply, (N, 5), and the torque that they and its links take up, less the links'."""
    tables, torques = [], []
    for (view, links), count in zip(seen, counts, strict=True):
        rows, given = links.rows[count[:, j]], view.smooth_given(j, delay)
        columns = [series[count[:, j], j] for series in (links.acceleration, links.speed, links.direction)]
        slope = (given[rows + 1] - given[rows - 1]) / (2 * view.dt)
        tables.append(np.column_stack([*columns, np.ones(len(rows)), slope]))
        torques.append(given[rows] - links.torque[count[:, j], j])
    return np.concatenate(tables), np.concatenate(torques)


def _solved(table: np.ndarray, torque: np.ndarray, half: float) -> tuple[np.ndarray, float]:
    """Armature, viscous friction, friction, a constant and the delay's rest [s], and the torque left."""
    lower, upper = np.array([0.0, 0.0, 0.0, -np.inf, -half]), np.array([np.inf, np.inf, np.inf, np.inf, half])
    values, left = bounded_least_squares(table, torque, lower, upper)
    return values, left / max(float(np.square(torque - torque.mean()).sum()), 1e-300)


def _links(views: Sequence[View], references: Sequence[Reference]) -> dict[str, dict[str, float]]:
    """The free parameters of links that explain most of the torques, {link: {name: value}}; few instants do."""
    views = [replace(view, coarse=True) for view in views]
    seen = [(view, Links.of(view)) for view in views]
    counts = [moving(view, links) for view, links in seen]
    if not (joints := _judged(counts)):
        return {}
    places = [_places(each) for each in references]
    of_points = [
        np.stack(
            [_of_point(view, links, each, u) for each, us in zip(references, places, strict=True) for u in us], axis=-1
        )
        for view, links in seen
    ]

    def reduced(delay: int) -> np.ndarray:
        """The triangle R whose last column is the torque that the others' make, own terms of joints projected out."""
        width = of_points[0].shape[-1] + 1
        parts = [np.zeros((width, width))]  # so many rows at least
        for j in joints:
            table, torque = _balance(seen, counts, j, delay)
            columns = np.concatenate([each[count[:, j], j] for each, count in zip(of_points, counts, strict=True)])
            own = np.linalg.qr(table / np.linalg.norm(table, axis=0).clip(1e-300)).Q
            rest = np.column_stack([columns, torque]) / max(float(np.linalg.norm(torque - torque.mean())), 1e-300)
            parts.append(rest - own @ (own.T @ rest))
        return np.linalg.qr(np.concatenate(parts)).R

    best = min(map(reduced, range(views[0].most_delay + 1)), key=lambda triangle: abs(triangle[-1, -1]))
    return _fitted(best[:, :-1], best[:, -1], references, places)


def _fitted(
    table: np.ndarray, torque: np.ndarray, references: Sequence[Reference], places: Sequence[np.ndarray]
) -> dict[str, dict[str, float]]:
    """The parameters whose pseudo-inertias make a torque of those of point masses."""
    makes = [np.linalg.inv(np.stack([np.outer(u, u)[_UPPER] for u in us], axis=-1)) for us in places]
    free = [(each, name) for each in references for name in each.names]
    lower, upper = np.array([each.bounds(name) for each, name in free]).T
    start, spread = np.array([each.start(name) for each, name in free]), (upper - lower) / 8
    masses, *_ = np.linalg.lstsq(table, torque, rcond=None)
    for each, us, own in zip(references, places, np.split(masses, len(references)), strict=True):
        added = sum(mass * np.outer(u, u) for mass, u in zip(own, us, strict=True))
        if set(PARTS["load"]) <= set(each.names) and added[3, 3] > 0:
            load = [added[3, 3], *added[:3, 3] / added[3, 3]]
            at = [free.index((each, name)) for name in PARTS["load"]]
            start[at] = np.clip(load, lower[at], upper[at])

    def by_link(values: np.ndarray) -> dict[str, dict[str, float]]:
        result: dict[str, dict[str, float]] = {each.link: {} for each in references}
        for (each, name), value in zip(free, values, strict=True):
            result[each.link][name] = float(value)
        return result

    def left(values: np.ndarray) -> np.ndarray:
        own = by_link(values)
        changes = [_change(each, own[each.link]) for each in references]
        masses = [make @ change[_UPPER] for make, change in zip(makes, changes, strict=True)]
        return np.concatenate([table @ np.concatenate(masses) - torque, _PRIOR * (values - start) / spread])

    inside = np.clip(start, lower + 1e-3 * spread, upper - 1e-3 * spread)
    return by_link(least_squares(left, inside, bounds=(lower, upper), x_scale=spread).x)


def _places(reference: Reference) -> np.ndarray:
    """Places of ten point masses around a link, [p, 1], (10, 4)."""
    com, reach = np.array(reference.values[1:4]), max(reference.values[4:7])
    return np.column_stack([com + reach * _POINTS, np.ones(len(_POINTS))])


def _change(reference: Reference, values: Mapping[str, float]) -> np.ndarray:
    """What other values than the file's add to the J of a link, (4, 4)."""
    every = [values.get(name, value) for name, value in zip(NAMES, reference.values, strict=True)]
    found, file = reference.pseudo_inertia(torch.tensor([every, list(reference.values)], dtype=torch.float64)).numpy()
    return found - file


def _of_point(view: View, links: Links, reference: Reference, u: np.ndarray) -> np.ndarray:
    """The torque of a point mass of 1 kg on a link, (N, n) [N m]."""
    mass = reference.values[0]
    heavier = _changed(view, {reference.link: mass * np.outer(u, u)})
    return (Links.of(heavier).torque - links.torque) / mass


def _changed(view: View, changes: Mapping[str, np.ndarray]) -> View:
    """A recording's view with something added to the J of bodies, (4, 4); its known loads stay."""
    model = copy.copy(view.model)
    for link, change in changes.items():
        body = model.body(link).id
        before = pseudo_inertia_of({name: torch.tensor(getattr(model, name)[[body]]) for name in FIELDS})
        for name, value in fields_of(before + torch.tensor(change)).items():
            getattr(model, name)[body] = value[0].numpy()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(view, model=model)
