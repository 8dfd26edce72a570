"""Units that the log does not state, one for all joints of a series: from speeds, torques beside gains, and ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import signal
from scipy.integrate import cumulative_trapezoid

from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import listed
from pace_optim.recording.keys import CONDITIONS
from pace_optim.recording.time_base import held

from .log import Channel
from .words import UNITS

_TURNS = 4.0 * np.pi
"""Where no limits are known, commanded positions beyond this are degrees (up to 360), of a slide mm [rad, m]."""
_FAR: dict[JointType, float] = {"hinge": np.pi, "slide": 1.0}
"""How far beyond its limits no joint gets, or the width of its range, if that is more [rad, m]."""
_ONE_SCALE = 10.0
"""Positions and commands whose motions differ by less are in one unit."""
_POSITIONS: dict[JointType, tuple[str, str]] = {"hinge": ("rad", "deg"), "slide": ("m", "mm")}
"""What positions are in, and what else they may be in."""
_WORDS = {"deg": "degrees", "mm": "millimetres"}
_NEAR = 1.3
"""Ratio of a speed to its position's slope, of that of a unit."""
_STILL = 0.05
"""Positions within this are of a joint that stands: they say the same in degrees [rad]."""
_CLEAR = 3.0
"""How many times nearer one unit must be than the other, to be it."""
_WRONG = 5.0
"""Times its position's slope, or part of it, that a speed with a stated unit is not."""
_PAUSE = 20.0
"""Steps of the usual length that a pause is longer than: what moved in it is not known."""
_MOVES = 0.05
"""Root mean square of a slope that a speed can be held against [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of a joint beside the numbers of one series."""

    joint_type: JointType = "hinge"
    """Whether it turns or slides."""
    limits: tuple[float, float] = (-np.inf, np.inf)
    """Lower and upper limit [rad, of slides m]; infinite without a limit."""
    stiffness: float = np.nan
    """kp [N m/rad]; NaN where it is not known."""
    effort_limit: float = np.inf
    """Largest torque [N m]."""
    stated: Mapping[str, Channel] = field(default_factory=dict)
    """Its series whose unit the log states, in SI units."""
    given: Mapping[str, Channel] = field(default_factory=dict)
    """All its series, as logged."""


