"""Notes of several recordings, each kind once."""

from __future__ import annotations

import re
from collections.abc import Sequence

from pace_actuators.text import listed

from .data import Recording

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def notes_by_kind(recordings: Sequence[Recording]) -> list[str]:
    """Notes with the recordings that have them; those that differ in numbers alone come once, of the first.

    Args:
        recordings: In the order of the notes.
    """
    kinds: dict[str, list[tuple[str, str]]] = {}
    for recording in recordings:
        for note in recording.notes:
            kinds.setdefault(_NUMBER.sub("#", note), []).append((recording.name, note))
    result = []
    for told in kinds.values():
        (first, note), names = told[0], dict.fromkeys(name for name, _ in told)
        if len({text for _, text in told}) == 1:
            result.append(f"{listed(names, 6)}: {note}")
        else:
            others = [name for name in names if name != first]
            more = f" ({listed(others, 5)}: the same with other numbers.)" if others else ""
            result.append(f"{first}: {note}{more}")
    return result
