"""A low-pass without delay, for positions that are differentiated."""

from __future__ import annotations

import numpy as np

_ORDER = 3


def low_passed(position: np.ndarray, dt: float, cutoff: float) -> np.ndarray:
    """A Butterworth filter of order 3, once forwards and once backwards.

    It multiplies the spectrum by

        |H(f)|² = 1 / (1 + (tan(π f dt) / tan(π f_c dt))⁶)

    Each end is continued by its reflection in the end point, for 3 / f_c. The line through both ends of that is taken
    out before, and added after, so that the spectrum has no jump.

    Args:
        position: (K, …) [rad].
        dt: Sample time [s].
        cutoff: f_c [Hz]; at most 0.4 of the Nyquist frequency is used.
    """
    cutoff = min(cutoff, 0.2 / dt)
    more = min(len(position) - 1, round(3 / (cutoff * dt)))
    before = 2 * position[:1] - position[more:0:-1]
    after = 2 * position[-1:] - position[-2 : -2 - more : -1]
    longer = np.concatenate([before, position, after])
    share = np.linspace(0.0, 1.0, len(longer)).reshape(-1, *[1] * (position.ndim - 1))
    line = longer[:1] * (1 - share) + longer[-1:] * share
    frequency = np.fft.rfftfreq(len(longer), dt).reshape(-1, *[1] * (position.ndim - 1))
    gain = 1 / (1 + (np.tan(np.pi * frequency * dt) / np.tan(np.pi * cutoff * dt)) ** (2 * _ORDER))
    smooth = np.fft.irfft(np.fft.rfft(longer - line, axis=0) * gain, len(longer), axis=0) + line
    return smooth[more : more + len(position)]
