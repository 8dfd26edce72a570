"""Units that nobody wrote down, from the numbers: joint limits, commands, slopes of positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pace_actuators.joint_units import JointType, units_for

from .log import Channel
from .words import UNITS

_BEYOND = {"dof_pos": 0.2, "des_dof_pos": 2.0 * np.pi}
"""How far beyond a joint's limits positions in rad may be [rad]."""
_TURNS = 4.0 * np.pi
"""Where no limits are known, positions beyond this are degrees (up to 360), of a slide millimetres [rad, m]."""
_POSITIONS: dict[JointType, tuple[str, str]] = {"hinge": ("rad", "deg"), "slide": ("m", "mm")}
"""What positions are in, and what else they may be in."""
_WORDS = {"deg": "degrees", "mm": "millimetres"}
_NEAR = 1.3
"""Ratio of a speed to its position's slope, of that of a unit."""


def guessed_unit(
    series: str,
    channels: Mapping[str, Channel],
    positions: Mapping[str, Channel],
    limits: np.ndarray | None,
    names: Sequence[str],
    joint_type: JointType = "hinge",
) -> tuple[str, str]:
    """The unit of one series that a table has of some joints, and a note where it is not SI ("" leaves it out).

    Args:
        series: `dof_pos`, ...
        channels: Its channels, by joint.
        positions: The positions that are known already [rad, of slides m], by joint.
        limits: Of each of `names`, (n, 2) [rad, of slides m].
        names: The robot's joints.
        joint_type: Whether they turn or slide: degrees beside radians, or millimetres beside metres.
    """
    if series == "dof_pos":
        return _of_positions(channels, limits, names, joint_type)
    if series == "des_dof_pos":
        return _of_commands(channels, positions, joint_type)
    if series in ("dof_vel", "des_dof_vel"):
        return _of_speeds(series, channels, positions, joint_type)
    return units_for("N m", [joint_type]), ""


def _of_positions(
    channels: Mapping[str, Channel], limits: np.ndarray | None, names: Sequence[str], joint_type: JointType
) -> tuple[str, str]:
    whole, small = _POSITIONS[joint_type]
    word = _WORDS[small]
    largest = max(float(np.abs(channel.values).max()) for channel in channels.values())
    beyond = [0.0, 0.0]
    known = False
    if limits is not None:
        for name, channel in channels.items():
            low, high = limits[list(names).index(name)]
            if np.isfinite(low) and np.isfinite(high):
                known = True
                for i, unit in enumerate((1.0, UNITS["dof_pos"][small])):
                    outside = max(low - unit * channel.values.min(), unit * channel.values.max() - high)
                    beyond[i] = max(beyond[i], float(outside))
    if known and beyond[0] > _BEYOND["dof_pos"] >= beyond[1]:
        return (
            small,
            f"Positions reach {largest:.4g}, {beyond[0]:.3g} beyond the joints' limits in {whole}: read as {word}.",
        )
    if not known and _TURNS < largest <= (360.0 if small == "deg" else np.inf):
        return small, f"Positions reach {largest:.4g}: read as {word}."
    return whole, ""


def _of_commands(
    channels: Mapping[str, Channel], positions: Mapping[str, Channel], joint_type: JointType
) -> tuple[str, str]:
    whole, small = _POSITIONS[joint_type]
    moved = asked = 0.0
    far = {whole: 0.0, small: 0.0}
    for name, channel in channels.items():
        if (position := positions.get(name)) is None:
            continue
        command = _held(channel, position.time)
        moved, asked = moved + float(position.values.var()), asked + float(command.var())
        for unit in far:
            far[unit] += float(np.mean((command * UNITS["dof_pos"][unit] - position.values) ** 2))
    if moved and asked:  # a joint that follows late or too far is as far from its command as from none
        ratio = np.sqrt(moved / asked)
        far = {unit: abs(np.log(ratio / UNITS["dof_pos"][unit])) for unit in far}
    note = f"Commands follow the positions as {_WORDS[small]}: read so."
    return (small, note) if far[small] < far[whole] else (whole, "")


def _of_speeds(
    series: str, channels: Mapping[str, Channel], positions: Mapping[str, Channel], joint_type: JointType
) -> tuple[str, str]:
    """By how much speeds are more than the slopes of positions, all joints together."""
    both = power = 0.0
    for name, channel in channels.items():
        if (position := positions.get(name)) is None or len(position.time) < 3:
            continue
        slope = np.gradient(position.values, position.time)
        speed = np.interp(position.time, channel.time, channel.values)
        both, power = both + float(slope @ speed), power + float(slope @ slope)
    ratio = both / power if power > 0.0 else 1.0
    whole, slides = units_for("rad/s", [joint_type]), joint_type == "slide"
    near = {
        unit: abs(np.log(max(ratio, 1e-9) * factor))
        for unit, factor in UNITS["dof_vel"].items()
        if ("m/s" in unit) == slides
    }
    unit = min(near, key=lambda each: near[each])
    if series == "des_dof_vel":
        return (whole, "") if near[whole] < 1.0 or near[unit] > 0.5 else (unit, f"Speeds commanded: read as {unit}.")
    if near[unit] < np.log(_NEAR):
        return unit, "" if unit == whole else f"Speeds are {ratio:.3g} times the slopes of positions: read as {unit}."
    if not any(np.any(channel.values) for channel in channels.values()):
        return "", ""
    return "", f"Speeds are {ratio:.3g} times the slopes of positions, of no known unit: left out."


def _held(channel: Channel, at: np.ndarray) -> np.ndarray:
    return channel.values[np.clip(np.searchsorted(channel.time, at, side="right") - 1, 0, None)]
