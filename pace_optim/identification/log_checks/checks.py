"""Cheap checks of recordings before a search: each names a cause that explains them, where as they are they do not fit.

There is one method. A check changes the log, or one thing that the model takes for granted, and the torques' balance
(:mod:`.balance`) is computed again. A change is named when the log as it is does not balance, and with the change it
does. Changes add up: two joints may both be reversed.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import aligned, in_short, listed
from pace_optim.identification.log_checks.balance import Balance, Links, View, balances, views_of, without
from pace_optim.identification.log_checks.imu import late, other_axes, other_units, stuck_contacts
from pace_optim.problem.problem import Problem
from pace_optim.problem.recordings import tell_nobody

_DOUBTED = 0.04
"""Misfit from which a joint is looked at."""
_LARGE = 0.3
"""Misfit of a joint whose scale may be wrong, or whose torque a limit that is not stated."""
_BETTER, _NOT_WORSE = 0.4, 0.8
"""A change must leave at most so much of the misfit of the joints that it changes: in their geometric mean, of each."""
_EXPLAINED = 0.12
"""Misfit of a joint that is explained."""
_WORTH = 0.6
"""Of the misfits in a coarse look: a change that leaves more is not looked at further."""
_TWICE = 1.8
"""Smallest factor between units, or of a gear, that is named."""
_TRAVEL: Mapping[JointType, tuple[float, float]] = {"hinge": (0.15, 7.0), "slide": (0.01, 7.0)}
"""Least and most of a joint in a recording that is fitted [rad, m]."""
_SCALES = np.geomspace(1 / 1500, 1500, 37)
_DIRECTIONS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
_SHARE = 0.02
"""Part of a recording in which a limit must act to be named."""
_COMMANDED: Mapping[JointType, float] = {"hinge": 0.05, "slide": 0.005}
"""Travel of a command that moves a joint whose drive is on [rad, m]."""
_FOLLOWED = 0.02
"""Part of that travel which is no motion."""
_STANDS = 2e-3
"""Travel within which a joint stands [rad, m]."""
_FROZEN = 0.1
"""Shortest standstill that is looked at [s]."""
_ABRUPT = 3.0
"""Of the largest change of a step elsewhere: one at an end of a standstill that was none."""
_NUMERICAL = 1e-9
"""Steps that are rounding [rad]."""
_SPIKE = 3.0
"""Of the steps that are larger than most: the two steps of a spike, ..."""
_LEAST_SPIKE: Mapping[JointType, float] = {"hinge": 1e-3, "slide": 1e-4}
"""... and the smallest one [rad, m]."""
_TILT = 15.0
"""Smallest turn of gravity that is named [degrees]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Change:
    """Something that may be wrong with a recording, and the recording without it."""

    joints: tuple[int, ...]
    """Those that it explains."""
    view: View
    """The recording as it should be."""
    text: str
    """What was found, without the joints' names where ``{joints}`` stands, and the cure."""
    limit: tuple[str, float] | None = None
    """Of one joint's drive whose stated limit is wrong: that limit, and the torque that the motion shows [N m]."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a check says of a recording."""

    check: str
    recordings: tuple[str, ...]
    """In which it is found."""
    joints: tuple[str, ...]
    before: float | None
    """Largest misfit of these joints as logged; ``None``: it is seen in the log by itself."""
    after: float
    """With the change."""
    text: str
    stops: bool
    """Whether no fit of the log can be right."""
    imu_delays: Mapping[str, float] = field(default_factory=dict)
    """How much later than the encoders IMUs are read [s], by recording."""
    limits: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    """Wrong limits as in :attr:`Change.limit`, by joint."""

    @property
    def sentence(self) -> str:
        """For a user."""
        sure = (
            ""
            if self.before is None
            else (
                f" (So changed, the drives' torques fit the motion to {100 * self.after:.2g} %; as logged, to "
                f"{100 * self.before:.2g} %.)"
            )
        )
        return f"{listed(self.recordings)}: {self.text.format(joints=listed(self.joints, 6))}{sure}"

    def table(self, types: Mapping[str, JointType]) -> str:
        """Lines below the sentence: wrong limits joint by joint, and the facts to state; else "".

        Args:
            types: Of each joint.
        """
        if not self.limits:
            return ""
        names, pattern = in_short(list(self.limits))
        unit = units_for("N m", [types[joint] for joint in self.limits])
        stated, shown = zip(*self.limits.values(), strict=True)
        seen = "needed" if self.check == "lifted limits" else "seen"
        rows = aligned(
            [
                [f"joint {pattern}".strip(), *names],
                [f"stated [{unit}]", *stated],
                [f"{seen} [{unit}]", *(f"{value:.3g}" for value in shown)],
            ]
        )
        fact = json.dumps({joint: float(f"{value:.3g}") for joint, (_, value) in self.limits.items()})
        return "\n".join(["", *(f"  {row}" for row in rows), f'  "effort_limit": {fact}'])


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """A recording with how well it balances."""

    view: View
    links: Links
    balance: dict[int, Balance]

    @classmethod
    def of(cls, view: View, before: Evidence | None = None, joints: Iterable[int] | None = None) -> Evidence:
        """Of a recording; where only some joints have changed since, the others keep their balance."""
        if before is None or not before.is_same_motion(view):
            links = Links.of(view, None if before is None else before.links)
            return cls(view=view, links=links, balance=balances(view, links, range(len(view.joints))))
        changed = balances(view, before.links, range(len(view.joints)) if joints is None else joints)
        return cls(view=view, links=before.links, balance={**before.balance, **changed})

    def is_same_motion(self, view: View) -> bool:
        """Whether another log has the same positions, so that the links move alike."""
        own = self.view
        return all(
            getattr(view, name) is getattr(own, name)
            for name in ("position", "gravity", "used", "frame", "free", "coarse")
        )

    def coarse(self) -> Evidence:
        """The same at few instants."""
        return Evidence.of(replace(self.view, coarse=True))

    @property
    def doubted(self) -> list[int]:
        """Joints that do not balance, the worst first."""
        return sorted(
            (j for j, each in self.balance.items() if each.misfit > _DOUBTED),
            key=lambda j: -self.balance[j].misfit,
        )


