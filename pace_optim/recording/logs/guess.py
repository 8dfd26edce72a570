"""A column map for a log that comes without one: from the formats, the names and the numbers themselves."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from pace_actuators.joint_units import JointType
from pace_actuators.text import listed
from pace_optim.recording.keys import COMMAND_SERIES, CONDITIONS, JOINT_SERIES, MEASURED_SERIES
from pace_optim.recording.time_base import held

from .base import NO_BASE, BaseMap, guess_base
from .column_map import ColumnMap, Source
from .log import Channel, Log
from .units import Known, guessed_units, no_slopes
from .words import (
    CURRENTS,
    GAINS,
    NEED_FACTOR,
    POSITION,
    UNITS,
    VELOCITY,
    is_other,
    joint_places,
    match,
    meaning,
    only_numbers,
)

_PLANNED = re.compile(r":(positions|velocities|effort|(desired|reference|output)\.\w+)\[")
"""Of a trajectory or a controller's state: its speeds and torques are those of the plan, which few drives get."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """What is known of the robot that a log is of."""

    joint_names: tuple[str, ...] = ()
    """In order; () where no robot is known: the log's own names are kept."""
    limits: np.ndarray | None = None
    """Lower and upper limit of each joint, (n, 2) [rad]; infinite without a limit."""
    wanted: tuple[str, ...] = ()
    """Those of them that a log must have; (): the ones that it names, if it names no others."""
    joint_types: tuple[JointType, ...] = ()
    """Whether each joint turns or slides; none where it is not known."""
    stiffness: np.ndarray | None = None
    """kp of each joint's drive, (n,) [N m/rad]; NaN where it is not stated."""
    effort_limit: np.ndarray | None = None
    """Largest torque of each joint's drive, (n,) [N m]; infinite where it is not stated."""

    def joint_type(self, joint: str) -> JointType:
        """Whether a joint turns or slides; what is not known turns."""
        types = dict(zip(self.joint_names, self.joint_types, strict=False))
        return types.get(joint, "hinge")

    def known(self, joint: str, stated: Mapping[str, Channel], given: Mapping[str, Channel]) -> Known:
        """What is known of a joint, beside its series in SI units and as logged."""
        j = self.joint_names.index(joint) if joint in self.joint_names else None
        numbers: dict[str, Any] = {}
        if j is not None:
            numbers = {
                name: float(values[j])
                for name in ("stiffness", "effort_limit")
                if (values := getattr(self, name)) is not None
            }
            if self.limits is not None:
                numbers["limits"] = (float(self.limits[j, 0]), float(self.limits[j, 1]))
        return Known(joint_type=self.joint_type(joint), stated=stated, given=given, **numbers)


