"""A column map for a log that comes without one: from the formats, the names and the numbers themselves."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from pace_actuators.joint_units import JointType
from pace_optim.recording.keys import COMMAND_SERIES, JOINT_SERIES, listed

from .column_map import ColumnMap, Source
from .joints import match, only_numbers
from .log import Channel, Log
from .units import guessed_unit
from .words import CURRENTS, meaning

_PLANNED = re.compile(r":(positions|velocities|effort|(desired|reference|output)\.\w+)\[")
"""Of a trajectory or a controller's state: its speeds and torques are those of the plan, which few drives are told."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """What is known of the robot that a log is of."""

    joint_names: tuple[str, ...] = ()
    """In order; () where no robot is known: the log's own names are kept."""
    limits: np.ndarray | None = None
    """Lower and upper limit of each joint, (n, 2) [rad]; infinite where there is none."""
    joint_types: tuple[JointType, ...] = ()
    """Whether each joint turns or slides; none where it is not known."""

    def joint_type(self, joint: str) -> JointType:
        """Whether a joint turns or slides; what is not known turns."""
        types = dict(zip(self.joint_names, self.joint_types, strict=False))
        return types.get(joint, "hinge")


@dataclass(frozen=True, kw_only=True)
class Guess:
    """A column map, and what is to be said of it."""

    columns: ColumnMap
    notes: tuple[str, ...]
    missing: tuple[str, ...]
    """All that a recording needs and that was not found."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    channel: Channel
    series: str
    label: str
    unit: str


def guess_map(log: Log, robot: Robot) -> Guess:
    """Find which channel is which series of which joint.

    Args:
        log: The log.
        robot: The robot, as far as it is known.
    """
    candidates = [found for channel in log.channels.values() if (found := _candidate(channel)) is not None]
    names = robot.joint_names or _own_names(candidates)
    groups: dict[tuple[str, str], list[_Candidate]] = defaultdict(list)
    for each in candidates:
        groups[each.channel.table, each.series].append(each)
    notes: list[str] = []
    chosen: dict[str, dict[str, tuple[tuple[float, int, int], _Candidate]]] = {name: {} for name in names}
    for series in JOINT_SERIES:
        for (_, of), group in groups.items():
            if of != series:
                continue
            pairs = _by_name(group, names) or _by_place(group, names, chosen, notes)
            for name, score, each in pairs:
                rank = (score, len(pairs), len(each.channel.time))
                if series not in chosen[name] or rank > chosen[name][series][0]:
                    chosen[name][series] = (rank, each)
    picked = {name: {s: c for s, (_, c) in sorted(by.items(), key=_order)} for name, by in chosen.items()}
    picked = _without_plans(picked, notes)
    sources, more = _with_units(picked, robot, names)
    notes += more
    if not any(s in COMMAND_SERIES for by in sources.values() for s in by):
        _effort_as_command(sources, notes)
    left = sorted(
        {c.label or c.channel.key for c in candidates}
        - {c.label or c.channel.key for by in picked.values() for c in by.values()}
    )
    if left:
        notes.append(f"Not used: {listed(left, 12)}.")
    return Guess(
        columns=ColumnMap(joints=sources), notes=tuple(notes), missing=tuple(_missing(sources, names, candidates))
    )


def _order(entry: tuple[str, object]) -> int:
    return JOINT_SERIES.index(entry[0])


def _candidate(channel: Channel) -> _Candidate | None:
    if channel.series:
        told = meaning("x", channel.table).commanded and not channel.series.startswith("des_")
        return _Candidate(
            channel=channel, series=("des_" if told else "") + channel.series, label=channel.joint, unit=""
        )
    name = channel.key.removeprefix(channel.table + ":") if channel.table else channel.key
    said = meaning(name, channel.table)
    if said.quantity not in ("dof_pos", "dof_vel", "dof_effort"):
        return None
    label = "_".join(said.joint)
    if channel.table and (not label or only_numbers([label]) or label == "data"):
        around = meaning(channel.table.strip("/").replace("/", "_")).joint
        place = [word for word in said.joint if word.isdigit()]
        label = "_".join(place or [word for word in around if word not in ("controller", "controllers", "forward")])
    return _Candidate(
        channel=channel, series=("des_" if said.commanded else "") + said.quantity, label=label, unit=said.unit
    )


def _own_names(candidates: Sequence[_Candidate]) -> tuple[str, ...]:
    """The joints that have a position in the log, and a command where any has, as it calls them."""
    names = tuple(dict.fromkeys(c.label or "joint" for c in candidates if c.series == "dof_pos"))
    told = [c.label for c in candidates if c.series in COMMAND_SERIES]
    if only_numbers(told):
        return names
    meant = {found[0] for label in told if (found := match(label, names))}
    return tuple(name for name in names if name in meant) or names


def _by_name(group: Sequence[_Candidate], names: Sequence[str]) -> list[tuple[str, float, _Candidate]]:
    found: dict[str, list[tuple[float, _Candidate]]] = defaultdict(list)
    for each in group:
        if each.label and (meant := match(each.label, names)):
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
    notes: list[str],
) -> list[tuple[str, float, _Candidate]]:
    """Columns without names of joints: in the robot's order, or in that in which they follow the motion."""
    if len(group) != len(names) or not only_numbers(each.label for each in group):
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


