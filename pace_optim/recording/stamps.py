"""Time stamps of any kind as seconds: Unix time in s, ms, µs or ns, dates as text, or seconds since some zero."""

from __future__ import annotations

import re

import numpy as np

_UNITS = {"s": 1.0, "ms": 1e3, "µs": 1e6, "ns": 1e9}
_YEARS = (9e8, 4.2e9)  # Unix time of mid-1998 and of 2103 [s]
_STEPS = (1e-6, 100.0)  # of stamps that follow each other [s]
_LEAST_REPEATED = 0.2  # of the rows, where stamps are rounded to more than a step
_ROUNDED = 1.3  # times the resolution that stamps may be from even ones
_LASTING = 5  # rows that follow a clock that was set back, below what it had shown
_FEW = 0.02  # of the rows, where it goes back: more are rows in no order
_ZONE = re.compile(r"(?:Z|[+-]\d{2}:?\d{2})$", re.IGNORECASE)


def seconds_of(values: np.ndarray) -> tuple[np.ndarray, float, str]:
    """Return stamps as seconds, the clock's reading at zero, and what they were taken for.

    Args:
        values: Stamps, (T,): numbers, text (ISO 8601) or datetime64.

    Returns:
        Stamps, (T,) [s], from 0 where they are Unix time and as given elsewhere; Unix time at zero [s], or 0; the unit
        that was recognised, or "" where they were taken as they are.
    """
    if values.dtype.kind in "UST":
        values = _dates(values)
    if values.dtype.kind == "M":
        whole = values.astype("datetime64[ns]").astype(np.int64)
        return (whole - whole[:1]) * 1e-9, float(whole[0]) * 1e-9 if len(whole) else 0.0, "dates"
    unit = unix_unit(values)
    if unit is None:
        return values.astype(np.float64), 0.0, ""
    since = (values - values[:1]).astype(np.float64) / _UNITS[unit]
    return since, float(values[0]) / _UNITS[unit], f"Unix time in {unit}"


def unix_unit(values: np.ndarray) -> str | None:
    """The unit in which stamps are Unix time; None if they are not."""
    if values.ndim != 1 or len(values) < 2 or values.dtype.kind not in "iuf":
        return None
    at = float(np.median(values))
    step = float(np.median(np.diff(values.astype(np.float64))))
    for unit, per_second in _UNITS.items():
        if all(low <= x / per_second <= high for x, (low, high) in ((at, _YEARS), (step, _STEPS))):
            return unit
    return None


def unrounded(time: np.ndarray) -> tuple[np.ndarray, str]:
    """Stamps that were rounded to more than a step, evenly spaced again, and a note; others as they are.

    Rows of an even timer at t₀ + k Δ show the multiples of a resolution r > Δ, each several times. The line through
    them is the timer's, if no stamp is further than r from it.

    Args:
        time: Stamps in the order of the rows, (T,) [s].
    """
    step = np.diff(time)
    if len(time) < 3 or not np.isfinite(time).all() or np.any(step < 0) or np.mean(step == 0) < _LEAST_REPEATED:
        return time, ""
    distinct = step[step > 0]
    if not len(distinct):
        return time, ""
    resolution = float(np.median(distinct))
    row = np.arange(len(time))
    slope = float(np.polyfit(row, time - time[0], 1)[0])
    if slope <= 0 or np.ptp(time - time[0] - slope * row) > _ROUNDED * resolution:
        return time, ""
    note = (
        f"The time stamps are rounded to {1e3 * resolution:.3g} ms, and several rows share one: read as an even clock "
        f"of {1 / slope:.5g} Hz."
    )
    return time[0] + slope * row, note


def set_back(time: np.ndarray) -> np.ndarray:
    """Rows at which the clock was set back, (K,): those before and after show the same time twice.

    Single late rows, and rows in no order, do not count.

    Args:
        time: Stamps in the order of the rows, (T,) [s].
    """
    back = np.flatnonzero(np.diff(time) < 0) + 1
    if not len(back) or len(back) > max(3.0, _FEW * len(time)):
        return back[:0]
    shown = np.maximum.accumulate(time)
    return np.array([k for k in back if np.all(time[k : k + _LASTING] < shown[k - 1])], dtype=int)


def _dates(values: np.ndarray) -> np.ndarray:
    """Text as datetime64 in UTC; a zone that is written behind each is taken into account."""
    texts = [str(value).strip() for value in values.tolist()]
    zones = {match.group() if (match := _ZONE.search(text)) and "T" in text.upper().replace(" ", "T") else ""
             for text in texts[:1] + texts[-1:]}  # fmt: skip
    zone = zones.pop()
    if zones or not all(text.endswith(zone) for text in texts):
        raise ValueError("the stamps are of different time zones; write all of them in one")
    bare = np.array([text[: len(text) - len(zone)].replace(" ", "T") for text in texts])
    return bare.astype("datetime64[ns]") - np.timedelta64(_minutes(zone), "m")


def _minutes(zone: str) -> int:
    """Minutes that a zone is ahead of UTC."""
    if zone.upper() in ("", "Z"):
        return 0
    digits = zone[1:].replace(":", "")
    return (1 if zone[0] == "+" else -1) * (60 * int(digits[:2]) + int(digits[2:]))