@dataclass(frozen=True, kw_only=True)
class Guess:
    """A column map, and what is to be said of it."""

    columns: ColumnMap
    notes: tuple[str, ...]
    missing: tuple[str, ...]
    """All that a recording needs and that was not found."""
    unit_stated: tuple[str, ...] = ()
    """Joints whose positions' unit the log states."""
    facts_from: tuple[str, ...] = ()
    """Channels that facts were read from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    channel: Channel
    series: str
    label: str
    unit: str
    unknown_unit: str = ""


def guess_map(log: Log, robot: Robot, channels: Mapping[str, Channel] | None = None, base: BaseMap = NO_BASE) -> Guess:
    """Find which channel is which series of which joint.

    Args:
        robot: The robot, as far as it is known.
        channels: What units are read from, by key: those of all logs with the same columns (:func:`as_one`).
        base: What a column map says of the base; it is guessed where that has no channels.
    """
    notes: list[str] = []
    places = joint_places((channel.name for channel in log.channels.values()), robot.joint_names)
    candidates = [found for channel in log.channels.values() if (found := _candidate(channel, places)) is not None]
    if robot.joint_names:  # feet may have commands too
        candidates = [
            c for c in candidates if not is_other(c.label) or _meant(c.label, robot.joint_names, robot.wanted)
        ]
    unknown = [c for c in candidates if c.unknown_unit]
    if gains := [c.channel.key for c in unknown if c.series in GAINS.values()]:
        notes.append(
            f"{listed(gains)}: gains, expected SI units (N m/rad, N m s/rad), so not used. State them so with --facts."
        )
    if others := [c.channel.key for c in unknown if c.series not in GAINS.values()]:
        notes.append(
            f"{listed(others)}: the unit is not known, so not used. Map it with a known unit "
            'and a factor, such as unit = "N m", factor = 0.113.'
        )
    candidates = _once([c for c in candidates if not c.unknown_unit], notes)
    names = robot.joint_names or _own_names(candidates)
    groups: dict[tuple[str, str], list[_Candidate]] = defaultdict(list)
    for each in candidates:
        groups[each.channel.table, each.series].append(each)
    chosen: dict[str, dict[str, tuple[tuple[float, int, int], _Candidate]]] = {name: {} for name in names}
    named = {
        c.channel.table for c in candidates if not only_numbers([c.label]) and _meant(c.label, names, robot.wanted)
    }
    for series in (*JOINT_SERIES, *GAINS.values()):
        for (table, of), group in groups.items():
            if of != series:
                continue
            if _one_for_all(series, group, names):
                pairs = [(name, 0.3, group[0]) for name in names]
            else:
                pairs = _by_name(group, names, robot.wanted)
                pairs = pairs or _by_place(group, robot.wanted or names, chosen, table in named, notes)
            for name, score, each in pairs:
                rank = (score, len(pairs), len(each.channel.time))
                if series not in chosen[name] or rank > chosen[name][series][0]:
                    chosen[name][series] = (rank, each)
    picked = {name: {s: c for s, (_, c) in sorted(by.items(), key=_order)} for name, by in chosen.items()}
    facts, more = _gains({name: by for name, by in picked.items() if set(COMMAND_SERIES) & set(by)})
    facts_from = {by[fact].channel.key for by in picked.values() for fact in facts if fact in by}
    notes += more
    picked = _without_plans(picked, notes)
    sources, more = _with_units(picked, robot, names, channels or log.channels)
    notes += more
    if not any(s in COMMAND_SERIES for by in sources.values() for s in by):
        _effort_as_command(sources, notes)
    switches = [c.channel for c in candidates if c.series == "torque_enable"]
    enable, more = _enable(switches)
    facts_from |= {channel.key for channel in switches} if enable else set()
    base, of_base = (base, list[str]()) if base.channels else guess_base(log)
    missing = _missing(sources, robot.wanted or _found(sources, robot, candidates) or names)
    more = [*more, *of_base, *(_foreign(candidates, robot) if missing else [])]
    return Guess(
        columns=ColumnMap(joints=sources, facts=facts, torque_enable=enable, base=base),
        notes=(*notes, *more),
        missing=tuple(missing),
        unit_stated=tuple(name for name, by in picked.items() if "dof_pos" in by and by["dof_pos"].unit),
        facts_from=tuple(facts_from),
    )


def _one_for_all(series: str, group: Sequence[_Candidate], names: Sequence[str]) -> bool:
    """Whether a column is of all joints: a gain without a joint's name, the voltage of a battery."""
    if series in GAINS.values():
        return [each.label for each in group] == [""]
    return series in CONDITIONS and len(group) == 1 and not match(group[0].label, names)


def _enable(channels: Sequence[Channel]) -> tuple[str, list[str]]:
    """The column that says whether the drives give torque; columns of several joints must say the same."""
    switches = [each for each in channels if np.all((each.values == 0) | (each.values == 1))]
    if not switches:
        return "", []
    first = switches[0]
    if any(not np.array_equal(first.values, other.values) for other in switches):
        raise ValueError(
            f"{listed(each.key for each in switches)}: the drives of some joints are off while others' are on, which "
            "no recording can say. Cut the log there, or leave these columns out."
        )
    off = float(np.mean(first.values == 0))
    return first.key, [f"{first.key} says whether the drives give torque: they are off in {off:.0%} of the rows."]


