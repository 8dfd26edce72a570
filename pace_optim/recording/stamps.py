"""Time stamps of any kind as seconds: Unix time in s, ms, µs or ns, dates as text, or seconds since some zero."""

from __future__ import annotations

import re

import numpy as np

_UNITS = {"s": 1.0, "ms": 1e3, "µs": 1e6, "ns": 1e9}
_YEARS = (9e8, 4.2e9)  # Unix time of mid-1998 and of 2103 [s]
_STEPS = (1e-6, 100.0)  # of stamps that follow each other [s]
_ZONE = re.compile(r"(?:Z|[+-]\d{2}:?\d{2})$", re.IGNORECASE)


def seconds_of(values: np.ndarray) -> tuple[np.ndarray, float, str]:
    """Return stamps as seconds, the clock's reading at zero, and what they were taken for.

    Args:
        values: Stamps, (T,): numbers, text (ISO 8601) or datetime64.

    Returns:
        Stamps, (T,) [s], from 0 where they are Unix time and as given elsewhere; Unix time at zero [s], or 0; the unit
        that was recognised, or "" where they were taken as they are.

    Raises:
        ValueError: If text is no date.
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
    """The unit in which stamps are Unix time, or None where they are none."""
    if values.ndim != 1 or len(values) < 2 or values.dtype.kind not in "iuf":
        return None
    at = float(np.median(values))
    step = float(np.median(np.diff(values.astype(np.float64))))
    for unit, per_second in _UNITS.items():
        if all(low <= x / per_second <= high for x, (low, high) in ((at, _YEARS), (step, _STEPS))):
            return unit
    return None


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
