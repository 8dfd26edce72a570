"""The speed at which a recording without measured speeds begins: the slope of its first positions."""

from __future__ import annotations

import numpy as np

from .data import Recording
from .noise import noise_floor

_WINDOWS = 0.2 * 0.7 ** np.arange(8)
"""Lengths of the beginning that a cubic is laid through [s]: the longest that it follows."""
_FEWEST = 7
"""Samples of a window."""
_FOLLOWS = 1.3
"""Times the noise that a cubic may be off."""
_AT_ONCE = 0.8
"""Part of the speed with which the first samples move: a motion that sets in has less."""
_CLEAR = 5.0
"""Standard deviations that a speed must have to be one: else the joint begins at rest."""


def start_speed(recording: Recording) -> np.ndarray:
    """Speed of each joint at its first sample, (n,) [rad/s]: measured, else the slope where it stands out of the noise.

    Args:
        recording: Its first sample is where the simulation begins.
    """
    speed = np.zeros(recording.num_joints)
    recorded = np.full(recording.num_joints, np.nan) if recording.dof_vel is None else recording.dof_vel[0]
    for j, measured in enumerate(recorded):
        speed[j] = _slope(recording.time, recording.dof_pos[:, j]) if np.isnan(measured) else measured
    return speed


def _slope(time: np.ndarray, position: np.ndarray) -> float:
    """The slope at the first sample [rad/s]; 0 where noise, or a motion that sets in, may be all there is."""
    step = float(np.median(np.diff(time)))
    noise = noise_floor(position, step).sigma
    found: list[tuple[float, float, float]] = []
    for length in _WINDOWS:
        count = int(np.searchsorted(time - time[0], length))
        if count < _FEWEST:
            break
        since = (time[:count] - time[0]) / (time[count - 1] - time[0])
        powers = np.vander(since, 4, increasing=True)
        coefficients, *_ = np.linalg.lstsq(powers, position[:count], rcond=None)
        off = float(np.sqrt(np.sum((powers @ coefficients - position[:count]) ** 2) / (count - 4)))
        if off > _FOLLOWS * noise and not found:
            continue
        std = max(noise, off) * float(np.sqrt(np.linalg.inv(powers.T @ powers)[1, 1]))
        length = float(time[count - 1] - time[0])
        gained = 2 * float(coefficients[2]) / length**2 * step
        found.append((float(coefficients[1]) / length, std / length, gained))
        if len(found) == 2:
            break
    if len(found) < 2:
        return 0.0
    (speed, std, gained), (other, other_std, _) = found
    spread = max(std, abs(speed - other) - 2 * other_std)
    if abs(speed) <= max(_CLEAR * spread, abs(gained)):  # what a step gains may be all that a first sample has
        return 0.0
    first = min(len(time) - 1, int(np.ceil(_CLEAR * noise / (abs(speed) * step))))  # a joint at rest has not moved yet
    moved = float(position[first] - position[0]) / float(time[first] - time[0])
    return speed if moved / speed > _AT_ONCE else 0.0
