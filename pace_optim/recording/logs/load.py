"""Read recordings from any file or folder: this project's own form, or a log of another program."""

from __future__ import annotations

import csv
import os
import shlex
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pace_actuators.text import listed
from pace_optim.recording import Recording, load_recording
from pace_optim.recording.checks import check_recording
from pace_optim.recording.files import SUFFIXES, facts_beside, read_facts, with_facts, with_shared_facts
from pace_optim.recording.keys import COMMAND_SERIES, CONDITIONS, DRIVE_FACTS, MEASURED_SERIES, SHARED_FACTS
from pace_optim.recording.text_table import Head, head_of
from pace_optim.recording.time_base import held, interpolate_linear, interpolate_smooth

from .base import NO_BASE, base_fields
from .column_map import ColumnMap, Source, map_text, printable, write_map
from .guess import Robot, as_one, guess_map
from .log import Channel, Log
from .rosbag import read_rosbag
from .tables import SUFFIXES as TABLES
from .tables import read_csv_log, read_npz_log, read_parquet_log
from .words import is_time, meaning

BAGS = (".mcap", ".db3", ".bag")
LOG_SUFFIXES = (*BAGS, ".parquet", *(each for each in TABLES if each not in SUFFIXES))
_OWN = {"dof_pos", "des_dof_pos"}
"""One of these is in every recording of this project's own form."""
_JOIN = "+"
"""Between the files of one log: states.csv+commands.csv."""


class _IncompleteError(ValueError):
    """A log without series that a recording needs."""

    def __init__(self, path: Path, log: Log, missing: Sequence[str], columns: ColumnMap, notes: Sequence[str]):
        super().__init__(
            printable(
                f"{path}: missing {'; '.join(missing)}. The log holds {listed(log.channels, 24)}. {' '.join(notes)}"
            )
        )
        known = (f"{key}: {len(each.time)} values at {each.rate:.4g} Hz" for key, each in log.channels.items())
        self._columns = columns if columns.joints else replace(columns, joints={"JOINT": {}})
        self._target = Path(f"{log.name.replace(' ', '_')}_map.toml")
        self._head = (
            f"Guessed from {path}; correct it and give it with --columns. Missing: {'; '.join(missing)}.",
            *notes,
            'Entries: {from = "COLUMN", unit = "deg", sign = -1, offset = 0.1, gear_ratio = 9.0, factor = 1.2}',
            "The log holds:",
            *known,
        )

    def with_map(self) -> ValueError:
        """The message with a map to correct, which is written."""
        target = _free(self._target)
        try:
            write_map(target, self._columns, self._head)
            quoted = shlex.quote(str(target))
            where = f"What was guessed is in {target}: complete it and give it with --columns {quoted}."
        except OSError:
            where = "Give a column map with --columns:\n" + map_text(self._columns)
        return ValueError(printable(f"{self} {where}"))


@dataclass(frozen=True, kw_only=True)
class _Reading:
    """How one log is read."""

    path: Path
    log: Log
    columns: ColumnMap
    notes: tuple[str, ...]


