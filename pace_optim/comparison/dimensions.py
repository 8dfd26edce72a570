"""What the error is laid out against: speed, direction, reversals, position, load, acceleration, gait, time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from pace_actuators.joint_units import JointType, units_for

_CUTOFF = 30.0
"""Of the smoothing [Hz]."""
_STANDSTILL_SHARE = 0.01
_STANDSTILL_SIGMAS = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """One joint in one recording, K samples."""

    position: np.ndarray
    """Smoothed, (K,) [rad]."""
    speed: np.ndarray
    """With its sign, (K,) [rad/s]."""
    acceleration: np.ndarray
    """(K,) [rad/s²]."""
    standstill: float
    """Below this speed the joint counts as standing [rad/s]."""
    direction: np.ndarray
    """Of the motion or, where the joint stands, of the last motion: −1 or 1, (K,)."""
    since_reversal: np.ndarray
    """Time since the direction changed, infinite before it first did, (K,) [s]."""


def motion_of(position: np.ndarray, dt: float, sigma: float) -> Motion:
    """Smooth a measured position without delay and differentiate it.

    Args:
        position: (K,) [rad].
        dt: Sample time [s].
        sigma: Its noise [rad].
    """
    nyquist = 0.5 / dt
    cutoff = min(_CUTOFF, 0.4 * nyquist)
    filter_ = signal.butter(3, cutoff / nyquist, output="sos")
    smooth = signal.sosfiltfilt(filter_, position, padlen=min(len(position) - 1, round(3 / (cutoff * dt))))
    speed = np.gradient(smooth, dt)
    # white noise of this sigma, differentiated below the cutoff
    speed_noise = sigma * 2 * np.pi * cutoff * np.sqrt(cutoff / (3 * nyquist))
    usual = float(np.quantile(np.abs(speed), 0.99))
    standstill = max(_STANDSTILL_SIGMAS * speed_noise, _STANDSTILL_SHARE * usual)
    direction, since = _reversals(speed, standstill, dt)
    return Motion(
        position=smooth,
        speed=speed,
        acceleration=np.gradient(speed, dt),
        standstill=standstill,
        direction=direction,
        since_reversal=since,
    )


def _reversals(speed: np.ndarray, standstill: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    moving = np.flatnonzero(np.abs(speed) > standstill)
    if not len(moving):
        return np.ones(len(speed)), np.full(len(speed), np.inf)
    last = np.searchsorted(moving, np.arange(len(speed)), side="right") - 1
    direction = np.sign(speed[moving[np.maximum(last, 0)]])
    # the joint turns where its speed is zero, before it is fast enough to count as moving
    turns = []
    for i in np.flatnonzero(np.diff(direction)) + 1:
        before = moving[np.searchsorted(moving, i) - 1]
        crossing = np.flatnonzero(np.sign(speed[before : i + 1]) == direction[i])
        turns.append(before + int(crossing[0]) if len(crossing) else i)
    for turn, i in zip(turns, np.flatnonzero(np.diff(direction)) + 1, strict=True):
        direction[turn:i] = direction[i]
    since = np.full(len(speed), np.inf)
    for turn, following in zip(turns, [*turns, len(speed)][1:], strict=True):
        since[turn:following] = dt * np.arange(following - turn)
    return direction, since


_REVERSAL_EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, np.inf)
_POSITION_BINS = 8
_NEXT_SPEED = 1.3
"""An edge of speed is at least this many times the one below."""
_TIME_BINS = 10
_QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)
SWING = "swing"
"""Name of the dimension that is how much of a swing has passed."""
_LEAST_PER_BIN = 0.005
"""A bin with less of the time than this says nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Dimension:
    """One quantity at every sample, cut into bins."""

    name: str
    """Its key in comparison.json."""
    title: str
    """Its axis."""
    unit: str
    edges: tuple[float, ...]
    """B + 1, rising; the outermost may be infinite. Of ``recording``: −½, ½, …"""
    bin: np.ndarray
    """Which bin each sample is in, (K,) int."""
    neighbours: bool = True
    """Whether bins that touch may be named as one."""

    @property
    def num_bins(self) -> int:
        """Number of bins B."""
        return len(self.edges) - 1


