"""Units that the log does not state, joint by joint: from ranges, speeds beside slopes, efforts beside gains, noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import listed
from pace_optim.recording.keys import CONDITIONS
from pace_optim.recording.noise import noise_floor

from .log import Channel
from .words import UNITS

_BEYOND = 0.2
"""How far beyond a joint's limits positions may be [rad]."""
_TURNS = 4.0 * np.pi
"""Where no limits are known, commanded positions beyond this are degrees (up to 360), of a slide mm [rad, m]."""
_POSITIONS: dict[JointType, tuple[str, str]] = {"hinge": ("rad", "deg"), "slide": ("m", "mm")}
"""What positions are in, and what else they may be in."""
_WORDS = {"deg": "degrees", "mm": "millimetres"}
_NEAR = 1.3
"""Ratio of a speed to its position's slope, of that of a unit."""
_STILL = 0.05
"""Positions within this are of a joint that stands: they say the same in degrees [rad]."""
_CLEAR = 3.0
"""How many times nearer one unit must be than the other, to be it."""
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


class UnknownUnitError(ValueError):
    """Joints may be in either of two units; the message names them."""

    def __init__(self, message: str, units: dict[str, str]) -> None:
        super().__init__(message)
        self.units = units
        """A guess of all, by joint."""


def guessed_units(
    series: str, known: Mapping[str, Known], positions: Mapping[str, Channel], of_positions: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """The unit of one series of a table's joints of one type ("" leaves it out), and notes where it is not SI.

    Args:
        series: `dof_pos`, ...
        known: The joints that have it, by name.
        positions: Positions whose unit was found before, in SI units, by joint.

    Raises:
        UnknownUnitError: If a joint may be in either of two units.
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
    return _of_efforts(series, known, channels, joint_type)


def _of_positions(
    known: Mapping[str, Known], channels: Mapping[str, Channel], joint_type: JointType
) -> tuple[dict[str, str], list[str]]:
    whole, small = _POSITIONS[joint_type]
    units: dict[str, str] = {}
    why: dict[str, str] = {}
    for name, channel in channels.items():
        joint = known[name]
        beyond, within = (_outside(channel.values * UNITS["dof_pos"][unit], joint.limits) for unit in (whole, small))
        limited = all(np.isfinite(joint.limits))
        if limited and beyond > _BEYOND >= within:
            units[name], why[name] = small, f"{beyond:.3g} beyond its limits in {whole}"
        elif by := _by_speeds(joint, whole, small) or _by_gains(joint, whole, small):
            units[name], why[name] = by, "by its speeds or torques"
        elif not limited and (furthest := np.abs(channel.values).max()) > _TURNS:
            far = furthest <= (360.0 if small == "deg" else np.inf)
            units[name] = small if far and "des_dof_pos" in joint.given else whole
            why[name] = "and it follows a position" if units[name] == small else ""
    if small not in units.values():
        return {name: units.get(name, whole) for name in channels}, []
    open_ones = [name for name in channels if name not in units]
    units |= {name: _like_others(name, channels, units, small) for name in open_ones}
    if unknown := [name for name in open_ones if not units[name]]:
        ranges = listed(f"{n} ({channels[n].values.min():.3g} to {channels[n].values.max():.3g})" for n in unknown)
        there = listed(name for name in units if units[name] == small)
        raise UnknownUnitError(
            f"the unit of {ranges}: {whole} or {_WORDS[small]}, as {there} {'is' if ',' not in there else 'are'} in",
            {name: unit or small for name, unit in units.items()},
        )
    notes = [
        f"Positions of {name} reach {np.abs(channels[name].values).max():.4g}"
        f"{', ' + why[name] if why.get(name) else ''}: read as {_WORDS[small]}."
        for name in channels
        if units[name] == small
    ]
    if mixed := [name for name in open_ones if units[name] == whole]:
        notes.append(f"Positions of {listed(mixed)} are read in {whole}: only so their noise is like the others'.")
    return units, notes


def _outside(values: np.ndarray, limits: tuple[float, float]) -> float:
    return float(max(limits[0] - values.min(), values.max() - limits[1]))


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
    error = held(command, position.time) - position.values
    torque = np.interp(position.time, effort.time, effort.values)
    columns = np.stack([error, np.gradient(position.values, position.time), np.ones(len(error))], axis=1)
    gain = float(np.linalg.lstsq(columns, torque, rcond=None)[0][0]) if len(error) > 3 else 0.0
    return _nearer(gain / joint.stiffness, whole, small) if gain > 0 else ""


def _nearer(ratio: float, whole: str, small: str) -> str:
    """The unit of which one is a ratio of SI units; "" where neither is clearly nearer."""
    away = {unit: abs(np.log(max(ratio, 1e-12) / UNITS["dof_pos"][unit])) for unit in (whole, small)}
    near = min(away, key=lambda unit: away[unit])
    return near if away[near] < np.log(_CLEAR) else ""


def _like_others(name: str, channels: Mapping[str, Channel], units: Mapping[str, str], small: str) -> str:
    """The unit of a joint whose numbers fit both, beside joints in the smaller one: their encoders are alike.

    "" where its noise does not show it.
    """
    own = channels[name]
    if np.ptp(own.values) < _STILL:
        return small
    whole = "rad" if small == "deg" else "m"
    others = [_noise(channels[other]) * UNITS["dof_pos"][units[other]] for other in units if units[other] == small]
    noise, usual = _noise(own), float(np.median(others))
    away = {u: abs(np.log(max(noise * UNITS["dof_pos"][u], 1e-12) / max(usual, 1e-12))) for u in (whole, small)}
    near, far = sorted(away, key=lambda unit: away[unit])
    clear = away[far] - away[near] >= np.log(_CLEAR) and away[near] <= np.log(10.0)
    return near if clear else ""


def _noise(channel: Channel) -> float:
    step = float(np.median(np.diff(channel.time))) if len(channel.time) > 1 else 1.0
    return noise_floor(channel.values, step).sigma


def _of_commands(
    channels: Mapping[str, Channel],
    positions: Mapping[str, Channel],
    of_positions: Mapping[str, str],
    joint_type: JointType,
) -> tuple[dict[str, str], list[str]]:
    """A joint moves as far as its command; the command of one that stands has the unit of its position."""
    whole, small = _POSITIONS[joint_type]
    units = {}
    for name, channel in channels.items():
        units[name] = whole
        if (position := positions.get(name)) is None:
            continue
        command = held(channel, position.time)
        moved, asked = float(np.std(position.values)), float(np.std(command))
        if moved > 0 and asked > 0:  # a joint that follows late or too far is as far from its command as from none
            away = {unit: abs(np.log(moved / asked / UNITS["dof_pos"][unit])) for unit in (whole, small)}
        else:
            mean = float(position.values.mean())
            away = {unit: abs(float(command.mean()) * UNITS["dof_pos"][unit] - mean) for unit in (whole, small)}
        if of_positions.get(name) in away:  # which is likelier than another one
            away[of_positions[name]] *= 0.5
        units[name] = min(away, key=lambda unit: away[unit])
    told = [name for name, unit in units.items() if unit == small]
    return units, [f"Commands of {listed(told)} follow the positions as {_WORDS[small]}: read so."] if told else []


def _of_speeds(
    series: str, channels: Mapping[str, Channel], positions: Mapping[str, Channel], joint_type: JointType
) -> tuple[dict[str, str], list[str]]:
    """By how much speeds are more than the slopes of positions: each joint's that moves, others' as all together."""
    sums: dict[str, np.ndarray] = {}
    for name, channel in channels.items():
        sums[name] = np.zeros(3)
        if (position := positions.get(name)) is not None and len(position.time) >= 3:
            slope = np.gradient(position.values, position.time)
            speed = np.interp(position.time, channel.time, channel.values)
            sums[name] = np.array([slope @ speed, slope @ slope, len(slope)])
    both, power, _ = np.sum(list(sums.values()), axis=0)
    every = both / power if power > 0 else 1.0
    whole, slides = units_for("rad/s", [joint_type]), joint_type == "slide"
    units: dict[str, str] = {}
    strange: dict[str, float] = {}
    for name, (own, square, count) in sums.items():
        ratio = own / square if count and square / count > _MOVES**2 else every
        away = {
            unit: abs(np.log(max(ratio, 1e-9) * factor))
            for unit, factor in UNITS["dof_vel"].items()
            if ("m/s" in unit) == slides
        }
        unit = min(away, key=lambda each: away[each])
        if series == "des_dof_vel":
            units[name] = whole if away[whole] < 1.0 or away[unit] > 0.5 else unit
        elif away[unit] < np.log(_NEAR):
            units[name] = unit
        else:
            units[name] = ""
            if np.any(channels[name].values):
                strange[name] = ratio
    word = "Speeds commanded" if series == "des_dof_vel" else "Speeds"
    notes = [
        f"{word} of {listed(n for n in units if units[n] == unit)}, beside the slopes of positions: read as {unit}."
        for unit in dict.fromkeys(units.values())
        if unit not in ("", whole)
    ]
    if strange:
        ratios = listed(f"{name} ({ratio:.3g})" for name, ratio in strange.items())
        notes.append(f"Speeds are no slopes of positions in any known unit: left out. Times the slope: {ratios}.")
    return units, notes


def _of_efforts(
    series: str, known: Mapping[str, Known], channels: Mapping[str, Channel], joint_type: JointType
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


def held(channel: Channel, at: np.ndarray) -> np.ndarray:
    """A channel's values as they are in force at some instants."""
    return channel.values[np.clip(np.searchsorted(channel.time, at, side="right") - 1, 0, None)]
