"""How values and names are written."""

from __future__ import annotations

import math

_MOST_DECIMALS = 6


def in_words(name: str) -> str:
    """A parameter's name as a heading: ``viscous_friction`` becomes "Viscous friction"."""
    text = name.replace("_", " ").replace(".", ": ")
    return text[:1].upper() + text[1:]


def pretty_unit(unit: str) -> str:
    """``kg m^2`` becomes "kg m²"."""
    return unit.replace("^2", "²").replace("^3", "³")


def value_and_error(value: float, std: float | None) -> tuple[str, str]:
    """A value to the digits that its standard deviation leaves, and the standard deviation to two of its own."""
    if std is None or std <= 0:
        return f"{value:.4g}", "–"
    decimals = 1 - math.floor(math.log10(std))
    if decimals > _MOST_DECIMALS:
        return f"{value:.{_MOST_DECIMALS}g}", f"{std:.1e}"
    decimals = max(0, decimals)
    return f"{value:.{decimals}f}", f"{std:.{decimals}f}"


def count_in_short(count: float) -> str:
    """A count with a suffix: "3.49 M"."""
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if count >= size:
            return f"{count / size:.3g} {suffix}"
    return f"{count:.0f}"


def duration(seconds: float) -> str:
    """A time in words: "2 h 15 min", "3 min 20 s", "8.8 s"."""
    if seconds < 60:
        return f"{seconds:.3g} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