def guessed_units(
    series: str, known: Mapping[str, Known], positions: Mapping[str, Channel], of_positions: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """The unit of one series of a table's joints of one type ("" leaves it out), and notes where it is not SI.

    Args:
        series: `dof_pos`, ...
        known: The joints that have it, by name.
        positions: Positions whose unit was found before, in SI units, by joint.
    """
    if series in CONDITIONS:
        return dict.fromkeys(known, next(iter(UNITS[series]))), []
    joint_type = next(iter(known.values())).joint_type
    channels = {name: joint.given[series] for name, joint in known.items()}
    if series == "dof_pos":
        return _of_positions(known, channels, joint_type)
    if series == "des_dof_pos":
        return _of_commands(channels, positions, of_positions, joint_type)
    if series in ("dof_vel", "des_dof_vel"):
        return _of_speeds(series, channels, positions, joint_type)
    return _of_efforts(known, channels, joint_type)


def _of_positions(
    known: Mapping[str, Known], channels: Mapping[str, Channel], joint_type: JointType
) -> tuple[dict[str, str], list[str]]:
    """Speeds and torques in known units decide.

    Else positions are in the smaller unit if the other one is impossible on half of the joints that say anything, and
    the smaller one on no joint.
    """
    whole, small = _POSITIONS[joint_type]
    shown = [
        by for joint in known.values() if (by := _by_speeds(joint, whole, small) or _by_gains(joint, whole, small))
    ]
    far = [name for name, joint in known.items() if _is_impossible(joint, whole, joint_type)]
    saying = [name for name, channel in channels.items() if name in far or np.ptp(channel.values) > _STILL]
    unit = whole
    if shown.count(small) != shown.count(whole):
        unit, why = (small if shown.count(small) > shown.count(whole) else whole), "by their speeds or torques"
    elif 0 < len(saying) <= 2 * len(far) and not any(_is_impossible(k, small, joint_type) for k in known.values()):
        unit, why = small, f"{listed(far)} would be far outside of the possible range in {whole}"
    if unit == whole:
        return dict.fromkeys(channels, whole), []
    most = max(channels, key=lambda name: np.abs(channels[name].values).max())
    return dict.fromkeys(channels, small), [
        f"Positions reach {np.abs(channels[most].values).max():.4g} ({most}): all are read as {_WORDS[small]}, {why}."
    ]


def _is_impossible(joint: Known, unit: str, joint_type: JointType) -> bool:
    """Whether a joint cannot be where its numbers are in a unit. A command within its limits says that it can."""
    position, command = joint.given["dof_pos"].values, joint.given.get("des_dof_pos")
    factor, (low, high) = UNITS["dof_pos"][unit], joint.limits
    if not np.isfinite(high - low):
        far = float(np.abs(position).max()) * factor
        most = _TURNS if factor == 1.0 else 2 * np.pi if joint_type == "hinge" else np.inf
        return command is not None and far > most
    widest = max(high - low, _FAR[joint_type])
    if command is not None and np.ptp(position) < _ONE_SCALE * np.ptp(command.values):
        position = command.values if _beyond(command.values * factor, low, high) < widest else position
    return _beyond(position * factor, low, high) > widest


def _beyond(values: np.ndarray, low: float, high: float) -> float:
    return float(max(low - values.min(), values.max() - high))


def _by_speeds(joint: Known, whole: str, small: str) -> str:
    """The unit of positions whose slopes are the speeds that the log states in SI units; "" where that is not said."""
    speed, position = joint.stated.get("dof_vel"), joint.given["dof_pos"]
    if speed is None or len(position.time) < 3:
        return ""
    slope = np.gradient(position.values, position.time)
    there = np.interp(position.time, speed.time, speed.values)
    if not np.sqrt(np.mean(there**2)) > _MOVES or not slope @ slope:
        return ""
    return _nearer(float(slope @ there / (slope @ slope)), whole, small)


def _by_gains(joint: Known, whole: str, small: str) -> str:
    """The unit of positions and commands with which the torque's kp is the drive's; "" where that is not said."""
    effort, position, command = (joint.given.get(key) for key in ("dof_effort", "dof_pos", "des_dof_pos"))
    if effort is None or command is None or position is None or not joint.stiffness > 0:
        return ""
    error = held(command.time, command.values, position.time) - position.values
    torque = np.interp(position.time, effort.time, effort.values)
    columns = np.stack([error, np.gradient(position.values, position.time), np.ones(len(error))], axis=1)
    gain = float(np.linalg.lstsq(columns, torque, rcond=None)[0][0]) if len(error) > 3 else 0.0
    return _nearer(gain / joint.stiffness, whole, small) if gain > 0 else ""


def _nearer(ratio: float, whole: str, small: str) -> str:
    """The unit of which one is a ratio of SI units; "" where neither is clearly nearer."""
    away = {unit: abs(np.log(max(ratio, 1e-12) / UNITS["dof_pos"][unit])) for unit in (whole, small)}
    near = min(away, key=lambda unit: away[unit])
    return near if away[near] < np.log(_CLEAR) else ""


def _of_commands(
    channels: Mapping[str, Channel],
    positions: Mapping[str, Channel],
    of_positions: Mapping[str, str],
    joint_type: JointType,
) -> tuple[dict[str, str], list[str]]:
    """Joints move as far as their commands; commands of joints that stand have the unit of the positions."""
    whole, small = _POSITIONS[joint_type]
    both = {
        name: (positions[name].values, held(channel.time, channel.values, positions[name].time))
        for name, channel in channels.items()
        if name in positions
    }
    moved = {name: np.std(position) / np.std(command) for name, (position, command) in both.items() if np.std(command)}
    if ratios := [ratio for ratio in moved.values() if ratio > 0]:  # one that follows late or too far counts as one
        away = {unit: abs(float(np.median(np.log(ratios))) - np.log(UNITS["dof_pos"][unit])) for unit in (whole, small)}
    else:
        means = [(float(position.mean()), float(command.mean())) for position, command in both.values()]
        away = {unit: sum(abs(c * UNITS["dof_pos"][unit] - q) for q, c in means) for unit in (whole, small)}
    for unit in {of_positions[name] for name in both} & away.keys():  # which is likelier than another one
        away[unit] *= 0.5
    unit = min(away, key=lambda each: away[each])
    notes = [f"Commands follow the positions as {_WORDS[small]}: all are read so."] if unit == small else []
    return dict.fromkeys(channels, unit), notes


def _of_speeds(
    series: str, channels: Mapping[str, Channel], positions: Mapping[str, Channel], joint_type: JointType
) -> tuple[dict[str, str], list[str]]:
    """The unit in which most joints' speeds are the slopes of their positions; those that are not are left out."""
    whole, slides = units_for("rad/s", [joint_type]), joint_type == "slide"
    ratios: dict[str, float] = {}
    for name, channel in channels.items():
        if (position := positions.get(name)) is not None and len(position.time) >= 3:
            slope = np.gradient(position.values, position.time)
            speed = np.interp(position.time, channel.time, channel.values)
            if np.mean(slope**2) > _MOVES**2:
                ratios[name] = max(float(slope @ speed / (slope @ slope)), 1e-9)
    usual = float(np.median(np.log(list(ratios.values())))) if ratios else 0.0
    away = {unit: abs(usual + np.log(factor)) for unit, factor in UNITS["dof_vel"].items() if ("m/s" in unit) == slides}
    unit = min(away, key=lambda unit: away[unit])
    if series == "des_dof_vel":
        units = dict.fromkeys(channels, whole if away[whole] < 1.0 or away[unit] > 0.5 else unit)
        strange: dict[str, float] = {}
    else:
        each = {name: ratios[name] if name in ratios else float(np.exp(usual)) for name in channels}
        off = {name: abs(np.log(ratio * UNITS["dof_vel"][unit])) for name, ratio in each.items()}
        units = {name: unit if off[name] < np.log(_NEAR) else "" for name in channels}
        strange = {name: ratio for name, ratio in each.items() if not units[name]}
        strange = {name: ratio for name, ratio in strange.items() if np.any(channels[name].values)}
    word = "Speeds commanded" if series == "des_dof_vel" else "Speeds"
    read = [name for name in units if units[name] not in ("", whole)]
    notes = [f"{word} of {listed(read)}, beside the slopes of positions: read as {units[read[0]]}."] if read else []
    if strange:
        ratios_of = listed(f"{name} ({ratio:.3g})" for name, ratio in strange.items())
        notes.append(f"Speeds are no slopes of positions in any known unit: left out. Times the slope: {ratios_of}.")
    return units, notes


def no_slopes(speeds: Mapping[str, Channel], positions: Mapping[str, Channel]) -> dict[str, float]:
    """How many times the slope of its position a speed is, of joints where that is far from 1.

    The speed's integral is held against the position, between pauses: an encoder's noise counts little there.

    Args:
        speeds: By joint, in SI units.
        positions: By joint, in SI units.
    """
    result = {}
    for name, channel in speeds.items():
        position = positions.get(name)
        if position is None or len(position.time) < 3:
            continue
        there = np.interp(position.time, channel.time, channel.values)
        step = np.diff(position.time)
        ends = np.flatnonzero(step > _PAUSE * np.median(step)) + 1
        stretches = zip(*(np.split(each, ends) for each in (position.time, there, position.values)), strict=True)
        parts = [
            (signal.detrend(cumulative_trapezoid(speed, time, initial=0.0)), signal.detrend(values))
            for time, speed, values in stretches
            if len(time) >= 3
        ]
        if not parts:
            continue
        moved, reached = (np.concatenate(each) for each in zip(*parts, strict=True))
        if np.std(reached) < _STILL:
            continue
        ratio = float(moved @ reached / (reached @ reached))
        if not 1 / _WRONG < ratio < _WRONG:
            result[name] = ratio
    return result


def _of_efforts(
    known: Mapping[str, Known], channels: Mapping[str, Channel], joint_type: JointType
) -> tuple[dict[str, str], list[str]]:
    """N m, unless the numbers are those of a register: whole, and beyond what the drive can give."""
    whole = units_for("N m", [joint_type])
    units, registers = {}, []
    for name, channel in channels.items():
        values, limit = channel.values, known[name].effort_limit
        largest = float(np.abs(values).max())
        is_register = bool(np.all(values == np.round(values))) and largest > (3 * limit if np.isfinite(limit) else 100)
        units[name] = "" if is_register else whole
        registers += [f"{channel.key} (up to {largest:.4g})"] if is_register else []
    if not registers:
        return units, []
    return units, [
        f"{listed(registers)}: whole numbers, as of a register in permille, percent or mA, and no {whole}: left out. "
        "If you know what one is, give unit and factor in a column map."
    ]