def _gains(picked: Mapping[str, Mapping[str, _Candidate]]) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Gains that the log has as columns, where they stay the same, and notes."""
    facts: dict[str, dict[str, float]] = {}
    notes = []
    for fact in dict.fromkeys(GAINS.values()):
        found = {name: by[fact].channel for name, by in picked.items() if fact in by}
        if changing := [channel.key for channel in found.values() if np.ptp(channel.values) > 0]:
            notes.append(
                f"{listed(changing)}: the gain changes in the log, and a recording has one {fact} for each joint: "
                "not used. Cut the log there."
            )
        elif len(found) == len(picked) > 0:
            facts[fact] = {name: float(channel.values[0]) for name, channel in found.items()}
            values = listed((f"{value:g} ({name})" for name, value in facts[fact].items()), 6)
            notes.append(f"{fact}, by the log's own columns: {values}.")
    return facts, notes


def _order(entry: tuple[str, object]) -> int:
    return (*JOINT_SERIES, *GAINS.values()).index(entry[0])


def _candidate(channel: Channel, places: Mapping[str, tuple[int, int]]) -> _Candidate | None:
    if channel.series:
        told = meaning("x", channel.table).commanded and not channel.series.startswith("des_")
        return _Candidate(
            channel=channel, series=("des_" if told else "") + channel.series, label=channel.joint, unit=""
        )
    said = meaning(channel.name, channel.table, places.get(channel.name))
    if not said.quantity:
        return None
    label = "_".join(said.joint)
    if channel.table and (not label or only_numbers([label]) or label == "data"):
        around = meaning(channel.table.strip("/").replace("/", "_")).joint
        place = [word for word in said.joint if word.isdigit()]
        label = "_".join(place or [word for word in around if word not in ("controller", "controllers", "forward")])
    commanded = said.commanded and said.quantity in MEASURED_SERIES
    unknown = said.unknown_unit
    if unknown.lower() == "raw" and said.quantity in (POSITION, VELOCITY) and np.any(channel.values % 1):
        unknown = ""  # no counts, so the numbers show the unit
    return _Candidate(
        channel=channel,
        series=("des_" if commanded else "") + said.quantity,
        label=label,
        unit=said.unit,
        unknown_unit=unknown,
    )


def _once(candidates: Sequence[_Candidate], notes: list[str]) -> list[_Candidate]:
    """Without series that the log has in a second unit: the SI one is kept. Those that differ are all left out."""
    same: dict[tuple[str, str, str], list[_Candidate]] = defaultdict(list)
    for each in candidates:
        same[each.channel.table, each.series, each.label].append(each)
    kept: list[_Candidate] = []
    for those in same.values():
        units = {each.unit for each in those} - set(NEED_FACTOR) - {""}
        if len(those) == 1 or len(units) < len(those):
            kept += those
            continue
        first, *others = sorted(those, key=lambda each: UNITS[each.series.removeprefix("des_")][each.unit] != 1.0)
        if all(_agree(first, other) for other in others):
            kept.append(first)
        else:
            keys = listed(each.channel.key for each in those)
            notes.append(f"{keys}: one series in several units, and their values differ: not used. Map one of them.")
    return [each for each in candidates if any(each is one for one in kept)]


def _agree(one: _Candidate, other: _Candidate) -> bool:
    """Whether two channels are one series in two units."""
    if len(one.channel.values) != len(other.channel.values):
        return False
    first, second = (_scaled(each.channel, each.series, each.unit).values for each in (one, other))
    return bool(np.allclose(first, second, rtol=0.0, atol=1e-3 * float(np.ptp(first)) + 1e-9))


def _own_names(candidates: Sequence[_Candidate]) -> tuple[str, ...]:
    """The joints that have a position in the log, and a command where any has, as it calls them."""
    names = tuple(dict.fromkeys(c.label or "joint" for c in candidates if c.series == "dof_pos"))
    told = [c.label for c in candidates if c.series in COMMAND_SERIES]
    if only_numbers(told):
        return names
    meant = {found[0] for label in told if (found := match(label, names))}
    return tuple(name for name in names if name in meant) or names


def _meant(label: str, names: Sequence[str], wanted: Sequence[str]) -> tuple[str, float] | None:
    """The joint that a label means; one of those wanted where it could be several."""
    return match(label, names) or match(label, wanted)


def _by_name(
    group: Sequence[_Candidate], names: Sequence[str], wanted: Sequence[str]
) -> list[tuple[str, float, _Candidate]]:
    found: dict[str, list[tuple[float, _Candidate]]] = defaultdict(list)
    for each in group:
        if each.label and (meant := _meant(each.label, names, wanted)):
            found[meant[0]].append((meant[1], each))
    pairs = []
    for name, those in found.items():
        best = max(score for score, _ in those)
        winners = [each for score, each in those if score == best]
        if len(winners) == 1:
            pairs.append((name, best, winners[0]))
    return pairs


def _by_place(
    group: Sequence[_Candidate],
    names: Sequence[str],
    chosen: dict[str, dict[str, tuple[tuple[float, int, int], _Candidate]]],
    has_names: bool,
    notes: list[str],
) -> list[tuple[str, float, _Candidate]]:
    """Columns without names of joints: in the robot's order, or in that in which they follow the motion.

    Not where the log names joints elsewhere, or where numbers are left out: then places could mislead.
    """
    if len(group) != len(names) or not only_numbers(each.label for each in group):
        return []
    if len(names) > 1 and (has_names or not _counted([each.label for each in group])):
        why = "the log names joints in other columns" if has_names else "their numbers leave some out"
        notes.append(
            f"{listed(each.channel.key for each in group)} name no joint of the robot, and {why}: not taken by their "
            "places. If they are in the robot's order, say so in a column map."
        )
        return []
    what = f"{group[0].channel.key} … {group[-1].channel.key}" if len(group) > 1 else group[0].channel.key
    measured = [chosen[name].get("dof_pos") for name in names]
    if len(names) > 1 and group[0].series == "des_dof_pos" and all(measured):
        cost = np.array([[_distance(each.channel, m[1].channel) for m in measured if m] for each in group])
        rows, columns = linear_sum_assignment(cost)
        order = [names[j] for j in columns]
        notes.append(f"{what} name no joints: by the motions that follow them they are {listed(order)}.")
        return [(names[j], 0.5, group[i]) for i, j in zip(rows, columns, strict=True)]
    if len(names) > 1:
        notes.append(f"{what} name no joints: taken in the order {listed(names)}.")
    return [(name, 0.4, each) for name, each in zip(names, group, strict=True)]


def _counted(labels: Sequence[str]) -> bool:
    """Whether labels count through: 0, 1, 2 or 1, 2, 3, in their order, or have no number at all."""
    numbers = [int(digits[-1]) if (digits := re.findall(r"\d+", label)) else None for label in labels]
    if all(number is None for number in numbers):
        return len(labels) == 1
    return numbers in (list(range(len(labels))), list(range(1, len(labels) + 1)))


def _distance(command: Channel, position: Channel) -> float:
    """How far a position is from a command (rms), in units of the position's own motion."""
    error = held(command.time, command.values, position.time) - position.values
    return float(np.sqrt(np.mean(error**2)) / (np.std(position.values) + 1e-3))


