"""Read recordings from any file or folder: this project's own form, or a log of another program."""

from __future__ import annotations

import csv
import os
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pace_actuators.text import listed
from pace_optim.recording import Recording, load_recording
from pace_optim.recording.checks import check_recording
from pace_optim.recording.files import SUFFIXES, add_json_facts

from .build import fields_of, rates_of, unused
from .column_map import ColumnMap, map_text, printable, write_map
from .guess import Robot, guess_map
from .log import Log
from .rosbag import read_rosbag
from .tables import is_joint_table, read_csv_log, read_parquet_log
from .text_table import SUFFIXES as TABLES
from .text_table import Head, head_of

BAGS = (".mcap", ".db3", ".bag")
LOG_SUFFIXES = (*BAGS, ".parquet", *(each for each in TABLES if each not in SUFFIXES))
_JOIN = "+"
"""Between the files of one log: states.csv+commands.csv."""

__all__ = ["Robot", "Understood", "is_log", "load_recordings", "paired_files", "understood"]


@dataclass(frozen=True, kw_only=True)
class Understood:
    """One recording of a log, and how the log was read."""

    recording: Recording
    columns: ColumnMap
    lines: tuple[str, ...]
    """What was understood, for people."""


def load_recordings(
    path: str | os.PathLike[str],
    robot: Robot | None = None,
    columns: ColumnMap | None = None,
    tell: Callable[[str], None] | None = None,
) -> list[Recording]:
    """Read the recordings of a file or folder: one, or one per episode.

    Args:
        path: A recording (.csv, .npz, .pt), a rosbag2 (.mcap, .db3, or its folder), a ROS 1 .bag, a .parquet, the
            folder of a LeRobot dataset, a .csv with any names, or CSV files of one log joined by `+`.
        robot: The robot's joints and limits; without it, the log's own names are kept.
        columns: Which column is what; without it, it is guessed.
        tell: Gets what a guess understood.
    """
    path = Path(path)
    if not is_log(path, columns):
        return [load_recording(path, columns.rate if columns else 0.0)]
    found = understood(path, robot or Robot(), columns)
    if tell and columns is None:
        for line in found[0].lines:
            tell(line)
    return [each.recording for each in found]


def is_log(path: Path, columns: ColumnMap | None = None) -> bool:
    """Whether a path is a log of another program, and not a recording in this project's own form."""
    if columns is not None and (columns.joints or columns.time) and path.suffix.lower() not in (".npz", ".pt"):
        return True
    if path.is_dir() or path.suffix.lower() not in SUFFIXES or len(_parts(path)) > 1:
        return True
    return path.suffix.lower() == ".csv" and path.is_file() and not _is_own_csv(path)


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


def understood(path: Path, robot: Robot, columns: ColumnMap | None = None) -> list[Understood]:
    """Read a log and say what was understood.

    Args:
        path: As `load_recordings` takes it, less this project's own form.
        robot: The robot's joints and limits, as far as they are known.
        columns: Which column is what; without it, it is guessed.
    """
    try:
        return _understood(path, robot, columns)
    except ValueError as error:
        if columns is None or columns.source in str(error):
            raise
        raise ValueError(f"{error} ({path.name} was read by {columns.source}.)") from None


def _understood(path: Path, robot: Robot, columns: ColumnMap | None) -> list[Understood]:
    result = []
    for log in _logs(path, columns):
        used, notes = columns, list(log.notes)
        facts_from: tuple[str, ...] = ()
        unit_stated = tuple(columns.joints) if columns is not None else ()
        beside = _parts(path)[0]
        if used is None or not used.joints:
            guess = guess_map(log, robot)
            own, facts_from, unit_stated = guess.columns, guess.facts_from, guess.unit_stated
            base = own.base if used is None or not used.base.channels else used.base
            used = own if used is None else replace(used, joints=own.joints, torque_enable=own.torque_enable, base=base)
            notes += guess.notes
            if guess.missing:
                raise ValueError(_what_is_missing(path, log, guess.missing, used, notes))
            used = replace(used, facts={**own.facts, **used.facts})
            if twice := [key for key in own.facts if key in add_json_facts({}, beside)]:
                notes.append(f"{listed(twice)}: as the JSON file beside the log states it, not by the log's columns.")
                used = replace(used, facts={key: value for key, value in used.facts.items() if key not in twice})
        names = _joints_of(path, used, robot)
        fields, more = fields_of(log, used, names)
        more += [left] if (left := unused(log, used, facts_from)) else []
        recording = check_recording(add_json_facts(fields, beside), source=str(path), default_name=log.name)
        if len(log.name) > len(path.stem):  # an episode, or a part
            recording = replace(recording, name=log.name)
        lines = [printable(line) for line in (f"{path}: read as", *rates_of(log, used), *notes, *more)]
        result.append(
            Understood(
                recording=replace(recording, unit_stated=unit_stated, notes=(*recording.notes, *notes, *more)),
                columns=used,
                lines=tuple(lines[:1] + [f"  {line}" for line in lines[1:]]),
            )
        )
    return result


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
    positions, commands = is_joint_table(_head(path).names)
    return "" if positions == commands else "states" if positions else "commands"


def _head(path: Path) -> Head:
    """How a table begins; as an empty one where it cannot be read."""
    try:
        return head_of(path)
    except (UnicodeDecodeError, OSError, csv.Error):
        return Head(names=(), delimiter=",", first_row=1, notes=())


def _is_own_csv(path: Path) -> bool:
    """Whether a CSV is meant to be a recording: it has the time and joints of one of the series by their names."""
    head = _head(path)
    own = [column.partition("/")[0] for column in head.names if "/" in column]
    return head.first_row == 1 and (len(head.names) < 2 or not {"dof_pos", "des_dof_pos"}.isdisjoint(own))


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
    elif suffix in TABLES:
        yield from read_csv_log(path, columns)
    else:
        raise ValueError(
            f"{path}: found the suffix '{path.suffix}'; expected one of {listed((*SUFFIXES, *LOG_SUFFIXES))}, or a "
            "folder of a rosbag2 or a LeRobot dataset. Write it as .csv: a line of names, then one row per sample."
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


def _what_is_missing(path: Path, log: Log, missing: Sequence[str], columns: ColumnMap, notes: Sequence[str]) -> str:
    """The message, and a map to correct beside it."""
    columns = columns if columns.joints else replace(columns, joints={"JOINT": {}})
    target = _free(Path(f"{log.name.replace(' ', '_')}_map.toml"))
    known = [f"{key}: {len(channel.time)} values at {channel.rate:.4g} Hz" for key, channel in log.channels.items()]
    head = (
        f"Guessed from {path}; correct it and give it with --columns. Missing: {'; '.join(missing)}.",
        *notes,
        'Entries: {from = "COLUMN", unit = "deg", sign = -1, offset = 0.1, gear_ratio = 9.0, factor = 1.2}',
        "The log holds:",
        *known,
    )
    try:
        write_map(target, columns, head)
        where = f"What was guessed is in {target}: complete it and give it with --columns {shlex.quote(str(target))}."
    except OSError:
        where = "Give a column map with --columns:\n" + map_text(columns)
    return printable(
        f"{path}: missing {'; '.join(missing)}. The log holds {listed(log.channels, 24)}. {' '.join(notes)} {where}"
    )


def _free(path: Path) -> Path:
    """A name that no file has."""
    number = 2
    free = path
    while free.exists():
        free = path.with_stem(f"{path.stem}_{number}")
        number += 1
    return free
