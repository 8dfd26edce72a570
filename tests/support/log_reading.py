"""Reads one log, as a command with a single file does."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pace_optim.recording import Recording
from pace_optim.recording.logs import ColumnMap, LogReader, Robot


class Understood(NamedTuple):
    """A recording of a log, and how the log was read."""

    recording: Recording
    columns: ColumnMap
    lines: list[str]


def understood(path: Path, robot: Robot, columns: ColumnMap | None = None) -> list[Understood]:
    """The recordings of a log, one or one per episode."""
    reader = LogReader([str(path)], columns)
    return [Understood(*found, reader.lines()) for found in reader.understood(str(path), robot)]


def load_recordings(
    path: Path | str,
    robot: Robot | None = None,
    columns: ColumnMap | None = None,
    tell: Callable[[str], None] | None = None,
) -> list[Recording]:
    """The recordings of a log, or of a file in this project's own form."""
    reader = LogReader([str(path)], columns)
    found = reader.recordings(str(path), robot or Robot())
    for line in reader.lines() if tell else ():
        tell(line)
    return found