def _without_plans(picked: dict[str, dict[str, _Candidate]], notes: list[str]) -> dict[str, dict[str, _Candidate]]:
    """Without the speeds and torques of planned motions, which go to the controller and not to the drives."""
    result, left = {}, set()
    for name, by in picked.items():
        plan = {
            s for s, c in by.items()
            if s in ("des_dof_vel", "des_dof_effort") and "des_dof_pos" in by
            and (not np.any(c.channel.values) or _PLANNED.search(c.channel.key))
        }  # fmt: skip
        left |= {by[s].channel.key.partition("[")[0] for s in plan if np.any(by[s].channel.values)}
        result[name] = {s: c for s, c in by.items() if s not in plan}
    if left:
        notes.append(
            f"{listed(sorted(left))}: taken to be a plan that the drives do not receive. If they do, map it as "
            "des_dof_vel or des_dof_effort."
        )
    return result


_PAUSE = 1e3
"""Between logs that are looked at as one [s]: no slope is seen across it."""


def as_one(logs: Sequence[Log]) -> dict[str, Channel]:
    """The channels of logs that have the same ones, one log after the other."""
    starts, at = [], 0.0
    for log in logs:
        begin = min(float(channel.time[0]) for channel in log.channels.values())
        starts.append(at - begin)
        at += max(float(channel.time[-1]) for channel in log.channels.values()) - begin + _PAUSE
    return {
        key: replace(
            channel,
            time=np.concatenate([log.channels[key].time + start for log, start in zip(logs, starts, strict=True)]),
            values=np.concatenate([log.channels[key].values for log in logs]),
        )
        for key, channel in logs[0].channels.items()
    }


