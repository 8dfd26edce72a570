"""How much of an error no model can explain: the measurement's noise floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from scipy import signal

from pace_optim.recording.data import Recording

_DIFFERENCES = 4
_SEGMENT = 128
_FEWEST_SAMPLES = 64
_QUIET = 0.25
_LARGEST_CORRELATION = 0.6
_STEEPEST = 2.1
"""First-order noise falls by less than 2 over the upper half of the frequencies; what falls more is motion's tail."""
_ABOVE = 1.5
"""A spectrum this many times the noise's is motion."""
_MOST_STEPS = 50
_NUMERICAL = 1e-9
_VARIANCES: WeakKeyDictionary[Recording, float] = WeakKeyDictionary()
LEAST_NOISE = 1e-7
"""Noise of positions that is assumed where recordings have less [rad]."""


@dataclass(frozen=True, kw_only=True)
class NoiseFloor:
    """The standard deviation of one joint's measured position in one recording."""

    sigma: float
    """[rad]."""
    source: str
    """``"recording"``, ``"lattice"`` or ``"repetitions"``: what it was estimated from."""
    lattice: float | None = None
    """The encoder's step, if the positions lie on a lattice [rad]."""


def noise_floor(position: np.ndarray, dt: float) -> NoiseFloor:
    """The noise of a recording from itself: its spectrum above the motion, and never below what its lattice leaves.

    A lattice of step δ rounds with an error of standard deviation δ/√12.

    Args:
        position: Measured, (K,) [rad].
        dt: Sample time [s].
    """
    step = lattice_step(position)
    sigma = _spectral_sigma(position, dt)
    least = 0.0 if step is None else step / np.sqrt(12.0)
    return NoiseFloor(sigma=max(sigma, least), source="lattice" if least > sigma else "recording", lattice=step)


def noise_variance(recordings: Sequence[Recording]) -> float:
    """Mean variance of the noise of recordings' positions, over recordings and joints [rad²]."""
    return float(np.mean([_variance(recording) for recording in recordings]))


def _variance(recording: Recording) -> float:
    """Of one, which is looked at once."""
    if recording not in _VARIANCES:
        dt = float(np.median(np.diff(recording.time)))
        _VARIANCES[recording] = float(np.mean([noise_floor(each, dt).sigma ** 2 for each in recording.dof_pos.T]))
    return _VARIANCES[recording]


def with_repetitions(floors: Sequence[NoiseFloor], positions: Sequence[np.ndarray]) -> list[NoiseFloor]:
    """The noise of recordings that repeat each other: what differs between them.

        σ² = mean over time of Σ_k (q_k − mean q)² / (K − 1)

    Of the squared error of the mean of K repetitions, σ²/K cannot be explained; of each one's own, σ².

    Args:
        positions: Each repetition's, (K,) [rad]; the longer ones are cut.

    Returns:
        The floors, the larger of both estimates being kept where the lattice forbids the lower one.
    """
    length = min(len(position) for position in positions)
    variance = np.var(np.stack([position[:length] for position in positions]), axis=0, ddof=1)
    sigma = float(np.sqrt(variance.mean()))
    result = []
    for floor in floors:
        least = 0.0 if floor.lattice is None else floor.lattice / np.sqrt(12.0)
        source = "lattice" if least > sigma else "repetitions"
        result.append(NoiseFloor(sigma=max(sigma, least), source=source, lattice=floor.lattice))
    return result


def lattice_step(position: np.ndarray) -> float | None:
    """The step δ of which all differences between positions are multiples; ``None`` without one.

    Args:
        position: (K,) [rad].
    """
    steps = np.diff(np.unique(position))
    steps = steps[steps > 1e-7]
    if len(steps) < 10:
        return None
    smallest = float(np.median(steps[steps < 1.2 * steps.min()]))
    near = steps[steps < _MOST_STEPS * smallest]
    count = np.round(near / smallest)
    if len(near) < max(10, 0.2 * len(steps)) or np.mean(np.abs(near / smallest - count) < 0.08) < 0.98:
        return None
    return float(near.sum() / count.sum())


def _spectral_sigma(position: np.ndarray, dt: float) -> float:
    """Standard deviation of first-order correlated noise that has the spectrum of the upper frequencies.

    Noise x_k = ρ x_{k-1} + s w_k has the spectrum S(ω) ∝ s² / (1 − 2ρ cos ω + ρ²) with ω = 2π f dt. ρ and s are fitted
    from the Nyquist frequency down to where motion begins; below, the spectrum is the lower of this one and the
    measured. Noise is in every segment and motion is not, so the measured spectrum is the lower quarter over segments
    of a third of a second, brought to the mean by the exponential distribution that noise has: − ln(1 − 1/4).
    """
    if len(position) < _FEWEST_SAMPLES:
        return _difference_sigma(position)
    # differences take the motion's power away before it can leak; dividing by their gain gives the spectrum back
    whitened = np.diff(position, _DIFFERENCES)
    segment = min(_SEGMENT, len(whitened) // 4 * 2)
    frequency, _, segments = signal.spectrogram(
        whitened, 1 / dt, window="hann", nperseg=segment, noverlap=segment // 2, detrend=False, mode="psd"
    )
    density = np.quantile(segments, _QUIET, axis=1) / -np.log(1 - _QUIET)
    omega = 2 * np.pi * frequency * dt
    keep = slice(1, -1)  # the ends are estimated from half as many numbers
    omega, width = omega[keep], float(frequency[1] - frequency[0])
    density = density[keep] / (2 * np.sin(omega / 2)) ** (2 * _DIFFERENCES)
    if density.max() * width < _NUMERICAL**2:
        return float(np.sqrt(density.sum() * width))
    start = len(omega) // 2
    quarter = start // 4
    if np.mean(density[start : start + quarter]) > _STEEPEST * np.mean(density[-quarter:]):
        return float(np.sqrt(np.minimum(np.mean(density[-quarter:]), density).sum() * width))
    noise = _FirstOrderSpectrum(omega[start:], density[start:])
    while start > 2 and np.median(density[start - 3 : start] / noise(omega[start - 3 : start])) < _ABOVE:
        start -= 1
    noise = _FirstOrderSpectrum(omega[start:], density[start:])
    return float(np.sqrt(np.minimum(noise(omega), density).sum() * width * len(frequency) / len(omega)))


class _FirstOrderSpectrum:
    """The spectrum of first-order noise, s² / (1 − 2ρ cos ω + ρ²), with the ρ that leaves a given one the flattest."""

    def __init__(self, omega: np.ndarray, density: np.ndarray):
        choices = np.linspace(-_LARGEST_CORRELATION, _LARGEST_CORRELATION, 181)
        flat = [density * self._inverse(omega, rho) for rho in choices]
        spread = [float(np.var(np.log(np.maximum(ratio, 1e-300)))) for ratio in flat]
        best = int(np.argmin(spread))
        self._rho, self._level = float(choices[best]), float(np.mean(flat[best]))

    def __call__(self, omega: np.ndarray) -> np.ndarray:
        return self._level / self._inverse(omega, self._rho)

    @staticmethod
    def _inverse(omega: np.ndarray, rho: float) -> np.ndarray:
        return 1 - 2 * rho * np.cos(omega) + rho**2


def _difference_sigma(position: np.ndarray) -> float:
    """Of white noise, from differences of order 4: their variance is C(8, 4) σ² = 70 σ²."""
    difference = np.diff(position, _DIFFERENCES)
    return float(1.4826 * np.median(np.abs(difference)) / np.sqrt(70.0)) if len(difference) else 0.0