def _column(series: np.ndarray, joint: int | list[int], values: np.ndarray) -> np.ndarray:
    result = series.copy()
    result[:, joint] = values
    return result


def _scaled(view: View, joints: list[int], measured: float | None, commanded: float | None) -> View:
    """Some joints' measured or commanded series times a factor."""
    changes: dict[str, Any] = {}
    if measured is not None:
        changes["position"] = _column(view.position, joints, measured * view.position[:, joints])
    if commanded is not None:
        changes["target"] = _column(view.target, joints, commanded * view.target[:, joints])
        changes["target_vel"] = _column(view.target_vel, joints, commanded * view.target_vel[:, joints])
        if abs(commanded) == 1.0:
            changes["feed_forward"] = _column(view.feed_forward, joints, commanded * view.feed_forward[:, joints])
    return replace(view, **changes)


_SERIES = (
    ((-1.0, None), "the positions (dof_pos)", "sign = -1 for its positions"),
    ((None, -1.0), "the targets (des_dof_pos)", "sign = -1 for its commands"),
    ((-1.0, -1.0), "positions and targets", "sign = -1 for both, or turn the joint's axis in the model"),
)


def _groups(evidence: Evidence) -> list[list[int]]:
    """Joints that may share a fault: each that is doubted, and all."""
    every = list(range(len(evidence.view.joints)))
    return [[j] for j in evidence.doubted] + ([every] if len(every) > 1 and len(evidence.doubted) > 1 else [])


def reversed_sign(evidence: Evidence) -> Iterator[Change]:
    """Positions, targets or both run the other way than the model's axis."""
    for joints in _groups(evidence):
        for (measured, commanded), what, cure in _SERIES:
            yield Change(
                joints=tuple(joints),
                view=_scaled(evidence.view, joints, measured, commanded),
                text=f"{what} of {{joints}} have the opposite sign. In the column map, set {cure}.",
            )


