"""How numbers are written where people read them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pace_actuators.joint_units import JointType, units_for

_UNITS = ((1e-4, 1e3, "mrad"), (1e-7, 1e6, "µrad"), (0.0, 1e9, "nrad"))


def three_figures(value: float) -> str:
    """A number of a table, as 0.120, 12.0 or 120."""
    return f"{value:#.3g}".rstrip(".")


def position_unit(values: Iterable[float | None], joint_types: Iterable[JointType]) -> tuple[float, str]:
    """A factor and a unit in which the largest of some positions reads well; mrad or mm unless all are tiny.

    Args:
        values: Positions or errors of them [rad], of slides [m].
        joint_types: Of the joints that they belong to.
    """
    largest = max((abs(value) for value in values if value is not None and np.isfinite(value)), default=1.0)
    factor, unit = next((factor, unit) for least, factor, unit in _UNITS if largest >= least)
    return factor, units_for(unit, joint_types)


def position_text(value: float | None, joint_types: Iterable[JointType]) -> str:
    """A position [rad, of slides m] in words: "6.8 mrad", of joints of both types "6.8 mrad or mm"."""
    if value is None:
        return "–"
    factor, unit = position_unit([value], joint_types)
    return f"{factor * value:.3g} {unit}"


def short_duration(seconds: float | None) -> str:
    """A time of milliseconds to seconds in words: "20 ms", "1.17 s"."""
    seconds = seconds or 0.0
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
