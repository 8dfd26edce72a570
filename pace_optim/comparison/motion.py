"""What a joint was doing at each sample: speed, acceleration, direction, time since it turned round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

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