def swapped(evidence: Evidence) -> Iterator[Change]:
    """The columns of two joints are exchanged, in all series, the positions or the targets."""
    view, doubted = evidence.view, evidence.doubted
    every, target = itertools.combinations(sorted(evidence.balance), 2), view.target[view.steps]
    for i, j in (pair for pair in every if not set(pair).isdisjoint(doubted)):  # friction may hide the fault of one
        pair, other = [i, j], [j, i]
        measured: dict[str, Any] = {"position": _column(view.position, pair, view.position[:, other])}
        commanded: dict[str, Any] = {
            key: _column(series, pair, series[:, other])
            for key, series in (
                ("target", view.target), ("target_vel", view.target_vel), ("feed_forward", view.feed_forward),
            )
        }  # fmt: skip
        crossed, own = (np.square(view.position[:, pair] - target[:, each]).sum() for each in (other, pair))
        for changes, what in (
            ({**measured, **commanded}, "all columns"), (measured, "the positions (dof_pos)"),
            (commanded, "the targets (des_dof_pos)"),
        ):  # fmt: skip
            if crossed >= own and not changes.keys() >= measured.keys() | commanded.keys():  # none follows the other's
                continue
            yield Change(
                joints=(i, j),
                view=replace(view, **changes),
                text=f"{what} of {{joints}} are swapped. Exchange their names in the log or in its column map.",
            )


def scaled(evidence: Evidence) -> Iterator[Change]:
    """Series are in another unit, or on the motor's side of a gear."""
    view = evidence.view
    for joints in _groups(evidence):
        if max(evidence.balance[j].misfit for j in joints if j in evidence.balance) < _LARGE:
            continue
        measured, commanded = (
            float(np.ptp(series[:, joints], axis=0).max()) for series in (view.position, view.target)
        )
        for scales, positions, targets, what in (
            (
                _both_scales(min(measured, commanded), {view.types[j] for j in joints}),
                True,
                True,
                "positions and targets",
            ),
            (_scales_about(measured, commanded), True, False, "the positions (dof_pos)"),
            (_scales_about(commanded, measured), False, True, "the targets (des_dof_pos)"),
        ):
            if not len(scales):
                continue

            changed = partial(_divided, view, joints, positions, targets)
            factor = _known(_least(evidence, changed, scales, joints))
            if abs(np.log(factor)) > np.log(_TWICE):
                yield Change(
                    joints=tuple(joints),
                    view=changed(factor),
                    text=f"{what} of {{joints}} are {factor:.4g} times those of the joint. {_cure_of(factor)}",
                )


def _divided(view: View, joints: list[int], positions: bool, targets: bool, factor: float) -> View:
    return _scaled(view, joints, 1 / factor if positions else None, 1 / factor if targets else None)


def _both_scales(travel: float, types: set[JointType]) -> np.ndarray:
    """Factors that leave the travel of joints of some types one that is usual."""
    least, most = zip(*(_TRAVEL[each] for each in types), strict=True)
    own = travel / _SCALES
    return _SCALES[(own > min(least)) & (own < max(most)) & (abs(np.log(_SCALES)) > 0.5)]


def _scales_about(one: float, other: float) -> np.ndarray:
    """Factors about that between the travels of one series and another, where they differ."""
    if min(one, other) <= 0 or abs(np.log(one / other)) < np.log(_TWICE):
        return np.zeros(0)
    return one / other * np.geomspace(0.3, 3.0, 7)


_UNITS = (
    (180 / np.pi, "degrees"), (np.pi / 180, "radians that were taken for degrees"), (1 / (2 * np.pi), "turns"),
    (1000.0, "thousandths"), (0.001, "thousands"),
)  # fmt: skip
_NEAR = 0.05
"""Relative distance within which a factor is that of a unit, or a gear's whole ratio."""
_LARGEST_GEAR = 400.0
"""A factor beyond that of any gear is that of a unit."""


def _known(factor: float) -> float:
    """The factor of a unit or a gear that is nearest, if one is near."""
    whole = round(factor) if factor > 1 else 1 / round(1 / factor)
    is_unit = abs(np.log(factor)) > np.log(_LARGEST_GEAR)
    known = [value for value, _ in _UNITS] + [float(whole)] * (not is_unit)
    nearest = min(known, key=lambda value: abs(np.log(factor / value)))
    return nearest if is_unit or abs(factor / nearest - 1) < _NEAR else factor


def _cure_of(factor: float) -> str:
    for value, unit in _UNITS:
        if factor == value:
            return f"They are in {unit}: state the unit in the column map."
    return f"They lie on the motor's side of a gear of {factor:.3g}: state gear_ratio in the column map."


