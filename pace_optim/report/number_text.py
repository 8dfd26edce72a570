"""How numbers are written where people read them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

_UNITS = ((1e-4, 1e3, "mrad"), (1e-7, 1e6, "µrad"), (0.0, 1e9, "nrad"))


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


def short_duration(seconds: float | None) -> str:
    """A time of milliseconds to seconds in words: "20 ms", "1.17 s"."""
    seconds = seconds or 0.0
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