def dimensions_of(
    motions: Sequence[Motion],
    times: Sequence[np.ndarray],
    loads: Sequence[np.ndarray] | None,
    enabled: Sequence[np.ndarray] | None = None,
    joint_type: JointType = "hinge",
    swings: Sequence[np.ndarray] | None = None,
) -> list:
    """Every dimension of one joint over all its recordings, whose samples follow each other.

    Args:
        times: Of each recording, (K_r,) [s].
        loads: Load torque in each recording, (K_r,) [N m], if known.
        enabled: Whether the drive gave torque in each recording, (K_r,) bool; ``None``: always.
        joint_type: Whether it turns or slides.
        swings: How much of its swing a joint of a walking robot has behind it, (K_r,); ``None``: nothing walks.
    """
    speed = np.concatenate([motion.speed for motion in motions])
    acceleration = np.concatenate([motion.acceleration for motion in motions])
    position = np.concatenate([motion.position for motion in motions])
    direction = np.concatenate([motion.direction for motion in motions])
    since = np.concatenate([motion.since_reversal for motion in motions])
    time = np.concatenate([np.asarray(t) - t[0] for t in times])
    still = _round(max(motion.standstill for motion in motions))
    types = [joint_type]
    speed_unit = units_for("rad/s", types)
    sizes = _size_edges(np.abs(speed), still)
    result = [
        _cut("speed", "speed", speed_unit, np.abs(speed), sizes),
        _cut("velocity", "velocity", speed_unit, speed, _mirrored(sizes)),
        _cut("direction", "direction of motion", "", direction, (-np.inf, 0.0, np.inf)),
        _cut("since_reversal", "time since the last reversal", "s", since, _REVERSAL_EDGES),
        _cut("position", "position", units_for("rad", types), position, _even_edges(position)),
        *_sized("acceleration", "acceleration", units_for("rad/s²", types), acceleration),
        _cut("time", "time", "s", time, _time_edges(time)),
    ]
    if loads is not None:
        result += _sized(
            "load",
            "load force" if joint_type == "slide" else "load torque",
            units_for("N m", types),
            np.concatenate(loads),
        )
    if swings is not None:
        behind = np.nan_to_num(np.concatenate(swings))
        result.append(
            Dimension(name=SWING, title="part of the swing", unit="", edges=_QUARTERS, bin=_index(behind, _QUARTERS))
        )
    if enabled is not None:
        on = np.concatenate(enabled).astype(float)
        result.append(_cut("drive", "drive off, on", "", on, (-np.inf, 0.5, np.inf)))
    if len(motions) > 1:
        which = np.concatenate([np.full(len(t), r) for r, t in enumerate(times)])
        edges = tuple(np.arange(len(times) + 1) - 0.5)
        result.append(Dimension(name="recording", title="recording", unit="", edges=edges, bin=which, neighbours=False))
    return [dimension for dimension in result if dimension.num_bins > 1]


def _sized(name: str, title: str, unit: str, values: np.ndarray) -> list[Dimension]:
    """A signed quantity, and its size."""
    size = np.abs(values)
    edges = _distinct([0.0, *(_round(float(np.quantile(size, q))) for q in (0.25, 0.5, 0.75, 0.9)), np.inf])
    return [
        _cut(name, title, unit, values, _mirrored(edges)),
        _cut(f"{name}_size", f"size of the {title}", unit, size, edges),
    ]


def _cut(name: str, title: str, unit: str, values: np.ndarray, edges: Sequence[float]) -> Dimension:
    """Bins from edges; those with next to no samples are joined to a neighbour."""
    kept = list(edges)
    while len(kept) > 2:
        count = np.bincount(_index(values, kept), minlength=len(kept) - 1)
        scarce = np.flatnonzero(count < _LEAST_PER_BIN * len(values))
        if not len(scarce):
            break
        b = int(scarce[0])
        kept.pop(b if b == len(kept) - 2 else b + 1)
    return Dimension(name=name, title=title, unit=unit, edges=tuple(kept), bin=_index(values, kept))


def _index(values: np.ndarray, edges: Sequence[float]) -> np.ndarray:
    return np.searchsorted(np.asarray(edges[1:-1]), values, side="right")


def _size_edges(size: np.ndarray, still: float) -> tuple[float, ...]:
    """Standing, then the moving samples in thirds, the fastest tenth apart."""
    moving = size[size > still]
    if not len(moving):
        return (0.0, np.inf)
    inner = [still]
    for q in (0.3, 0.6, 0.9):
        edge = _round(float(np.quantile(moving, q)))
        if edge > _NEXT_SPEED * inner[-1]:
            inner.append(edge)
    return (0.0, *inner, np.inf)


def _mirrored(edges: Sequence[float]) -> tuple[float, ...]:
    inner = [edge for edge in edges if edge > 0]
    return (*(-edge for edge in reversed(inner)), *inner) if inner[0] < np.inf else (-np.inf, 0.0, np.inf)


def _even_edges(values: np.ndarray) -> tuple[float, ...]:
    low, high = (float(q) for q in np.quantile(values, (0.01, 0.99)))
    inner = [_round(edge, high - low) for edge in np.linspace(low, high, _POSITION_BINS + 1)[1:-1]]
    return _distinct([-np.inf, *inner, np.inf])


def _time_edges(time: np.ndarray) -> tuple[float, ...]:
    end = float(time.max())
    return _distinct([0.0, *(_round(end * i / _TIME_BINS, end) for i in range(1, _TIME_BINS)), np.inf])


def _distinct(edges: Sequence[float]) -> tuple[float, ...]:
    return tuple(dict.fromkeys(edges))


def _round(value: float, scale: float | None = None) -> float:
    """To two digits, or to a hundredth of a scale, as one would say it."""
    scale = abs(value) if scale is None else abs(scale)
    if scale <= 0 or not np.isfinite(scale):
        return value
    return float(round(value, 1 - int(np.floor(np.log10(scale)))))
