"""From the channels of a log and a column map to a recording."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from pace_actuators.text import listed
from pace_optim.recording.keys import COMMAND_SERIES, CONDITIONS, MEASURED_SERIES
from pace_optim.recording.resample import interpolate_linear, interpolate_smooth

from .base import base_fields
from .column_map import ColumnMap, Source
from .log import Channel, Log

_FINE = 0.0025
"""Between two torques that stand for a measured one [s]."""


def fields_of(log: Log, columns: ColumnMap, joint_names: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """The fields of a recording, and notes on how they came about.

    Args:
        columns: Where each series of each joint comes from.
        joint_names: The joints, in the order of the columns; each has a `dof_pos` in the map.
    """
    parts = {
        series: {name: _scaled(log, series, columns.joints[name][series]) for name in joint_names
                 if series in columns.joints[name]}
        for series in (*MEASURED_SERIES, *CONDITIONS, *COMMAND_SERIES)
    }  # fmt: skip
    clocks = [parts["dof_pos"][name][0] for name in joint_names]
    time, notes = clocks[0], []
    if not all(clock is time or np.array_equal(clock, time) for clock in clocks):
        begin, end = max(clock[0] for clock in clocks), min(clock[-1] for clock in clocks)
        time = max(clocks, key=len)
        time = time[(time >= begin) & (time <= end)]
        notes.append("Positions of the joints were logged at different instants: put on those of one by cubics.")
    if len(time) < 2:
        raise ValueError(f"{log.name}: the positions of {listed(joint_names)} have no time in common. Check the log.")
    first = float(time[0])
    fields: dict[str, Any] = {"joint_names": list(joint_names)}
    for series in (*MEASURED_SERIES, *CONDITIONS):
        interpolate = interpolate_smooth if series in ("dof_pos", "dof_vel") else interpolate_linear
        if parts[series]:
            fields[series] = _columns(parts[series], joint_names, lambda p, how=interpolate: _at(p, time, how))  # type: ignore[misc]
    if _is_measured(columns, joint_names):  # a measurement changes between its samples, as no held command does
        step = float(np.median(np.diff(time)))
        fine = np.linspace(time[0], time[-1], (len(time) - 1) * max(1, round(step / _FINE)) + 1)
        parts["des_dof_effort"] = {
            name: (fine, np.interp(fine, clock, values))
            for name, (clock, values) in parts["des_dof_effort"].items()
        }
        del fields["dof_effort"]
    commands = {series: parts[series] for series in COMMAND_SERIES if parts[series]}
    own = [clock for part in commands.values() for clock, _ in part.values()]
    if own and not all(clock is time or np.array_equal(clock, time) for clock in own):
        des_time = _union(own)
        des_time = des_time[des_time >= max(clock[0] for clock in own)]
        before = int(np.searchsorted(des_time, time[0], side="right")) - 1
        des_time = des_time[max(0, before) : int(np.searchsorted(des_time, time[-1], side="right"))]
        if not len(des_time):
            raise ValueError(f"{log.name}: commands come only after the last position. Are both of one clock?")
        if before >= 0 and time[0] - des_time[0] > 1.0:
            notes.append(f"The command at the beginning was issued {time[0] - des_time[0]:.3g} s before.")
        if time[-1] - des_time[-1] > 0.5:
            notes.append(f"No command comes in the last {time[-1] - des_time[-1]:.3g} s: the last one is held.")
        fields["des_time"] = des_time - first
    else:
        des_time = time
    for series, part in commands.items():
        fields[series] = _columns(part, joint_names, lambda p: p[1][np.searchsorted(p[0], des_time, side="right") - 1])
    if columns.torque_enable:
        switch = log.channels.get(columns.torque_enable)
        if switch is None:
            raise ValueError(_unknown_channel(log, columns.torque_enable))
        at = np.searchsorted(switch.time, time, side="right") - 1
        fields["torque_enable"] = switch.values[np.clip(at, 0, None)]
    fields |= base_fields(log, columns.base, time)
    fields["time"] = time - first
    if log.time_origin or first:
        fields["time_origin"] = log.time_origin + first
    return {**fields, **columns.facts}, notes


def _is_measured(columns: ColumnMap, joint_names: Sequence[str]) -> bool:
    """Whether the torques that are taken to be commanded are those that were measured."""
    each = [columns.joints[name] for name in joint_names]
    return all("des_dof_effort" in by and by["des_dof_effort"] == by.get("dof_effort") for by in each)


def unused(log: Log, columns: ColumnMap, facts_from: Collection[str] = ()) -> str:
    """The channels that no series comes from, in a sentence; a topic of which nothing is used as one.

    Args:
        columns: What is used of it.
        facts_from: Channels that facts were read from.
    """
    used = {source.channel for by in columns.joints.values() for source in by.values()}
    used |= {columns.torque_enable, *facts_from, *columns.base.channels}
    tables = {log.channels[key].table for key in used if key in log.channels}
    left: dict[str, int] = {}
    for key, channel in log.channels.items():
        if key not in used:
            whole = bool(channel.table) and channel.table not in tables
            left[channel.table if whole else key] = left.get(channel.table, 0) + 1 if whole else 1
    names = [name if count == 1 else f"{name} ({count} columns)" for name, count in left.items()]
    return f"Not used: {listed(names, len(names))}." if names else ""


def _unknown_channel(log: Log, channel: str) -> str:
    return (
        f"{log.name}: the column map names '{channel}', which the log has not. It has: {listed(log.channels)}. Correct "
        "the map."
    )


def _scaled(log: Log, series: str, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Instants and values in SI units at the joint."""
    if (channel := log.channels.get(source.channel)) is None:
        raise ValueError(_unknown_channel(log, source.channel))
    return channel.time, channel.values * source.scale(series) + source.offset


