"""What every kind of log is read into: channels of numbers over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class Channel:
    """One number over time: a column, or one joint of a topic."""

    key: str
    """Its name in a column map, of its own in the log."""
    table: str
    """The topic or file that it stands in."""
    time: np.ndarray
    """Instants, (T,) [s], strictly increasing; channels of one table share the array where they can."""
    values: np.ndarray
    """(T,), as logged."""
    series: str = ""
    """What the format says that it is (`dof_pos`, ...); "" where only its name can tell."""
    joint: str = ""
    """The joint as the format calls it; "" where only the channel's name can tell."""

    @property
    def rate(self) -> float:
        """Values per second [Hz]."""
        return (len(self.time) - 1) / float(self.time[-1] - self.time[0]) if len(self.time) > 1 else 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """One log, or one episode of one."""

    name: str
    channels: Mapping[str, Channel]
    """By key."""
    time_origin: float = 0.0
    """Unix time where the channels' time is zero [s]; 0 where the log does not say."""
    lists: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Tables whose columns have numbers for names, not joints: {table: keys}."""
    notes: tuple[str, ...] = ()
    """What happened while reading."""


def cleaned(
    table: str, time: np.ndarray, columns: Mapping[str, np.ndarray], **what: Mapping[str, str]
) -> tuple[list[Channel], list[str]]:
    """Channels of a table: rows in the order of time, each instant once, each channel without its empty cells.

    Args:
        table: The topic or file.
        time: Instants, (T,) [s].
        columns: Values by key, (T,) each; NaN where a cell is empty.
        what: `series` and `joint` by key, where they are known.
    """
    notes, where = [], f"{table}: " if table else ""
    order = np.flatnonzero(np.isfinite(time))
    if np.any(np.diff(time[order]) < 0.0):
        order = order[np.argsort(time[order], kind="stable")]
        notes.append(f"{where}rows out of order were sorted by time.")
    fresh = np.ones(len(order), dtype=bool)
    fresh[:-1] = np.diff(time[order]) > 0.0  # of one instant, the last
    if repeated := int(np.sum(~fresh)):
        order = order[fresh]
        notes.append(f"{where}{repeated} rows of an instant that comes again were left out.")
    unchanged = len(order) == len(time) and np.array_equal(order, np.arange(len(time)))
    shared = time if unchanged else time[order]
    clocks: dict[bytes, np.ndarray] = {}
    channels, empty = [], 0
    for key, column in columns.items():
        values = np.asarray(column, dtype=np.float64)
        values = values if unchanged else values[order]
        filled = np.isfinite(values)
        own = shared
        if not filled.all():
            empty += int(np.sum(~filled))
            own = clocks.setdefault(filled.tobytes(), shared[filled])
            values = values[filled]
        if len(values):
            said = {name: by_key.get(key, "") for name, by_key in what.items()}
            channels.append(Channel(key=key, table=table, time=own, values=values, **said))
    if empty:
        notes.append(f"{where}{empty} empty cells were left out, each in its column alone.")
    return channels, notes
