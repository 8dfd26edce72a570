"""Places in words: "below 0.3 rad/s, within 50 ms after a reversal"."""

from __future__ import annotations

from collections.abc import Sequence

from pace_actuators.text import percent, short_duration

from .dimensions import SWING, Dimension
from .regions import Region

STANDING = "where the joint stands still"
_OF = {
    "velocity": "at velocities ",
    "acceleration": "at accelerations ",
    "acceleration_size": "at accelerations of either sign ",
    "position": "at positions ",
    "load": "under load torques ",
    "load_size": "under load torques of either sign ",
}


def place_text(dimension: Dimension, region: Region, recordings: Sequence[str] = ()) -> str:
    """Where a region is.

    Args:
        dimension: What it is a region of.
        recordings: Names, for the dimension ``recording``.
    """
    low = dimension.edges[region.first] if region.first > 0 else None
    high = dimension.edges[region.last + 1] if region.last + 1 < dimension.num_bins else None
    if dimension.name == "speed" and region.first == region.last == 0:
        return STANDING
    if dimension.name == "recording":
        return f"in the recording {recordings[region.first]}"
    if dimension.name == "direction":
        return "on the way up (q grows)" if region.first else "on the way down (q falls)"
    if dimension.name == "drive":
        return "while the drive is on" if region.first else "while the drive is off"
    if dimension.name == SWING:
        return _of_swing(low, high)
    if dimension.name == "since_reversal":
        return _after_reversal(low, high)
    if dimension.name == "time":
        return f"in the first {high:g} s" if low is None else _between(low, high, "s", "after", "before")
    of = _OF.get(dimension.name, "")
    if dimension.unit == "N":
        of = of.replace("torques", "forces")
    return of + _between(low, high, dimension.unit)


def band_text(low: float, high: float, nyquist: float) -> str:
    """Where frequencies from ``low`` to ``high`` [Hz] are."""
    return _between(
        float(f"{low:.2g}") if low > 0 else None, float(f"{high:.2g}") if high < 0.999 * nyquist else None, "Hz"
    )


def _between(low: float | None, high: float | None, unit: str, above: str = "above", below: str = "below") -> str:
    if low is None:
        return f"{below} {_number(high)} {unit}"
    if high is None:
        return f"{above} {_number(low)} {unit}"
    return f"between {_number(low)} and {_number(high)} {unit}"


def _of_swing(low: float | None, high: float | None) -> str:
    if low is None or high is None:
        return f"in the {'first' if low is None else 'last'} {percent(high or 1 - (low or 0.0))} of each swing"
    return f"between {percent(low)} and {percent(high)} of each swing"


def _after_reversal(low: float | None, high: float | None) -> str:
    if low is None:
        return f"within {short_duration(high)} after a reversal"
    if high is None:
        return f"more than {short_duration(low)} after the last reversal"
    return f"between {short_duration(low)} and {short_duration(high)} after a reversal"


def _number(value: float | None) -> str:
    return f"{value:g}".replace("-", "−")
