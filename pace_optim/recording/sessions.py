"""When each recording was made, since its session began: from time stamps, else from the order of the recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .data import Recording

_PAUSE = 6 * 3600.0
"""A pause after which drives are as cold as at the beginning: what comes later is another session [s]."""
_UNIX = 9e8
"""Clocks that show more than this show Unix time [s]."""
_OVERLAP = 0.1
"""Recordings of one clock do not overlap by more than this [s]."""


def session_starts(recordings: Sequence[Recording]) -> tuple[np.ndarray, tuple[str, ...]]:
    """When each recording began since the first of its session, (R,) [s], and a note on each (empty without stamps).

    Stamps place recordings where all show Unix time, or where none does and their spans do not overlap (one clock, and
    not one that starts anew with each file). A pause of more than six hours, such as between days, begins another
    session. Without such stamps the recordings are taken to have been made one after another, in their order.
    """
    began = np.array([recording.start_stamp for recording in recordings])
    if not _one_clock(began, np.array([recording.duration for recording in recordings])):
        return np.cumsum([0.0, *(recording.duration for recording in recordings[:-1])]), ("",) * len(recordings)
    order = np.argsort(began, kind="stable")
    since, session = np.zeros(len(began)), np.zeros(len(began), dtype=int)
    first = until = began[order[0]]
    number = 0
    for r in order:
        if began[r] - until > _PAUSE:
            first, number = began[r], number + 1
        since[r], session[r] = began[r] - first, number
        until = max(until, began[r] + recordings[r].duration)
    which = f"session {{}} of {number + 1}" if number else "its session"
    notes = tuple(
        f"Began {s:.6g} s after the first recording of {which.format(k + 1)}, by its time stamps."
        for s, k in zip(since, session, strict=True)
    )
    return since, notes if len(recordings) > 1 else ("",)


def _one_clock(began: np.ndarray, duration: np.ndarray) -> bool:
    """Whether stamps of all recordings are of one clock."""
    unix = began > _UNIX
    if unix.any():
        return bool(unix.all())
    order = np.argsort(began)
    return bool(np.all(began[order][1:] >= (began + duration)[order][:-1] - _OVERLAP))
