"""The column map: which channel of a log is which series of which joint, in which unit, sign and gear ratio."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pace_actuators.files import file_at, write_atomically
from pace_actuators.text import listed
from pace_optim.recording.keys import COMMAND_SERIES, FACTS, JOINT_SERIES, did_you_mean

from .base import NO_BASE, BaseMap, base_text, read_base
from .words import CURRENTS, NEED_FACTOR, TIME_UNITS, UNITS

_OF_BASE = ("base", "contact", "foot_force")
_ENTRY = ("from", "unit", "sign", "offset", "gear_ratio", "factor")


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a series of a joint comes from.

    Positions and speeds: ``sign * value * unit / gear_ratio + offset``; torques, with ``factor`` [N m/A] for currents:
    ``sign * value * unit * factor * gear_ratio + offset``. Temperatures and voltages: as positions.
    """

    channel: str
    unit: str
    sign: float = 1.0
    offset: float = 0.0
    """In SI units, at the joint."""
    gear_ratio: float = 1.0
    """Turns of what was logged to one of the joint."""
    factor: float = 1.0

    def scale(self, series: str) -> float:
        """What one logged unit is in SI units at the joint."""
        quantity = series.removeprefix("des_")
        unit = self.sign * UNITS[quantity][self.unit]
        return (
            unit * self.factor * self.gear_ratio if quantity == "dof_effort" else unit * self.factor / self.gear_ratio
        )


@dataclass(frozen=True, kw_only=True)
class ColumnMap:
    """A whole map; joints in the order of the recording's columns. Without joints, these are guessed."""

    joints: Mapping[str, Mapping[str, Source]]
    """{joint: {series: source}}."""
    time: str = ""
    """The column of time; "": as guessed, or the topics' stamps."""
    time_unit: str = ""
    """Its unit: s, ms, us or ns; "": as guessed."""
    rate: float = 0.0
    """Rows per second of a log without time [Hz]; 0: it has time."""
    torque_enable: str = ""
    """The column that says whether the drives give torque; "": they always do."""
    base: BaseMap = NO_BASE
    """Which columns say how the base moves, and where feet stand."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Facts of the recording: stiffness, added_mass, ..."""
    source: str = field(default="", compare=False)
    """The file it was read from, for messages."""


_CURE = "Give --columns a column map, as pace import writes it."