class LogReader:
    """Reads the files of one command: logs with the same columns have the same units, and are described once."""

    def __init__(
        self,
        paths: Sequence[str],
        columns: ColumnMap | None = None,
        facts: str | os.PathLike[str] | None = None,
        strict: bool = False,
    ):
        """Look at the files and read the facts; logs are read when they are asked for.

        Args:
            paths: All files and folders. One is a recording (.csv, .npz, .pt), a rosbag2 (.mcap, .db3, or its folder),
                a ROS 1 .bag, a .parquet, the folder of a LeRobot dataset, a table with any names, or files of one log
                joined by `+`.
            columns: Which column is what; without it, it is guessed.
            facts: JSON file of what is true of all recordings, where they do not state it.
            strict: Whether an episode that cannot be used refuses its log, instead of being set aside.
        """
        self._columns = columns
        self._strict = strict
        self._set_aside: dict[str, list[str]] = {}
        self._facts, note = ({}, "") if facts is None else read_facts(Path(facts), known=SHARED_FACTS)
        self._note = note
        self._logs: dict[str, list[Log]] = {}
        self._alike: dict[frozenset[str], list[Log]] = {}
        self._together: dict[frozenset[str], dict[str, Channel]] = {}
        self._readings: dict[str, _Reading] = {}
        self._refused: dict[str, _Reading] = {}
        for path in paths:
            if is_log(Path(path), columns):
                with suppress(ValueError):  # it is raised when the path's turn comes
                    self._logs_of(path)

    def recordings(self, path: str, robot: Robot) -> list[Recording]:
        """The recordings of a file or folder."""
        if not is_log(Path(path), self._columns):
            return [load_recording(path, self._columns.rate if self._columns else 0.0, self._facts, robot.joint_names)]
        return [recording for recording, _ in self.understood(path, robot)]

    def understood(self, path: str, robot: Robot) -> list[tuple[Recording, ColumnMap]]:
        """The recordings of a log, one or one per episode, and which column was taken for what."""
        columns = self._columns
        for readings in (self._readings, self._refused):
            readings.pop(str(Path(path)), None)
        found: list[tuple[Recording, ColumnMap]] = []
        faults: dict[str, ValueError] = {}
        try:
            for log in self._logs_of(path):
                try:
                    found.append(self._read(Path(path), log, robot))
                except ValueError as error:
                    if self._strict:
                        raise
                    faults[log.name] = error
            if faults and not found:
                raise next(iter(faults.values()))
        except ValueError as error:
            fault = error.with_map() if isinstance(error, _IncompleteError) else error
            if columns is None or columns.source in str(fault):
                raise fault from None
            raise ValueError(f"{fault} ({Path(path).name} was read by {columns.source}.)") from None
        self._set_aside[path] = [set_aside(name, error) for name, error in faults.items()]
        return found

    def lines(self) -> list[str]:
        """How the logs were read so far, those that were read alike together."""
        alike: list[list[_Reading]] = []
        for reading in (self._refused | self._readings).values():
            group = next((each for each in alike if each[0].columns.joints == reading.columns.joints), None)
            if group is None:
                alike.append([reading])
            else:
                group.append(reading)
        of_facts = [printable(f"note: {self._note}")] if self._note else []
        of_readings = [line for group in alike for line in _lines(group)]
        return [*of_readings, *of_facts, *(line for lines in self._set_aside.values() for line in lines)]

    def _logs_of(self, path: str) -> list[Log]:
        if path not in self._logs:
            self._logs[path] = list(_logs(Path(path), self._columns))
            for log in self._logs[path]:
                self._alike.setdefault(frozenset(log.channels), []).append(log)
        return self._logs[path]

    def _channels(self, log: Log) -> Mapping[str, Channel]:
        """What units are read from: the first of all logs with the same columns, one after another."""
        key = frozenset(log.channels)
        if key not in self._together:
            self._together[key] = as_one(self._alike[key][:_ENOUGH])
        return self._together[key]

    def _read(self, path: Path, log: Log, robot: Robot) -> tuple[Recording, ColumnMap]:
        used, notes = self._columns, list(log.notes)
        facts_from: tuple[str, ...] = ()
        unit_stated = () if used is None else tuple(used.joints)
        beside = _parts(path)[0]
        stated, of_facts = facts_beside(beside)
        if used is None or not used.joints:
            guess = guess_map(log, robot, self._channels(log), NO_BASE if used is None else used.base)
            own, facts_from, unit_stated = guess.columns, guess.facts_from, guess.unit_stated
            used = replace(used or own, joints=own.joints, torque_enable=own.torque_enable, base=own.base)
            notes += guess.notes
            if guess.missing:
                raise _IncompleteError(path, log, guess.missing, used, notes)
            used = replace(used, facts={**own.facts, **used.facts})
            if twice := [key for key in own.facts if key in stated]:
                notes.append(f"{listed(twice)}: as the JSON file beside the log states it, not by the log's columns.")
                used = replace(used, facts={key: value for key, value in used.facts.items() if key not in twice})
        names = _joints_of(path, used, robot)
        fields, more = fields_of(log, used, names)
        left = unused(log, used, facts_from)
        notes += [*more, *of_facts, *([left] if left else [])]
        reading = _Reading(path=path, log=log, columns=used, notes=tuple(notes))
        fields = with_shared_facts(with_facts(fields, stated, beside), self._facts, robot.joint_names)
        try:
            recording = check_recording(fields, source=str(path), default_name=log.name)
        except ValueError as error:
            self._refused.setdefault(str(path), reading)
            if left and _name_others(fields, names):
                raise ValueError(f"{error} Columns of the log: {left[0].lower()}{left[1:]}") from None
            raise
        self._readings.setdefault(str(path), reading)
        if len(log.name) > len(path.stem):  # an episode, or a part
            recording = replace(recording, name=log.name)
        return replace(recording, unit_stated=unit_stated, notes=(*recording.notes, *notes)), used


