"""Loops over the position: what differs between the way up and the way down."""

from __future__ import annotations

from typing import Any

import numpy as np

from .motion import Motion

_BINS = 24
_FEWEST = 8


def hysteresis(motion: Motion, offset: np.ndarray, error: np.ndarray) -> dict[str, Any]:
    """Means by position, on the way up and on the way down.

    Of a proportional controller, the offset q* − q of target and position is its torque by the gain: friction opens
    its loop. Where the loops of measurement and model differ in width, friction differs; where they lean another way,
    gravity, a spring or a gain does.

    Args:
        motion: Of the joint; samples where it stands are left out.
        offset: Measured q* − q, (K,) [rad].
        error: Simulated less measured, (K,) [rad].
    """
    moving = np.abs(motion.speed) > motion.standstill
    if moving.sum() < 2 * _BINS:
        return {}
    low, high = np.quantile(motion.position[moving], (0.005, 0.995))
    if not high > low:
        return {}
    edges = np.linspace(low, high, _BINS + 1)
    bins = np.searchsorted(edges[1:-1], motion.position, side="right")
    within = moving & (motion.position >= low) & (motion.position <= high)
    result: dict[str, Any] = {"position": (edges[1:] + edges[:-1]) / 2}
    for name, values in (("measured", offset), ("model", offset - error), ("error", error)):
        ways = {
            way: _means(values, bins, within & (motion.direction == sign)) for way, sign in (("up", 1), ("down", -1))
        }
        half = (ways["up"] - ways["down"]) / 2
        width = float(np.sqrt(np.nanmean(half**2))) if np.isfinite(half).any() else None
        result[name] = {**ways, "half_width": width}
    return result


def _means(values: np.ndarray, bins: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Mean in each bin; NaN where there is too little."""
    count = np.bincount(bins[where], minlength=_BINS)
    total = np.bincount(bins[where], weights=values[where], minlength=_BINS)
    return np.where(count >= _FEWEST, total / np.maximum(count, 1), np.nan)
