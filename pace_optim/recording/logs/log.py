"""What every kind of log is read into: channels of numbers over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from pace_actuators.text import listed


@dataclass(frozen=True, kw_only=True, eq=False)
class Channel:
    """One number over time: a column, or one joint of a topic."""

    key: str
    """Its name in a column map, unique in the log."""
    table: str
    """The topic or file that it stands in."""
    time: np.ndarray
    """Instants, (T,) [s], strictly increasing; channels of one table share the array where they can."""
    values: np.ndarray
    """(T,), as logged."""
    series: str = ""
    """What it is by the format (`dof_pos`, ...); "" where only its name shows it."""
    joint: str = ""
    """The joint as the format calls it; "" where only the channel's name shows it."""

    @property
    def name(self) -> str:
        """Its key without the topic's or file's name."""
        return self.key.removeprefix(self.table + ":") if self.table else self.key

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
    notes: tuple[str, ...] = ()
    """What happened while reading."""

    def channel(self, key: str) -> Channel:
        """The channel that a column map names."""
        if key not in self.channels:
            raise ValueError(
                f"{self.name}: the column map names '{key}', which the log has not. It has: {listed(self.channels)}. "
                "Correct the map."
            )
        return self.channels[key]


def cleaned(
    table: str, time: np.ndarray, columns: Mapping[str, np.ndarray], **what: Mapping[str, str]
) -> tuple[list[Channel], list[str]]:
    """Channels of a table: each in the order of time, without its empty cells, each instant once.

    Rows of one instant whose cells complete each other are one row. Of two values of one instant the last counts.

    Args:
        time: Instants, (T,) [s].
        columns: Values by key, (T,) each; NaN where a cell is empty.
        what: `series` and `joint` by key, where they are known.
    """
    notes, where = [], f"{table}: " if table else ""
    order = np.flatnonzero(np.isfinite(time))
    if np.any(np.diff(time[order]) < 0.0):
        order = order[np.argsort(time[order], kind="stable")]
        notes.append(f"{where}rows out of order were sorted by time.")
    unchanged = len(order) == len(time) and np.array_equal(order, np.arange(len(time)))
    shared = time if unchanged else time[order]
    clocks: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    channels, empty, repeated = [], 0, 0
    for key, column in columns.items():
        values = np.asarray(column, dtype=np.float64)
        values = values if unchanged else values[order]
        filled = np.isfinite(values)
        if (mask := filled.tobytes()) not in clocks:
            rows = np.flatnonzero(filled)
            last = np.append(np.diff(shared[rows]) > 0.0, [True] * bool(len(rows)))
            rows = rows[last]
            clocks[mask] = rows, shared if len(rows) == len(shared) else shared[rows]
        rows, own = clocks[mask]
        empty += len(values) - int(filled.sum())
        repeated = max(repeated, int(filled.sum()) - len(rows))
        if len(rows):
            said = {name: by_key.get(key, "") for name, by_key in what.items()}
            kept = values if own is shared else values[rows]
            channels.append(Channel(key=key, table=table, time=own, values=kept, **said))
    if repeated:
        notes.append(f"{where}{repeated} rows were left out: their instants come again with other values.")
    if empty:
        notes.append(f"{where}{empty} empty cells were left out, each in its column alone.")
    return channels, notes


def reader(module: str, path: Path) -> Any:
    """Import a reader of logs."""
    try:
        return import_module(module)
    except ImportError:
        raise ValueError(
            f"{path}: reading it needs the package {module.partition('.')[0]}, which is not installed. Install it with "
            'pip install "pace-mujoco[logs]".'
        ) from None