def wrapped_targets(evidence: Evidence) -> Iterator[Change]:
    """Targets jump by a turn where the positions go on."""
    view = evidence.view
    at = np.arange(len(view.target))
    for j in evidence.doubted:
        position = np.interp(at, view.steps, view.position[:, j])
        turns = np.round((position - view.target[:, j]) / (2 * np.pi))
        if turns.any():
            when = view.control_dt * float(np.flatnonzero(turns)[0])
            yield Change(
                joints=(j,),
                view=replace(view, target=_column(view.target, j, view.target[:, j] + 2 * np.pi * turns)),
                text=f"the targets of {{joints}} are wrapped: from {when:.3g} s on they differ by whole turns from the "
                "positions. Apply numpy.unwrap to the targets.",
            )


_LONGER_THAN_HELD = 4
"""Times the time for which a command is usually held: a target that stays at its end for longer is cut."""


def clipped_targets(evidence: Evidence) -> Iterator[Change]:
    """The log and the drive disagree on where targets end."""
    view = evidence.view
    for j in evidence.doubted:
        target = view.target[:, j]
        low, high = view.ranges[j]
        if np.isfinite([low, high]).all() and (target.min() < low or target.max() > high):
            yield Change(
                joints=(j,),
                view=replace(view, target=_column(view.target, j, np.clip(target, low, high))),
                text=f"the drive of {{joints}} cuts its targets at the joint's range, {low:.4g} to {high:.4g}; the log "
                "has them uncut. Cut des_dof_pos there.",
            )
        flat = _flat_ends(target)
        if flat.any():
            late = evidence.balance[j].delay + view.most_delay // 10 + 1
            heard = np.convolve(flat, np.ones(late + 1), "full")[: len(flat)] > 0.5  # until the drive has heard others
            yield Change(
                joints=(j,),
                view=without(view, heard[view.steps]),
                text=f"the logged targets of {{joints}} are cut at {target.min():.4g} and {target.max():.4g}, first at "
                f"{view.control_dt * float(np.flatnonzero(flat)[0]):.3g} s; the drive followed others. Log what it "
                "gets, or leave these times out.",
            )


def _flat_ends(target: np.ndarray) -> np.ndarray:
    """Where a target stays at its largest or smallest value for longer than commands are held, (G,) bool."""
    begins = np.flatnonzero(np.diff(target, prepend=np.nan) != 0)
    lengths = np.diff(begins, append=len(target))
    stays = np.repeat(lengths > _LONGER_THAN_HELD * np.median(lengths), lengths)
    return stays & ((target == target.max()) | (target == target.min()))


def lifted_limits(evidence: Evidence) -> Iterator[Change]:
    """The drive gives more than its stated limits."""
    view = evidence.view
    for j in _of_known_gains(evidence):
        given, asked = view.given(j), view.asked(j)
        if np.mean(np.abs(given - asked) > 1e-6 * np.abs(asked)) > _SHARE:
            begin, limit = "{joints} give what the gains ask for, which is beyond the stated ", None
            where = "in the facts (--facts FILE, or NAME.json beside the log)"
            if np.isfinite(view.saturation_effort[j]) and np.isfinite(view.velocity_limit[j]):
                text = f"{begin}torque-speed line. State the real saturation_effort and velocity_limit {where}."
            else:
                limit = _limits_of(view, j), float(np.abs(asked).max())
                text = (
                    f"{begin}limit. State the real effort_limit {where}: it replaces the model's and widens the "
                    "bounds. If you do not know it, use the line below, which no longer cuts this motion."
                )
            yield Change(joints=(j,), view=_without_limits(view, j), text=text, limit=limit)


def _without_limits(view: View, j: int) -> View:
    """A recording whose drive of one joint gives what is asked for."""
    limits = {name: getattr(view, name).copy() for name in ("effort_limit", "saturation_effort")}
    for values in limits.values():
        values[j] = np.inf
    return replace(view, **limits)


def _limited(view: View, j: int, limit: float) -> View:
    limits = view.effort_limit.copy()
    limits[j] = limit
    return replace(view, effort_limit=limits)


def _limits_of(view: View, j: int) -> str:
    """The limits of a joint's drive, for a table."""
    limit, stall, fastest = view.effort_limit[j], view.saturation_effort[j], view.velocity_limit[j]
    told = [f"{limit:.3g}"] if np.isfinite(limit) else []
    if np.isfinite(stall) and np.isfinite(fastest):
        told.append(f"{stall:.3g} at stall, 0 at {fastest:.3g} rad/s")
    return units_for("; ".join(told), [view.types[j]]) or "no limit"


