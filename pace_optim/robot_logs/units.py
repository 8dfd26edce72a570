"""Units that nobody wrote down, from the numbers: joint limits, commands, slopes of positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .log import Channel
from .words import UNITS

_BEYOND = {"dof_pos": 0.2, "des_dof_pos": 2.0 * np.pi}
"""How far beyond a joint's limits positions in rad may be [rad]."""
_TURNS = 4.0 * np.pi
"""Where no limits are known, positions beyond this are degrees [rad]; more than a turn of those are not."""
_NEAR = 1.3
"""Ratio of a speed to its position's slope, of that of a unit."""


def guessed_unit(
    series: str,
    channels: Mapping[str, Channel],
    positions: Mapping[str, Channel],
    limits: np.ndarray | None,
    names: Sequence[str],
) -> tuple[str, str]:
    """The unit of one series that a table has of some joints, and a note where it is not SI ("" leaves it out).

    Args:
        series: `dof_pos`, ...
        channels: Its channels, by joint.
        positions: The positions that are known already [rad], by joint.
        limits: Of each of `names`, (n, 2) [rad].
        names: The robot's joints.
    """
    if series == "dof_pos":
        return _of_positions(channels, limits, names)
    if series == "des_dof_pos":
        return _of_commands(channels, positions)
    if series in ("dof_vel", "des_dof_vel"):
        return _of_speeds(series, channels, positions)
    return "N m", ""


def _of_positions(channels: Mapping[str, Channel], limits: np.ndarray | None, names: Sequence[str]) -> tuple[str, str]:
    degree = UNITS["dof_pos"]["deg"]
    largest = max(float(np.abs(channel.values).max()) for channel in channels.values())
    beyond = [0.0, 0.0]
    known = False
    if limits is not None:
        for name, channel in channels.items():
            low, high = limits[list(names).index(name)]
            if np.isfinite(low) and np.isfinite(high):
                known = True
                for i, unit in enumerate((1.0, degree)):
                    outside = max(low - unit * channel.values.min(), unit * channel.values.max() - high)
                    beyond[i] = max(beyond[i], float(outside))
    if known and beyond[0] > _BEYOND["dof_pos"] >= beyond[1]:
        return (
            "deg",
            f"Positions reach {largest:.4g}, {beyond[0]:.3g} beyond the joints' limits in rad: read as degrees.",
        )
    if not known and _TURNS < largest <= 360.0:
        return "deg", f"Positions reach {largest:.4g}: read as degrees."
    return "rad", ""


def _of_commands(channels: Mapping[str, Channel], positions: Mapping[str, Channel]) -> tuple[str, str]:
    far = {}
    for unit in ("rad", "deg"):
        square = [
            np.mean((_held(channel, positions[name].time) * UNITS["dof_pos"][unit] - positions[name].values) ** 2)
            for name, channel in channels.items()
            if name in positions
        ]
        far[unit] = float(np.mean(square)) if square else (0.0 if unit == "rad" else 1.0)
    return ("deg", "Commands follow the positions as degrees: read so.") if far["deg"] < far["rad"] else ("rad", "")


def _of_speeds(series: str, channels: Mapping[str, Channel], positions: Mapping[str, Channel]) -> tuple[str, str]:
    """By how much speeds are more than the slopes of positions, all joints together."""
    both = power = 0.0
    for name, channel in channels.items():
        if (position := positions.get(name)) is None or len(position.time) < 3:
            continue
        slope = np.gradient(position.values, position.time)
        speed = np.interp(position.time, channel.time, channel.values)
        both, power = both + float(slope @ speed), power + float(slope @ slope)
    ratio = both / power if power > 0.0 else 1.0
    near = {
        unit: abs(np.log(max(ratio, 1e-9) * factor)) for unit, factor in UNITS["dof_vel"].items() if "m/s" not in unit
    }
    unit = min(near, key=lambda each: near[each])
    if series == "des_dof_vel":
        return (
            ("rad/s", "") if near["rad/s"] < 1.0 or near[unit] > 0.5 else (unit, f"Speeds commanded: read as {unit}.")
        )
    if near[unit] < np.log(_NEAR):
        return unit, "" if unit == "rad/s" else f"Speeds are {ratio:.3g} times the slopes of positions: read as {unit}."
    if not any(np.any(channel.values) for channel in channels.values()):
        return "", ""
    return "", f"Speeds are {ratio:.3g} times the slopes of positions, of no known unit: left out."


def _held(channel: Channel, at: np.ndarray) -> np.ndarray:
    return channel.values[np.clip(np.searchsorted(channel.time, at, side="right") - 1, 0, None)]