def set_aside(name: str, fault: ValueError | str) -> str:
    """The warning that a file or an episode cannot be used."""
    return printable(f"warning: {name} is set aside (--strict refuses it): {' '.join(str(fault).split())} [W20]")


_ENOUGH = 20
"""So many logs with the same columns show their units."""


def _name_others(fields: Mapping[str, Any], names: Sequence[str]) -> bool:
    """Whether facts are of joints that were not found in the log."""
    return any(not set(fields[key]) <= set(names) for key in DRIVE_FACTS if isinstance(fields.get(key), Mapping))


def _lines(readings: Sequence[_Reading]) -> list[str]:
    """How logs are read that have the same columns; a note of some of them alone names these."""
    first, *others = readings
    notes: dict[str, list[str]] = {}
    for reading in readings:
        for note in reading.notes:
            notes.setdefault(note, []).append(reading.path.name)
    said = [note if len(of) == len(readings) else f"{listed(of)}: {note}" for note, of in notes.items()]
    paths = listed([str(first.path), *(reading.path.name for reading in others)], 6)
    rates = rates_of([reading.log for reading in readings], first.columns)
    return [printable(line) for line in (f"{paths}: read as", *(f"  {line}" for line in (*rates, *said)))]


def is_log(path: Path, columns: ColumnMap | None = None) -> bool:
    """Whether a path is a log of another program, and not a recording in this project's own form."""
    if columns is not None and (columns.joints or columns.time) and path.suffix.lower() not in (".npz", ".pt"):
        return True
    if path.is_dir() or path.suffix.lower() not in SUFFIXES or len(_parts(path)) > 1:
        return True
    if path.suffix.lower() == ".npz" and path.is_file():
        return not _is_own_npz(path)
    return path.suffix.lower() == ".csv" and path.is_file() and not _is_own_csv(path)


def column_names(path: Path, columns: ColumnMap | None = None) -> tuple[str, ...]:
    """The names of a recording's joints, or of a log's columns; none of what cannot be read."""
    if columns is not None and columns.joints:
        return tuple(columns.joints)
    try:
        if not is_log(path, columns):
            return load_recording(path).joint_names
        return tuple(name for log in _logs(path, columns) for name in log.channels)
    except ValueError:
        return ()


def _parts(path: Path) -> list[Path]:
    """The files that a path joins by `+`; one in the name of a file or folder joins nothing."""
    found, begun = [], ""
    for piece in str(path).split(_JOIN):
        begun += piece
        if Path(begun).is_file():
            found.append(Path(begun))
            begun = ""
        else:
            begun += _JOIN
    return found if found and not begun and not path.exists() else [path]


def paired_files(paths: Sequence[str]) -> list[str]:
    """Join files that are two halves of one log: positions without commands, and commands without positions.

    Args:
        paths: In the order of the command line. A half is joined with the nearest other half after it, else before it.
    """
    halves = {i: half for i, path in enumerate(paths) if (half := _half(Path(path)))}
    result: list[str | None] = list(paths)
    for i, half in halves.items():
        if half != "states" or result[i] is None:
            continue
        others = [j for j, other in halves.items() if other == "commands" and result[j] is not None]
        if others:
            j = min(others, key=lambda other: (abs(other - i), other < i))
            result[i], result[j] = paths[i] + _JOIN + paths[j], None
    return [path for path in result if path is not None]