def _of_known_gains(evidence: Evidence) -> list[int]:
    """Doubted joints whose torque is known: with assumed gains it may be any multiple of what it is."""
    return [j for j in evidence.doubted if not evidence.view.assumed[j]]


def torque_limit(evidence: Evidence) -> Iterator[Change]:
    """The drive's torque is limited, and the limit is not stated."""
    view = evidence.view
    for j in _of_known_gains(evidence):
        most = np.quantile(np.abs(view.asked(j)), np.linspace(0.3, 0.995, 15))
        most = most[most > 0.0]  # of a drive that mostly gives none
        if len(most) < 2:
            continue

        changed = partial(_limited, view, j)
        limit = _least(evidence, changed, most, [j])
        if limit < view.effort_limit[j] and np.mean(np.abs(view.asked(j)) > limit) > _SHARE:
            yield Change(
                joints=(j,),
                view=changed(limit),
                text="the torque of {joints} ends below any limit that is stated. State the real effort_limit in the "
                "facts (--facts FILE, or NAME.json beside the log), or let it be sought: --unknown effort_limit.",
                limit=(_limits_of(view, j), limit),
            )


def turned_gravity(evidence: Evidence) -> Iterator[Change]:
    """Gravity points elsewhere than in the model: the robot lies, or its base is tilted."""
    few = evidence.coarse()
    view, links = few.view, few.links
    if view.frame is not None:
        return
    g = float(np.linalg.norm(view.gravity))
    if not evidence.doubted or g == 0.0:
        return
    pull = np.stack(
        [Links.of(replace(view, gravity=view.gravity + axis)).torque - links.torque for axis in np.eye(3)], axis=-1
    )
    judged = [j for j in few.balance if np.ptp(pull[:, j], axis=0).max() > 0]
    free = balances(view, links, [j for j in evidence.doubted if j in few.balance], pull)
    if not any(each.misfit < _WORTH * few.balance[j].misfit for j, each in free.items()):
        return

    def misfit(direction: np.ndarray) -> float:
        gravity = g * direction / np.linalg.norm(direction)
        turned = replace(links, torque=links.torque + pull @ (gravity - view.gravity))
        found = balances(view, turned, judged)
        return float(sum(np.log(each.misfit) for each in found.values()))

    start = min(_DIRECTIONS, key=misfit)
    found = minimize(misfit, start, method="Nelder-Mead", options={"maxfev": 60, "xatol": 1e-2, "fatol": 1e-2}).x
    gravity = g * found / np.linalg.norm(found)
    angle = float(np.degrees(np.arccos(np.clip(gravity @ view.gravity / g**2, -1, 1))))
    if angle > _TILT:
        yield Change(
            joints=tuple(j for j in judged if j in evidence.doubted),
            view=replace(evidence.view, gravity=gravity),
            text=f"gravity points along ({', '.join(f'{v:.2f}' for v in gravity / g)}), {angle:.0f}° from the model's "
            "direction: the robot lies or its base is tilted. Turn the base in the model, or its option gravity.",
        )


def imu_units(evidence: Evidence) -> Iterator[Change]:
    """What the IMU shows is in other units."""
    yield from _of_imu(evidence, other_units)


def imu_axes(evidence: Evidence) -> Iterator[Change]:
    """The IMU is turned, or its axes are exchanged."""
    yield from _of_imu(evidence, other_axes)


def _of_imu(evidence: Evidence, changed: Callable[[View], Iterator[tuple[View, str]]]) -> Iterator[Change]:
    if joints := tuple(evidence.doubted):
        for view, text in changed(evidence.view):
            yield Change(joints=joints, view=view, text=text)


def _of_base(view: View, evidence: Evidence) -> list[Finding]:
    """What is seen of a base that moves once all else has been looked at: an IMU that is late, contacts that stick."""
    result = []
    if (found := late(evidence.view)) is not None:
        change = Change(
            joints=tuple(evidence.balance),
            view=found[0],
            text=f"the IMU is {1e3 * abs(found[1]):.2g} ms {'later' if found[1] > 0 else 'earlier'} than the encoders. "
            "It is shifted by that for the fit. Correct its time stamps.",
        )
        result.append(replace(_finding("IMU delay", change), imu_delays={view.name: found[1]}))
    for joints, text in stuck_contacts(view, lambda: evidence.doubted):
        result.append(_finding("contacts", Change(joints=tuple(joints), view=view, text=text)))
    return result


