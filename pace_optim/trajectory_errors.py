"""What plots and report say of a trajectory: which part was held out, how large the error is, and in which unit."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

_UNITS = ((1e-4, 1e3, "mrad"), (1e-7, 1e6, "µrad"), (0.0, 1e9, "nrad"))


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


def three_figures(value: float) -> str:
    """A number of a table, as 0.120, 12.0 or 120."""
    return f"{value:#.3g}".rstrip(".")


def angle_unit(values: Iterable[float | None]) -> tuple[float, str]:
    """A factor and a unit in which the largest of some angles [rad] reads well; mrad unless all are tiny."""
    largest = max((abs(value) for value in values if value is not None and np.isfinite(value)), default=1.0)
    return next((factor, unit) for least, factor, unit in _UNITS if largest >= least)


def angle_text(value: float | None) -> str:
    """An angle [rad] in words: "6.8 mrad"."""
    if value is None:
        return "–"
    factor, unit = angle_unit([value])
    return f"{factor * value:.3g} {unit}"