def read_map(path: Path) -> ColumnMap:
    """Read a column map."""
    try:
        content = tomllib.loads(file_at(path, _CURE).read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: is not TOML ({error}). Correct it.") from None
    _check_keys(path, "the map", content, ("time", "torque_enable", "joints", "facts", *_OF_BASE))
    for key in _OF_BASE:
        _table(path, key, content.get(key, {}))
    if not content:
        raise ValueError(f'{path}: is empty; expected [joints."NAME"] with dof_pos = {{from = "COLUMN"}}, or [time].')
    joints = _table(path, "joints", content.get("joints", {}))
    time = _table(path, "time", content.get("time", {}))
    _check_keys(path, "time", time, ("column", "unit", "rate"))
    rate = time.get("rate", 0.0)
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0 <= rate < 1e6:
        raise ValueError(f"{path}: time.rate is {rate!r}; expected rows per second [Hz]. Correct it.")
    if (unit := time.get("unit", "")) not in ("", *TIME_UNITS):
        raise ValueError(f"{path}: time.unit is {unit!r}; expected one of {listed(TIME_UNITS)}. Correct it.")
    facts = _table(path, "facts", content.get("facts", {}))
    _check_keys(path, "facts", facts, FACTS)
    return ColumnMap(
        joints={joint: _sources(path, joint, _table(path, joint, entries)) for joint, entries in joints.items()},
        time=str(time.get("column", "")),
        time_unit=unit,
        rate=float(rate),
        torque_enable=str(content.get("torque_enable", "")),
        base=read_base(content, str(path)),
        facts=facts,
        source=str(path),
    )


def with_rate(columns: ColumnMap | None, rate: float | None) -> ColumnMap | None:
    """A map, or none, that also says how many rows a second a log without time has [Hz]."""
    if rate is None:
        return columns
    return ColumnMap(joints={}, rate=rate) if columns is None else replace(columns, rate=rate)


def _sources(path: Path, joint: str, entries: Mapping[str, Any]) -> dict[str, Source]:
    _check_keys(path, f"joints.{joint}", entries, JOINT_SERIES)
    return {series: _source(path, f"joints.{joint}.{series}", series, entry) for series, entry in entries.items()}


def _source(path: Path, where: str, series: str, entry: Any) -> Source:
    entry = _table(path, where, {"from": entry} if isinstance(entry, str) else entry)
    _check_keys(path, where, entry, _ENTRY)
    if not isinstance(entry.get("from"), str):
        raise ValueError(f'{path}: {where} names no column; expected {{from = "COLUMN"}}. Add it.')
    units = UNITS[series.removeprefix("des_")]
    unit = entry.get("unit", next(iter(units)))
    if unit not in units:
        raise ValueError(f"{path}: {where}.unit is {unit!r}; expected one of {listed(units)}. Correct it.")
    if unit in NEED_FACTOR and "factor" not in entry:
        what = "a current" if unit in CURRENTS else "part of a largest load"
        raise ValueError(f"{path}: {where} is {what}; expected factor = N m per {NEED_FACTOR[unit]} beside it. Add it.")
    numbers = {key: entry[key] for key in ("sign", "offset", "gear_ratio", "factor") if key in entry}
    for key, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
            raise ValueError(f"{path}: {where}.{key} is {value!r}; expected a number. Correct it.")
        if (key != "offset" and value == 0) or (key == "sign" and abs(value) != 1):
            raise ValueError(f"{path}: {where}.{key} is {value}; expected {'1 or -1' if key == 'sign' else 'not 0'}.")
    return Source(channel=entry["from"], unit=unit, **{key: float(value) for key, value in numbers.items()})


def _table(path: Path, where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{path}: {where} is {value!r}; expected a table. Correct it.")
    return value


def _check_keys(path: Path, where: str, content: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in content:
        if key not in known:
            raise ValueError(
                f"{path}: {where} has the unknown key '{key}'{did_you_mean(key, known)} Keys: {listed(known)}."
            )


def write_map(path: Path, columns: ColumnMap, comments: tuple[str, ...] = ()) -> None:
    """Write a map that reads back the same."""
    text = map_text(columns, comments)
    write_atomically(path, lambda file: file.write(text.encode()))


def map_text(columns: ColumnMap, comments: tuple[str, ...] = ()) -> str:
    """A map as TOML."""
    lines = [f"# {printable(comment)}" for comment in comments]
    lines += ["", f"torque_enable = {json.dumps(columns.torque_enable)}"] if columns.torque_enable else []
    if columns.time or columns.time_unit or columns.rate:
        lines += ["", "[time]"]
        lines += [f"column = {json.dumps(columns.time)}"] if columns.time else []
        lines += [f'unit = "{columns.time_unit}"'] if columns.time_unit else []
        lines += [f"rate = {columns.rate!r}"] if columns.rate else []
    lines += base_text(columns.base)
    if columns.facts:
        lines += ["", "[facts]", *(f"{key} = {_value(value)}" for key, value in columns.facts.items())]
    for joint, sources in columns.joints.items():
        lines += ["", f"[joints.{json.dumps(joint)}]"]
        for series, source in sources.items():
            entry = [f"from = {json.dumps(source.channel)}", f'unit = "{source.unit}"']
            entry += [
                f"{key} = {value!r}"
                for key in ("sign", "offset", "gear_ratio", "factor")
                if (value := getattr(source, key)) != (0.0 if key == "offset" else 1.0)
                or (key == "factor" and source.unit in NEED_FACTOR)
            ]
            lines.append(f"{series} = {{{', '.join(entry)}}}")
        lines += [f'# {series} = {{from = "COLUMN", unit = "rad"}}' for series in _left_open(sources)]
    return "\n".join(lines).lstrip("\n") + "\n"


def _left_open(sources: Mapping[str, Source]) -> list[str]:
    """What a joint of a recording needs and has no channel for."""
    position = [] if "dof_pos" in sources else ["dof_pos"]
    return position + ([] if any(series in sources for series in COMMAND_SERIES) else ["des_dof_pos"])


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(str(key))} = {_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_value(item) for item in value)}]"
    return repr(value) if isinstance(value, float) else json.dumps(value)  # inf, and not Infinity


def printable(text: str) -> str:
    """Text without control characters, which a terminal would obey."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