def _least(evidence: Evidence, changed: Callable[[float], View], values: np.ndarray, joints: list[int]) -> float:
    """The value of which the balance is best at few instants; refined between its neighbours."""
    coarse = evidence.coarse()

    def misfit(value: float) -> float:
        view = replace(changed(float(np.exp(value))), coarse=True)
        links = coarse.links if coarse.is_same_motion(view) else Links.of(view, coarse.links)
        return float(sum(np.log(each.misfit) for each in balances(view, links, joints).values()))

    values = np.log(np.sort(values))
    best = int(np.argmin([misfit(value) for value in values]))
    bounds = values[max(best - 1, 0)], values[min(best + 1, len(values) - 1)]
    fine = minimize_scalar(misfit, bounds=bounds, method="bounded", options={"maxiter": 12})
    return float(np.exp(fine.x))


def standstill(view: View) -> Iterator[Change]:
    """The log shows no motion: the encoder is dead, or the drive off."""
    travel = np.maximum(
        np.ptp(view.target, axis=0), np.ptp(np.cumsum(view.target_vel, axis=0), axis=0) * view.control_dt
    )
    moved = np.ptp(view.smooth(view.position), axis=0)
    still = [
        j for j, kind in enumerate(view.types) if travel[j] > _COMMANDED[kind] and moved[j] < _FOLLOWED * travel[j]
    ]
    dead = [j for j in still if np.ptp(view.position[:, j]) == 0.0]
    for joints, what, cure in (
        (dead, "never changes", "the encoder is dead or not logged, or the joint is blocked"),
        ([j for j in still if j not in dead], "stands still", "the drive is off or too weak, or the joint is blocked"),
    ):
        for j in joints:
            yield Change(
                joints=(j,),
                view=view,
                text=f"the position of {{joints}} {what} while its command travels {travel[j]:.3g}: {cure}. Leave the "
                "recording out, or log the joint.",
            )


def frozen_encoder(view: View) -> Iterator[Change]:
    """A position keeps its value for a while; it stops, or goes on, more abruptly than anything else it does."""
    shortest = max(5, round(_FROZEN / view.dt))
    for j in range(len(view.joints)):
        step = np.diff(view.position[:, j])
        runs = [(a, b) for a, b in _runs(step == 0.0) if b - a >= shortest]
        jerk = np.abs(np.diff(step, prepend=step[0], append=step[-1]))  # of sample k: between the steps around it
        ends = [k for run in runs for k in run]
        outside = np.ones(len(jerk), dtype=bool)
        outside[[k for end in ends for k in (end - 1, end, end + 1) if k < len(jerk)]] = False
        count = float(np.abs(step)[np.abs(step) > _NUMERICAL].min(initial=np.inf))  # of an encoder, at least
        usual = max(float(jerk[outside].max(initial=0.0)), count)
        frozen = [
            (a, b)
            for a, b in runs
            if max(jerk[a], jerk[b]) > _ABRUPT * usual
            and np.ptp(view.target[view.steps[a] : view.steps[b], j]) > _COMMANDED[view.types[j]]
        ]
        if not frozen:
            continue
        where = np.zeros(len(view.position), dtype=bool)
        for a, b in frozen:
            where[a : b + 1] = True
        (a, b), more = frozen[0], len(frozen) - 1
        yield Change(
            joints=(j,),
            view=without(view, where),
            text=f"the position of {{joints}} is frozen from {a * view.dt:.4g} to {b * view.dt:.4g} s"
            f"{f', and {more} times more' if more else ''}: it stops or goes on {max(jerk[a], jerk[b]) / usual:.0f} "
            "times as abruptly as elsewhere. Cut the recording there.",
        )


def spikes(view: View) -> Iterator[Change]:
    """Single positions lie far from their neighbours."""
    for j in range(len(view.joints)):
        position = view.position[:, j]
        found = _spikes_of(position, _LEAST_SPIKE[view.types[j]])
        if found.any():
            first = float(np.flatnonzero(found)[0] * view.dt)
            at = np.arange(len(position))
            yield Change(
                joints=(j,),
                view=replace(view, position=_column(view.position, j, np.interp(at, at[~found], position[~found]))),
                text=f"{found.sum()} positions of {{joints}} are spikes, the first at {first:.4g} s. Leave those rows "
                "out.",
            )