def _distance(command: Channel, position: Channel) -> float:
    """How far a position is from a command (rms), in units of the position's own motion."""
    at = np.clip(np.searchsorted(command.time, position.time, side="right") - 1, 0, None)
    return float(np.sqrt(np.mean((command.values[at] - position.values) ** 2)) / (np.std(position.values) + 1e-3))


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
            f"{listed(sorted(left))}: taken to be a plan that the drives are not told; map it as des_dof_vel or "
            "des_dof_effort if they are."
        )
    return result


def _with_units(
    picked: dict[str, dict[str, _Candidate]], robot: Robot, names: Sequence[str]
) -> tuple[dict[str, dict[str, Source]], list[str]]:
    groups: dict[tuple[str, str, JointType], dict[str, _Candidate]] = defaultdict(dict)
    for name, by in picked.items():
        for series, each in by.items():
            groups[series, each.unit or each.channel.table, robot.joint_type(name)][name] = each
    sources: dict[str, dict[str, Source]] = {name: {} for name in names}
    scaled: dict[str, Channel] = {}
    notes = []
    for (series, _, joint_type), group in sorted(groups.items(), key=_order_of_group):
        stated = next(iter(group.values())).unit
        channels = {name: each.channel for name, each in group.items()}
        told = (stated, "") if stated else guessed_unit(series, channels, scaled, robot.limits, names, joint_type)
        unit, note = told
        notes += [note] if note else []
        if unit in CURRENTS:
            keys = listed(channel.key for channel in channels.values())
            notes.append(f"{keys}: a current; left out, unless a column map gives its factor [N m/A].")
            continue
        if not unit:
            continue
        for name, channel in channels.items():
            source = Source(channel=channel.key, unit=unit)
            sources[name][series] = source
            if series == "dof_pos":
                scaled[name] = Channel(
                    key="", table="", time=channel.time, values=channel.values * source.scale(series)
                )
    return {name: dict(sorted(by.items(), key=_order)) for name, by in sources.items()}, notes


def _order_of_group(entry: tuple[tuple[str, str, str], object]) -> tuple[int, str, str]:
    return JOINT_SERIES.index(entry[0][0]), *entry[0][1:]


def _effort_as_command(sources: dict[str, dict[str, Source]], notes: list[str]) -> None:
    """A log of torques and motions without any command: the torque is what was commanded."""
    if sources and all("dof_effort" in by for by in sources.values()):
        for by in sources.values():
            by["des_dof_effort"] = by["dof_effort"]
        notes.append(
            "The log has no commands: its torques (dof_effort) were taken to be what was commanded (des_dof_effort), "
            "without any gains."
        )


def _missing(
    sources: dict[str, dict[str, Source]], names: Sequence[str], candidates: Sequence[_Candidate]
) -> list[str]:
    if not names:
        return ["positions of joints (dof_pos)"]
    missing = []
    if without := [name for name in names if "dof_pos" not in sources[name]]:
        missing.append(f"positions (dof_pos) of {listed(without)}")
    if without := [name for name in names if not any(s in COMMAND_SERIES for s in sources[name])]:
        missing.append(f"commands (des_dof_pos, des_dof_vel or des_dof_effort) of {listed(without)}")
    return missing
