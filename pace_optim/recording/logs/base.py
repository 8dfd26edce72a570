"""What a log says of a base that moves and of its feet: which channels, guessed from their names, and their series."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pace_actuators.text import listed
from pace_optim.recording.keys import BASE_COLUMNS
from pace_optim.recording.time_base import interpolate_nearest

from .log import Log
from .words import PER_S

BASE_UNITS = {
    "base_ang_vel": {"rad/s": 1.0, "deg/s": np.pi / 180, "mrad/s": 1e-3},
    "base_lin_acc": {"m/s²": 1.0, "g": 9.81, "mg": 9.81e-3, "mm/s²": 1e-3},
    "base_quat": {"": 1.0},
}
"""Units of what an IMU shows, in SI units."""
_WORDS = {
    "base_ang_vel": re.compile(r"ang(ular)?_?vel(ocity)?|gyro(scope)?", re.IGNORECASE),
    "base_lin_acc": re.compile(r"lin(ear)?_?acc(el(eration)?)?|acc(el(ero(meter)?)?)?|specific_?force", re.IGNORECASE),
    "base_quat": re.compile(r"orientation|quat(ernion)?", re.IGNORECASE),
}
_SPELT = {
    "mrad/s": rf"mrad{PER_S}|mrad_s",
    "rad/s": rf"rad(ians?)?{PER_S}|rad_s",
    "deg/s": rf"deg(rees?)?{PER_S}|deg_s|dps|°/s(ec)?",
    "mm/s²": r"mm/s(\^?2|²|/s)",
    "m/s²": r"m[ _]?/[ _]?s(ec)?(\^?2|²|/s)|m_s2|mps2",
    "mg": "mg",
    "g": "g",
}
"""How units are written at the end of a name."""
_AXIS = re.compile(r"(?:^|[^a-z])([wxyz])\]?$|([WXYZ])$")
_CONTACT = re.compile(r"(foot|feet|toe)?[_. /]?contacts?([_. /]?state)?|touch", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class Channels:
    """The channels of a series, one for each of its columns."""

    names: tuple[str, ...]
    unit: str = ""
    """"": SI."""


@dataclass(frozen=True, kw_only=True)
class BaseMap:
    """Which channels say how a base moves and where its feet stand."""

    series: Mapping[str, Channels]
    """Of ``base_ang_vel``, ``base_lin_acc`` and ``base_quat``."""
    contact: Mapping[str, str]
    """Channel of each foot's contact, by the foot."""
    foot_force: Mapping[str, Channels]
    """One channel of each foot's force, or three, by the foot."""

    @property
    def channels(self) -> set[str]:
        """All of them."""
        forces = (name for each in self.foot_force.values() for name in each.names)
        return {*self.contact.values(), *forces, *(name for each in self.series.values() for name in each.names)}


NO_BASE = BaseMap(series={}, contact={}, foot_force={})


def guess_base(log: Log) -> tuple[BaseMap, list[str]]:
    """The channels of an IMU and of contacts, and a note on them; none where both series of an IMU are not there.

    Args:
        log: Such as a topic ``sensor_msgs/Imu``, or columns ``gyro_x`` and ``acc_x``.
    """
    found: dict[tuple[str, str, str], dict[str, str]] = {}
    like_an_imu = []
    for key, channel in log.channels.items():
        series = next((name for name, word in _WORDS.items() if word.search(channel.name)), "")
        if not series or channel.series:
            continue
        bare, unit = _without_unit(key, series)
        if (axis := _AXIS.search(bare)) is not None:
            found.setdefault((series, channel.table, unit), {})[(axis[1] or axis[2]).lower()] = key
        if series != "base_quat" and (axis or _AXIS.search(re.sub(r"\s*[\[(][^\[(]*$", "", bare))):
            like_an_imu.append(key)
    whole: dict[str, Channels] = {}
    for (series, _, unit), by_axis in found.items():
        columns = BASE_COLUMNS[series]
        if set(by_axis) >= set(columns) and series not in whole:
            whole[series] = Channels(names=tuple(by_axis[axis] for axis in columns), unit=unit)
    if not {"base_ang_vel", "base_lin_acc"} <= set(whole):
        return NO_BASE, [
            f"{listed(like_an_imu, 6)}: like an IMU's, but not used; expected x, y and z of angular velocity "
            f"({listed(BASE_UNITS['base_ang_vel'])}) and of acceleration ({listed(BASE_UNITS['base_lin_acc'])}). If "
            "the base moves, map them: [base] in a column map."
        ] * bool(like_an_imu)
    contact = _contacts(log)
    said = [
        f"{series} from {each.names[0]} …{f' in {each.unit}' if each.unit else ''}" for series, each in whole.items()
    ]
    said += [f"contact of {listed(contact, 4)}"] if contact else []
    return BaseMap(series=whole, contact=contact, foot_force={}), [f"The base moves: {', '.join(said)}."]