def _spikes_of(position: np.ndarray, least: float) -> np.ndarray:
    """Up to three samples away from both neighbours, by steps that are large for the recording, (K,) bool."""
    step = np.diff(position)
    least = max(_SPIKE * float(np.quantile(np.abs(step), 0.98)), 0.01 * float(np.ptp(position)), least)
    found = np.zeros(len(position), dtype=bool)
    for a in np.flatnonzero(np.abs(step) > least):
        for length in (1, 2, 3):
            b = a + length
            if b >= len(step) or a < 1 or b + 1 >= len(step):
                break
            there, back = step[a], step[b]
            beside = max(abs(step[a - 1]), abs(step[b + 1]))
            if (
                there * back < 0
                and abs(there + back) < 0.5 * abs(there)
                and min(abs(there), abs(back)) > _SPIKE * beside
            ):
                found[a + 1 : b + 1] = True
    return found


def _runs(where: np.ndarray) -> list[tuple[int, int]]:
    """Beginnings and ends of what is true without a break."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


_SIGHTS: Mapping[str, Callable[[View], Iterator[Change]]] = {
    "standstill": standstill,
    "frozen encoder": frozen_encoder,
    "spikes": spikes,
}
"""What is seen in a log by itself."""
_CHECKS: Mapping[str, Callable[[Evidence], Iterator[Change]]] = {
    "IMU units": imu_units,
    "IMU axes": imu_axes,
    "reversed sign": reversed_sign,
    "swapped joints": swapped,
    "wrapped targets": wrapped_targets,
    "clipped targets": clipped_targets,
    "gravity": turned_gravity,
    "torque limit": torque_limit,
    "scale": scaled,
}
"""Changes of a log, or of what is taken for granted, that are worth trying."""
_GOES_ON = ("spikes", "gravity", "torque limit", "lifted limits", "IMU delay", "contacts")
"""Checks after which a fit can be right."""


def explained(view: View) -> list[Finding]:
    """What is wrong with a recording, change by change."""
    findings = []
    for check, changes in _SIGHTS.items():
        for change in list(changes(view)):
            findings.append(_finding(check, change))
            joints = list(change.joints)
            position = _column(view.position, joints, change.view.position[:, joints])
            view = replace(view, position=position, used=view.used & change.view.used)
    before = evidence = Evidence.of(view)
    for change in list(lifted_limits(evidence)):
        (j,) = change.joints
        after = Evidence.of(_without_limits(evidence.view, j), evidence, change.joints)
        if _gain(evidence, after, change) > 0:
            findings.append(_finding("lifted limits", change, evidence.balance[j].misfit, after.balance[j].misfit))
            evidence = after
    named: list[tuple[str, Change]] = []
    for _ in range(2 * len(view.joints) + 1):
        step = _best_change(evidence)
        if step is None:
            break
        check, change, evidence = step
        named.append((check, change))
    for check, change in named:
        misfits = [evidence.balance[j].misfit for j in change.joints if j in evidence.balance]
        if misfits and max(misfits) < _EXPLAINED:
            at_first = max(before.balance[j].misfit for j in change.joints if j in before.balance)
            findings.append(_finding(check, change, at_first, max(misfits)))
    return findings if view.frame is None else findings + _of_base(view, evidence)


def _finding(check: str, change: Change, before: float | None = None, after: float = 0.0) -> Finding:
    names = tuple(change.view.joints[j] for j in sorted(change.joints))
    return Finding(
        check=check, recordings=(change.view.name,), joints=names, before=before, after=after,
        text=change.text, stops=check not in _GOES_ON, limits={names[0]: change.limit} if change.limit else {},
    )  # fmt: skip


def _best_change(evidence: Evidence) -> tuple[str, Change, Evidence] | None:
    """The change that explains most; the first after which nothing is doubted."""
    best: tuple[float, str, Change, Evidence] | None = None
    coarse = evidence.coarse()
    for check, changes in _CHECKS.items():
        for change in changes(evidence):
            if not _may_explain(coarse, change):
                continue
            after = Evidence.of(change.view, evidence, change.joints)
            gain = _gain(evidence, after, change)
            if gain > 0 and (best is None or gain > best[0]):
                best = gain, check, change, after
                if not after.doubted:
                    return best[1:]
    return None if best is None else best[1:]


def _may_explain(coarse: Evidence, change: Change) -> bool:
    """Whether a change helps its own joints at the few instants that are looked at first."""
    view = replace(change.view, coarse=True)
    links = coarse.links if coarse.is_same_motion(view) else Links.of(view, coarse.links)
    found = balances(view, links, change.joints)
    ratio = [each.misfit / coarse.balance[j].misfit for j, each in found.items() if j in coarse.balance]
    return bool(ratio) and bool(np.exp(np.mean(np.log(ratio))) < _WORTH)


def _gain(before: Evidence, after: Evidence, change: Change) -> float:
    """By how much a change explains a recording better, in natural logarithms of misfits; 0 if it does not count."""
    both = [j for j in before.balance if j in after.balance]
    ratio = {j: after.balance[j].misfit / before.balance[j].misfit for j in both}
    own = [ratio[j] for j in change.joints if j in ratio]
    if not own or max(own) > _NOT_WORSE or np.exp(np.mean(np.log(own))) > _BETTER:
        return 0.0
    return -float(sum(np.log(ratio[j]) for j in both))


def check_log(problem: Problem) -> list[Finding]:
    """What is wrong with the recordings of a problem; the same of several comes once."""
    merged: dict[tuple[str, tuple[str, ...]], list[Finding]] = {}
    views = views_of(problem)
    if all(np.ptp(view.position, axis=0).max() < _STANDS for view in views):
        text = (
            f"no joint moves by {1e3 * _STANDS:g} mrad or mm: a robot that stands shows no parameter. Record a motion."
        )
        still = Change(joints=tuple(range(len(views[0].joints))), view=views[0], text=text)
        return [replace(_finding("standstill", still), recordings=tuple(view.name for view in views))]
    for view in views:
        for finding in explained(view):
            merged.setdefault((finding.check, finding.joints), []).append(finding)
    return _with_limits_together(
        [
            replace(
                each[0],
                recordings=tuple(f.recordings[0] for f in each),
                imu_delays={name: delay for f in each for name, delay in f.imu_delays.items()},
                limits={name: max((f.limits[name] for f in each), key=lambda own: own[1]) for name in each[0].limits},
            )
            for each in merged.values()
        ],
        views[0].joints,
    )


def _with_limits_together(found: list[Finding], order: Sequence[str]) -> list[Finding]:
    """Findings with one of each check for all joints whose limits are wrong, in the robot's order."""
    result: list[Finding] = []
    for each in found:
        at = next((i for i, one in enumerate(result) if each.limits and one.limits and one.check == each.check), None)
        if at is None:
            result.append(each)
            continue
        one, joints = result[at], sorted((*result[at].joints, *each.joints), key=list(order).index)
        limits = {**one.limits, **each.limits}
        result[at] = replace(
            one,
            recordings=tuple(dict.fromkeys((*one.recordings, *each.recordings))),
            joints=tuple(joints),
            before=max(one.before or 0.0, each.before or 0.0),
            after=max(one.after, each.after),
            limits={joint: limits[joint] for joint in joints},
        )
    return result


