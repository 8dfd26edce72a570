"""What plots and report say of a trajectory: which part was held out, and how large the error is."""

from __future__ import annotations

import numpy as np


def held_out_spans(time: np.ndarray, train: np.ndarray) -> list[tuple[float, float]]:
    """From when to when samples are kept for validation [s].

    Args:
        time: (K,) [s].
        train: (K,) bool.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[True], train.astype(bool), [True]]).astype(np.int8)))
    return [(float(time[a]), float(time[min(b, len(time) - 1)])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def rms(error: np.ndarray) -> float | None:
    """Root mean square; ``None`` of nothing."""
    return float(np.sqrt(np.mean(np.square(error)))) if error.size else None