def _half(path: Path) -> str:
    """`states` or `commands` where a table has one of them alone, else ""."""
    if path.suffix.lower() not in TABLES or not path.is_file():
        return ""
    said = [meaning(name) for name in _head(path).names if not is_time(name)]
    positions = any(each.quantity == "dof_pos" and not each.commanded for each in said)
    commands = any(each.quantity and each.commanded for each in said)
    return "" if positions == commands else "states" if positions else "commands"


def _head(path: Path) -> Head:
    """How a table begins; as an empty one where it cannot be read."""
    try:
        return head_of(path)
    except (UnicodeDecodeError, OSError, csv.Error):
        return Head(names=(), delimiter=",", first_row=1, notes=())


def _is_own_npz(path: Path) -> bool:
    """Whether arrays are meant to be a recording, as for a CSV; so is what is no archive, which its reader refuses."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = {Path(name).stem for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile):
        return True
    return not names.isdisjoint(_OWN)


def _is_own_csv(path: Path) -> bool:
    """Whether a CSV is meant to be a recording: it has the time and joints of one of the series by their names."""
    head = _head(path)
    own = [column.partition("/")[0] for column in head.names if "/" in column]
    return head.first_row == 1 and (len(head.names) < 2 or not _OWN.isdisjoint(own))


def _logs(path: Path, columns: ColumnMap | None) -> Iterator[Log]:
    if len(parts := _parts(path)) > 1:
        yield _joined(parts, columns)
        return
    if not path.exists():
        folder = path.parent
        near = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
        raise ValueError(f"{path}: no such file. There are in {folder}: {listed(near)}. Correct the path.")
    suffix = path.suffix.lower()
    if not (path.is_dir() or path.is_file()):
        raise ValueError(f"{path}: is neither a file nor a folder. Correct the path.")
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            yield read_rosbag(path)
        elif (path / "meta" / "info.json").is_file():
            yield from read_parquet_log(path, columns)
        elif bags := sorted(p for p in path.iterdir() if p.suffix.lower() in BAGS):
            for bag in bags:
                yield read_rosbag(bag)
        else:
            there = listed(sorted(p.name for p in path.iterdir()))
            raise ValueError(
                f"{path}: this folder is neither a rosbag2 (metadata.yaml) nor a LeRobot dataset "
                f"(meta/info.json). It has: {there}. Name the files themselves."
            )
    elif suffix in BAGS:
        yield read_rosbag(path)
    elif suffix == ".parquet":
        yield from read_parquet_log(path, columns)
    elif suffix == ".npz":
        yield from read_npz_log(path, columns)
    elif suffix in TABLES:
        yield from read_csv_log(path, columns)
    else:
        raise ValueError(
            f"{path}: found the suffix '{path.suffix}'; expected one of {listed((*SUFFIXES, *LOG_SUFFIXES))}, or a "
            "folder of a rosbag2 or a LeRobot dataset. Write it as .csv: a line of names, then one row per sample. "
            "Give gains of all logs with --facts."
        )


def _joined(paths: Sequence[Path], columns: ColumnMap | None) -> Log:
    """CSV files of one clock as one log."""
    logs = []
    for path in paths:
        log, *parts = read_csv_log(path, columns)
        if parts:
            raise ValueError(f"{path}: {log.notes[-1]} A half of a log must be of one clock: cut both files there.")
        logs.append(log)
    origins = {bool(log.time_origin) for log in logs}
    if len(origins) > 1:
        raise ValueError(f"{_JOIN.join(map(str, paths))}: one has Unix time and one has not. Give both on one clock.")
    first = min(log.time_origin for log in logs)
    channels = {}
    for log, path in zip(logs, paths, strict=True):
        for key, channel in log.channels.items():
            name = key if key not in channels else f"{path.stem}:{key}"
            shifted = channel.time + (log.time_origin - first) if first else channel.time
            channels[name] = replace(channel, key=name, time=shifted)
    return Log(
        name=paths[0].stem,
        channels=channels,
        time_origin=first,
        notes=tuple(dict.fromkeys(note for log in logs for note in log.notes)),
    )


def _joints_of(path: Path, columns: ColumnMap, robot: Robot) -> tuple[str, ...]:
    """The joints of the recording, in the robot's order: those of the map, unless it has others than the robot."""
    mapped = [name for name, by in columns.joints.items() if "dof_pos" in by]
    names = robot.joint_names or tuple(columns.joints)
    if robot.wanted or set(columns.joints) <= set(names):
        names = tuple(name for name in names if name in mapped or name in robot.wanted)
    if missing := [name for name in names if name not in mapped]:
        raise ValueError(
            f"{path}: the column map has no dof_pos of {listed(missing)}; it has the joints {listed(columns.joints)}. "
            "Add them, or name the joints to identify with --joints."
        )
    return names