def checked(problem: Problem, trust: bool = False, tell: Callable[[str], None] = tell_nobody) -> Problem:
    """The problem with what is wrong with its log among its contradictions, and with IMUs that are late in time.

    Args:
        trust: Whether a log that no fit can be right of is only warned of.
        tell: Gets what is wrong before the fit begins.
    """
    found = check_log(problem)
    if (wrong := [each.sentence for each in found if each.stops]) and not trust:
        raise ValueError(f"{' '.join(wrong)} If the log is right as it is, give --trust_log.")
    types = dict(zip(problem.joint_names, problem.joint_types, strict=True))
    said = tuple(f"{each.sentence} [W3]{each.table(types)}" for each in found)
    for each in said:
        tell(f"warning: {each}")
    problem = problem.with_imu_delays(_delays_of_whole(problem, found))
    return replace(problem, contradictions=(*problem.contradictions, *said))


def _delays_of_whole(problem: Problem, found: Iterable[Finding]) -> dict[str, float]:
    """How late IMUs are, by whole recording: the median of those of its parts, if more than half of them show one."""
    shown = {name: delay for each in found for name, delay in each.imu_delays.items()}
    parts: dict[str, list[float]] = {}
    for recording in problem.dataset.recordings:
        parts.setdefault(recording.part_of or recording.name, []).append(shown.get(recording.name, 0.0))
    return {name: delay for name, delays in parts.items() if (delay := float(np.median(delays)))}