def _with_units(
    picked: dict[str, dict[str, _Candidate]], robot: Robot, names: Sequence[str], channels: Mapping[str, Channel]
) -> tuple[dict[str, dict[str, Source]], list[str]]:
    """Where each series comes from, and notes.

    Args:
        channels: What units are read from, by key.
    """
    groups: dict[tuple[str, str, JointType], dict[str, _Candidate]] = defaultdict(dict)
    stated: dict[str, dict[str, Channel]] = {name: {} for name in names}
    for name, by in picked.items():
        for series, each in by.items():
            if series not in JOINT_SERIES:
                continue
            groups[series, each.unit or each.channel.table, robot.joint_type(name)][name] = each
            if each.unit and each.unit not in NEED_FACTOR:
                stated[name][series] = _scaled(channels[each.channel.key], series, each.unit)
    given = {name: {s: channels[each.channel.key] for s, each in by.items()} for name, by in picked.items()}
    sources: dict[str, dict[str, Source]] = {name: {} for name in names}
    scaled: dict[str, Channel] = {}
    of_positions: dict[str, str] = {}
    notes: list[str] = []
    for (series, _, _), group in sorted(groups.items(), key=_order_of_group):
        unit = next(iter(group.values())).unit
        if unit in NEED_FACTOR:
            keys = listed(each.channel.key for each in group.values())
            what = "a current" if unit in CURRENTS else "part of a largest load, as servos' registers hold it"
            notes.append(f"{keys}: {what}, no torque; left out, unless a column map gives its factor.")
            continue
        units = dict.fromkeys(group, unit)
        if not unit:
            known = {name: robot.known(name, stated[name], given[name]) for name in group}
            units, more = guessed_units(series, known, scaled, of_positions)
            notes += more
        elif series == "dof_vel":
            speeds = {name: stated[name][series] for name in group}
            for name, ratio in no_slopes(speeds, scaled).items():
                units[name] = ""
                notes.append(
                    f"{group[name].channel.key}: {ratio:.3g} times the slope of {name}'s position, so one of the two "
                    "units is wrong: left out."
                )
        for name, each in group.items():
            if not units[name]:
                continue
            sources[name][series] = Source(channel=each.channel.key, unit=units[name])
            if series == "dof_pos":
                scaled[name] = _scaled(channels[each.channel.key], series, units[name])
                of_positions[name] = units[name]
    return {name: dict(sorted(by.items(), key=_order)) for name, by in sources.items()}, notes


def _scaled(channel: Channel, series: str, unit: str) -> Channel:
    """A channel in SI units."""
    return replace(channel, values=channel.values * Source(channel="", unit=unit).scale(series))


def _order_of_group(entry: tuple[tuple[str, str, str], object]) -> tuple[int, str, str]:
    return JOINT_SERIES.index(entry[0][0]), *entry[0][1:]


def _effort_as_command(sources: dict[str, dict[str, Source]], notes: list[str]) -> None:
    """A log of torques and motions without any command: the torque is what was commanded."""
    measured = [by for by in sources.values() if "dof_pos" in by]
    if measured and all("dof_effort" in by for by in measured):
        for by in measured:
            by["des_dof_effort"] = by["dof_effort"]
        notes.append(
            "The log has no commands: its torques (dof_effort) were taken to be what was commanded (des_dof_effort), "
            "without any gains, with straight lines between them."
        )


def _found(
    sources: Mapping[str, Mapping[str, Source]], robot: Robot, candidates: Sequence[_Candidate]
) -> tuple[str, ...]:
    """The robot's joints that the log has, with commands if any has, if it has no others: those may be misspelt."""
    labels = {each.label for each in candidates if each.series == "dof_pos"}
    if not all(match(label, robot.joint_names) for label in labels):
        return ()
    measured = {name: by for name, by in sources.items() if "dof_pos" in by}
    return tuple(n for n, by in measured.items() if not by.keys().isdisjoint(COMMAND_SERIES)) or tuple(measured)


def _foreign(candidates: Sequence[_Candidate], robot: Robot) -> list[str]:
    """Which positions of the log are of no joint of the robot, and what to do if their names are right."""
    labels = [each.label for each in candidates if each.series == "dof_pos"]
    foreign = [label for label in labels if label and robot.joint_names and not match(label, robot.joint_names)]
    if not foreign or len(foreign) == len(labels) or robot.wanted:
        return []
    return [
        f"No joint of the robot is called as {listed(foreign, 12)}. If the names are right, choose the joints that log "
        "and robot have: --joints REGEX."
    ]


def _missing(sources: dict[str, dict[str, Source]], names: Sequence[str]) -> list[str]:
    if not names:
        return ["positions of joints (dof_pos)", "their commands (des_dof_pos, des_dof_vel or des_dof_effort)"]
    missing = []
    if without := [name for name in names if "dof_pos" not in sources[name]]:
        missing.append(f"positions (dof_pos) of {listed(without)}")
    if without := [name for name in names if not any(s in COMMAND_SERIES for s in sources[name])]:
        missing.append(f"commands (des_dof_pos, des_dof_vel or des_dof_effort) of {listed(without)}")
    return missing