def _without_unit(key: str, series: str) -> tuple[str, str]:
    """A name without the unit at its end, and that unit; "" where it states none of ours."""
    for unit in (unit for unit in _SPELT if unit in BASE_UNITS[series]):
        if at := re.search(rf"(?:[ _]*[\[(] *|[ _])(?:{_SPELT[unit]}) *[\])]?$", key, re.IGNORECASE):
            return key[: at.start()], unit
    return key, ""


def _contacts(log: Log) -> dict[str, str]:
    result: dict[str, str] = {}
    for key, channel in log.channels.items():
        if _CONTACT.search(channel.name) and np.isin(channel.values, (0, 1)).all() and not channel.series:
            foot = _CONTACT.sub("", channel.name).strip("_. /[]")
            if foot and not foot.isdigit():
                result.setdefault(foot, key)
    return result


def base_fields(log: Log, base: BaseMap, time: np.ndarray) -> dict[str, Any]:
    """The fields of a recording, at its instants (T,) [s].

    What an IMU shows is interpolated straight, contacts keep to the nearest value.
    """
    result: dict[str, Any] = {}
    for series, channels in base.series.items():
        scale = BASE_UNITS[series][channels.unit or next(iter(BASE_UNITS[series]))]
        straight = series != "base_quat"
        result[series] = scale * np.stack([_at(log, name, time, straight) for name in channels.names], axis=1)
    if base.contact:
        result["feet"] = list(base.contact)
        result["contact"] = np.stack([_at(log, name, time, False) for name in base.contact.values()], axis=1)
    if base.foot_force:
        result["feet"] = list(base.foot_force)
        parts = [[_at(log, name, time, True) for name in each.names] for each in base.foot_force.values()]
        array = np.stack([np.stack(part, axis=1) for part in parts], axis=1)
        result["foot_force"] = array[..., 0] if array.shape[2] == 1 else array
    return result


def _at(log: Log, name: str, time: np.ndarray, straight: bool) -> np.ndarray:
    channel = log.channel(name)
    if straight:
        return np.interp(time, channel.time, channel.values)
    return interpolate_nearest(channel.time, channel.values, time)


def read_base(content: Mapping[str, Any], path: str) -> BaseMap:
    """The tables ``base``, ``contact`` and ``foot_force`` of a column map."""
    series: dict[str, Channels] = {}
    for key, entry in content.get("base", {}).items():
        if key not in BASE_COLUMNS:
            raise ValueError(f"{path}: base has the unknown key '{key}'; expected {listed(BASE_COLUMNS)}. Correct it.")
        series[key] = _channels(entry, f"{path}: base.{key}", (len(BASE_COLUMNS[key]),), tuple(BASE_UNITS[key]))
    contact = {
        foot: _channels(entry, f"{path}: contact.{foot}", (1,), ("",)).names[0]
        for foot, entry in content.get("contact", {}).items()
    }
    force = {
        foot: _channels(entry, f"{path}: foot_force.{foot}", (1, 3), ("", "N"))
        for foot, entry in content.get("foot_force", {}).items()
    }
    return BaseMap(series=series, contact=contact, foot_force=force)


def _channels(entry: Any, where: str, counts: Sequence[int], units: Sequence[str]) -> Channels:
    entry = entry if isinstance(entry, Mapping) else {"from": entry}
    names = entry.get("from")
    names = [names] if isinstance(names, str) else names
    fine = isinstance(names, list) and all(isinstance(name, str) for name in names) and len(names) in counts
    if not fine or not set(entry) <= {"from", "unit"}:
        wanted = " or ".join(str(count) for count in counts)
        raise ValueError(f"{where} is {entry!r}; expected from = [{wanted} columns], and unit. Correct it.")
    unit = entry.get("unit", "")
    if unit and unit not in units:
        raise ValueError(f"{where}.unit is {unit!r}; expected one of {listed(units)}. Correct it.")
    return Channels(names=tuple(names), unit=unit)


def base_text(base: BaseMap) -> list[str]:
    """The tables as lines of TOML."""
    lines: list[str] = []
    if base.series:
        lines += ["", "[base]", *(f"{key} = {_entry(each)}" for key, each in base.series.items())]
    if base.contact:
        lines += ["", "[contact]", *(f"{json.dumps(foot)} = {json.dumps(name)}" for foot, name in base.contact.items())]
    if base.foot_force:
        lines += [
            "",
            "[foot_force]",
            *(f"{json.dumps(foot)} = {_entry(each)}" for foot, each in base.foot_force.items()),
        ]
    return lines


def _entry(channels: Channels) -> str:
    names = ", ".join(json.dumps(name) for name in channels.names)
    return f"{{from = [{names}]{f', unit = {json.dumps(channels.unit)}' if channels.unit else ''}}}"
