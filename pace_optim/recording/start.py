"""How fast a recording begins, where it holds no speeds."""

from __future__ import annotations

import numpy as np

from .data import Recording
from .noise import noise_floor

_LONGEST = 0.25
"""Time from the beginning in which a slope is sought [s]."""
_DEGREES = (1, 2, 3)
"""Of the polynomials that the motion is taken for there."""
_LENGTHS = 16
"""Numbers of samples that are tried of each."""
_FREEDOM = 2
"""Samples that a window has beyond a polynomial's coefficients, at least."""
_FITS = 2.0
"""Standard deviations of χ² by which a polynomial may miss the samples."""
_STANDS_OUT = 4.0
"""Standard deviations at which a speed is one."""
_CLEAR = 5.0
"""Times the noise that a joint has moved where its motion shows."""
_AT_ONCE = 0.8
"""Part of the speed with which it must have done so: a motion that sets in has less."""
_LEAST_NOISE = 5e-6
"""Of any encoder: a clean simulation has none, and no polynomial fits it [rad]."""


def start_speed(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """The speed of each joint at the first sample, and whether anything is known of it.

    Polynomials of several degrees are fitted to more and more of the first samples. Where one misses them by no more
    than their noise, the polynomial of one degree more gives the slope: what the first one misses is small, not
    nothing. The slope counts that noise moves least:

        v = c₁ of Σ c_i tⁱ,   σ_v² = σ² [(AᵀA)⁻¹]₁₁,   A_ki = t_kⁱ

    Its standard deviation is σ_v and c₂ Δt together, Δt the time between samples: where a held command arrives, the
    acceleration 2 c₂ begins within them. A speed below 4 of them counts as zero: what begins at rest keeps exactly 0.

    Returns:
        Speeds, (n,) [rad/s], and whether a polynomial fits, (n,) bool; as recorded where the recording holds speeds.
    """
    time = recording.time - recording.time[0]
    count = int(np.searchsorted(time, _LONGEST))
    recorded = np.full(recording.num_joints, np.nan) if recording.dof_vel is None else recording.dof_vel[0]
    speed, known = np.nan_to_num(recorded), ~np.isnan(recorded)
    for joint in np.flatnonzero(~known).tolist():
        position = recording.dof_pos[:, joint]
        noise = max(noise_floor(position, float(np.median(np.diff(time)))).sigma, _LEAST_NOISE)
        found = _slope(time[:count], position[:count], noise)
        if found is not None:
            slope, std = found
            moves = abs(slope) > _STANDS_OUT * std and _at_once(time, position, slope, noise)
            speed[joint], known[joint] = slope if moves else 0.0, True
    return speed, known


def _at_once(time: np.ndarray, position: np.ndarray, slope: float, noise: float) -> bool:
    """Whether the first samples that could stand out of the noise move with a speed: at rest, they have not yet."""
    first = min(int(np.searchsorted(time, _CLEAR * noise / abs(slope))), len(time) - 1)
    first = max(first, 1)
    return float(position[first] - position[0]) / float(time[first]) / slope > _AT_ONCE


def _slope(time: np.ndarray, position: np.ndarray, noise: float) -> tuple[float, float] | None:
    """The surest slope at the beginning and its standard deviation; ``None`` where no polynomial fits."""
    best: tuple[float, float, float] | None = None
    for degree in _DEGREES:
        least = degree + 2 + _FREEDOM
        for count in np.unique(np.geomspace(least, max(least, len(time)), _LENGTHS).astype(int)).tolist():
            if count > len(time):
                continue
            scaled, moved = time[:count] / time[count - 1], position[:count] - position[0]
            powers = np.vander(scaled, degree + 2, increasing=True)
            fewer = powers[:, :-1]
            missed = np.square(fewer @ np.linalg.lstsq(fewer, moved, rcond=None)[0] - moved).sum() / noise**2
            freedom = count - degree - 1
            if missed > freedom + _FITS * np.sqrt(2 * freedom):
                continue
            _, slope, bend, *_ = np.linalg.lstsq(powers, moved, rcond=None)[0] / time[count - 1]
            noisy = noise * np.sqrt(np.linalg.inv(powers.T @ powers)[1, 1]) / time[count - 1]
            if best is None or noisy < best[0]:
                best = float(noisy), float(slope), float(np.hypot(noisy, bend * scaled[1]))
    return None if best is None else best[1:]