def _free(path: Path) -> Path:
    """A name that no file has."""
    number = 2
    free = path
    while free.exists():
        free = path.with_stem(f"{path.stem}_{number}")
        number += 1
    return free


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
    of_column: dict[str, list[str]] = {}
    for name in joint_names:
        of_column.setdefault(columns.joints[name]["dof_pos"].channel, []).append(name)
    twice = [f"{key} ({listed(those)})" for key, those in of_column.items() if len(those) > 1]
    notes += [f"One column holds the positions of several joints: {listed(twice)}."] if twice else []
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
            name: (fine, np.interp(fine, clock, values)) for name, (clock, values) in parts["des_dof_effort"].items()
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
        fields[series] = _columns(part, joint_names, lambda pair: held(pair[0], pair[1], des_time))
    if columns.torque_enable:
        switch = log.channel(columns.torque_enable)
        fields["torque_enable"] = held(switch.time, switch.values, time)
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


def _scaled(log: Log, series: str, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Instants and values in SI units at the joint."""
    channel = log.channel(source.channel)
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


def rates_of(logs: Sequence[Log], columns: ColumnMap) -> list[str]:
    """What was understood of logs with the same columns: where each series is from, its unit, rate and longest gap."""
    lines = []
    for series in (*MEASURED_SERIES, *CONDITIONS, *COMMAND_SERIES):
        by = {
            name: sources[series]
            for name, sources in columns.joints.items()
            if series in sources and sources[series].channel in logs[0].channels  # a map may have more joints
        }
        for names, source in _alike(logs[0], by):
            channels = [log.channels[source.channel] for log in logs if source.channel in log.channels]
            gap = max(float(np.diff(each.time).max(initial=0.0)) for each in channels)
            rates = list(dict.fromkeys(f"{rate:.4g}" for rate in sorted(each.rate for each in channels)))
            lines.append(
                f"{series:15s} {listed(names, 6)}: {source.channel}{' …' if len(names) > 1 else ''}, "
                f"{_terms(source)}, {sum(len(each.time) for each in channels)} values at "
                f"{' to '.join([rates[0], *rates[1:][-1:]])} Hz, longest gap {gap * 1e3:.4g} ms"
            )
    return lines


def _alike(log: Log, by: Mapping[str, Source]) -> list[tuple[list[str], Source]]:
    """Joints whose channels differ in the joint alone."""
    groups: dict[tuple[Any, ...], tuple[list[str], Source]] = {}
    for name, source in by.items():
        channel = log.channels[source.channel]
        terms = (source.unit, source.sign, source.offset, source.gear_ratio, source.factor)
        key = (channel.table, len(channel.time), *terms)
        groups.setdefault(key, ([], source))[0].append(name)
    return list(groups.values())


def _terms(source: Source) -> str:
    words = [source.unit]
    words += ["sign reversed"] if source.sign < 0 else []
    words += [f"offset {source.offset:g}"] if source.offset else []
    words += [f"gear ratio {source.gear_ratio:g}"] if source.gear_ratio != 1.0 else []
    words += [f"factor {source.factor:g}"] if source.factor != 1.0 else []
    return ", ".join(words)
