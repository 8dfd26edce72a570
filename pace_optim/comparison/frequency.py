"""The error against frequency, and the response to the command of measurement and model."""

from __future__ import annotations

from typing import Any

import numpy as np

_BANDS_PER_OCTAVE = 3
_FEWEST_LINES = 5
_COHERENT = 0.8
_LEAST_POWER = 1e-4
"""Of the strongest band of the command."""


def band_edges(duration: float, dt: float) -> np.ndarray:
    """Edges of thirds of octaves from the slowest to the fastest frequency that recordings hold, (B + 1,) [Hz]."""
    low, high = 1 / duration, 0.5 / dt
    count = max(1, int(np.ceil(_BANDS_PER_OCTAVE * np.log2(high / low))))
    edges = high * 2.0 ** (np.arange(-count, 1) / _BANDS_PER_OCTAVE)
    edges[0] = 0.0
    return edges


def band_power(values: np.ndarray, dt: float, edges: np.ndarray) -> np.ndarray:
    """Σ values² by band, (B,): it sums to that of all samples (Parseval), the mean being in the lowest.

    Args:
        values: (K,).
        dt: Sample time [s].
        edges: (B + 1,) [Hz].
    """
    spectrum = np.fft.rfft(values)
    power = np.abs(spectrum) ** 2 / len(values)
    power[1 : (len(values) + 1) // 2] *= 2  # a line stands for its mirror image, too
    which = np.searchsorted(edges[1:-1], np.fft.rfftfreq(len(values), dt), side="right")
    return np.bincount(which, weights=power, minlength=len(edges) - 1)


def response(command: np.ndarray, measured: np.ndarray, simulated: np.ndarray, dt: float) -> dict[str, Any] | None:
    """From command to position, of the measurement and of the model.

        H₁(f) = S_dq / S_dd,  coherence γ² = |S_dq|² / (S_dd S_qq)

    with spectra averaged over a sixth of an octave, at least five lines. Only where the command has power; phases are
    unwrapped along the frequency.

    Args:
        command: (K,) [rad].
        measured: (K,) [rad].
        simulated: (K,) [rad].
        dt: Sample time [s].
    """
    spectrum = _periodic_spectrum(command)
    if len(spectrum) < 2 * _FEWEST_LINES or not np.abs(spectrum).max() > 0:
        return None
    power = np.abs(spectrum) ** 2
    starts = _band_starts(len(spectrum))
    mean_power = np.add.reduceat(power, starts) / np.diff([*starts, len(spectrum)])
    keep = mean_power > _LEAST_POWER * mean_power.max()
    frequency = np.add.reduceat(np.arange(1, len(spectrum) + 1) * power, starts) / np.add.reduceat(power, starts)
    result: dict[str, Any] = {"frequency": (frequency / (len(command) * dt))[keep]}
    for name, position in (("measured", measured), ("model", simulated)):
        other = _periodic_spectrum(position)
        cross = np.add.reduceat(np.conj(spectrum) * other, starts)[keep]
        own, its = (np.add.reduceat(p, starts)[keep] for p in (power, np.abs(other) ** 2))
        gain = cross / own
        result[name] = {
            "magnitude_db": 20 * np.log10(np.maximum(np.abs(gain), 1e-12)),
            "phase_deg": np.degrees(np.unwrap(np.angle(gain))),
            "coherence": np.abs(cross) ** 2 / np.maximum(own * its, 1e-300),
        }
    if not len(result["frequency"]):
        return None
    difference = result["model"]["phase_deg"] - result["measured"]["phase_deg"]
    result["model"]["phase_deg"] = result["model"]["phase_deg"] - 360 * np.round(difference.mean() / 360)
    return result | {"largest": _largest_differences(result)}


def _largest_differences(response: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Where the model is the furthest from the measurement, among the frequencies at which both are coherent."""
    measured, model = response["measured"], response["model"]
    sure = np.flatnonzero(np.minimum(measured["coherence"], model["coherence"]) > _COHERENT)
    result = {}
    for name in ("magnitude_db", "phase_deg"):
        if len(sure):
            difference = (model[name] - measured[name])[sure]
            at = int(np.argmax(np.abs(difference)))
            result[name] = {"difference": difference[at], "frequency": response["frequency"][sure[at]]}
    return result


def narrowest_band(share: np.ndarray, least: float = 0.6) -> tuple[int, int] | None:
    """The fewest neighbouring bands, first and last, that hold at least a share; ``None`` if all hold nothing."""
    total = np.concatenate([[0.0], np.cumsum(share)])
    for width in range(1, len(share) + 1):
        held = total[width:] - total[:-width]
        if held.max() >= least:
            first = int(held.argmax())
            return first, first + width - 1
    return None


def _periodic_spectrum(values: np.ndarray) -> np.ndarray:
    """Lines 1, 2, … of what remains without the straight line from the first to the last value: no jump leaks."""
    line = np.linspace(values[0], values[-1], len(values))
    rest = values - line
    return np.fft.rfft(rest - rest.mean())[1:]


def _band_starts(lines: int) -> list[int]:
    """Where bands begin among the lines: a sixth of an octave each, at least five lines."""
    starts, start = [], 0
    while lines - start >= _FEWEST_LINES:
        starts.append(start)
        start = max(start + _FEWEST_LINES, int(np.ceil((start + 1) * 2 ** (1 / 6))) - 1)
    return starts
