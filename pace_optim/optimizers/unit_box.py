"""Vectors of any size brought into [-1, 1], a whole generation at once."""

from __future__ import annotations

import numpy as np

_MARGIN = 0.05
"""Width of the curved part inside a bound, and of the part outside that is mapped onto it."""
_PERIOD = 2 * (2.0 + _MARGIN + _MARGIN)
_START = -1.0 - 2 * _MARGIN - 1.0


def into_unit_box(x: np.ndarray) -> np.ndarray:
    """Each value inside [-1, 1], any shape: pycma's transformation of bounds, the same to the last digit.

    The identity up to 0.95, a parabola on to 1.05, mirrored at ±1.05, periodic: smooth everywhere
    (``BoxConstraintsLinQuadTransformation``). pycma computes it candidate by candidate.
    """
    y = np.array(x, dtype=float)
    far = (y < _START) | (y > -_START)
    y[far] -= _PERIOD * ((y[far] - _START) // _PERIOD)
    above = y > 1.0 + _MARGIN
    y[above] -= 2 * (y[above] - 1.0 - _MARGIN)
    below = y < -1.0 - _MARGIN
    y[below] += 2 * (-1.0 - _MARGIN - y[below])
    low = y < -1.0 + _MARGIN
    y[low] = -1.0 + (y[low] - (-1.0 - _MARGIN)) ** 2 / 4 / _MARGIN
    high = y > 1.0 - _MARGIN
    y[high] = 1.0 - (y[high] - (1.0 + _MARGIN)) ** 2 / 4 / _MARGIN
    return y