def _columns(part: Mapping[str, Any], joint_names: Sequence[str], values_of: Any) -> np.ndarray:
    """One column per joint, NaN for those that have none."""
    found = {name: values_of(pair) for name, pair in part.items()}
    none = np.full(len(next(iter(found.values()))), np.nan)
    return np.stack([found.get(name, none) for name in joint_names], axis=1)


def _at(pair: tuple[np.ndarray, np.ndarray], time: np.ndarray, interpolate: Any) -> np.ndarray:
    clock, values = pair
    if clock is time or np.array_equal(clock, time):
        return values
    if len(clock) < 3:
        return np.full(len(time), np.nan)
    return interpolate(clock, values[:, None], np.clip(time, clock[0], clock[-1]))[:, 0]


def _union(clocks: Sequence[np.ndarray]) -> np.ndarray:
    distinct = {id(clock): clock for clock in clocks}
    return np.unique(np.concatenate(list(distinct.values())))


def rates_of(log: Log, columns: ColumnMap) -> list[str]:
    """What was understood, a line for each series: where from, unit, rate and longest gap."""
    lines = []
    for series in (*MEASURED_SERIES, *CONDITIONS, *COMMAND_SERIES):
        by = {name: sources[series] for name, sources in columns.joints.items() if series in sources}
        for names, source, channel in _alike(log, by):
            gap = float(np.diff(channel.time).max()) if len(channel.time) > 1 else 0.0
            lines.append(
                f"{series:15s} {listed(names, 6)}: {source.channel}{' …' if len(names) > 1 else ''}, "
                f"{_terms(series, source)}, {len(channel.time)} values at {channel.rate:.4g} Hz, "
                f"longest gap {gap * 1e3:.4g} ms"
            )
    return lines


def _alike(log: Log, by: Mapping[str, Source]) -> list[tuple[list[str], Source, Channel]]:
    """Joints whose channels differ in the joint alone."""
    groups: dict[tuple[Any, ...], tuple[list[str], Source, Channel]] = {}
    for name, source in by.items():
        channel = log.channels[source.channel]
        terms = (source.unit, source.sign, source.offset, source.gear_ratio, source.factor)
        key = (channel.table, len(channel.time), *terms)
        groups.setdefault(key, ([], source, channel))[0].append(name)
    return list(groups.values())


def _terms(series: str, source: Source) -> str:
    words = [source.unit]
    words += ["sign reversed"] if source.sign < 0 else []
    words += [f"offset {source.offset:g}"] if source.offset else []
    words += [f"gear ratio {source.gear_ratio:g}"] if source.gear_ratio != 1.0 else []
    words += [f"factor {source.factor:g}"] if source.factor != 1.0 else []
    return ", ".join(words)
