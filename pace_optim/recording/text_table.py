"""Tables as text: CSV of this project and of others, with their delimiters, comments and names."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pace_actuators.memory import check_memory

Rows = list[list[str]] | np.ndarray
"""Cells as text, or all of them as numbers."""
_DELIMITERS = ",;\t"
_COMMENT = re.compile(r"""\s*["']?\s*(#|%|//)""")
_WHOLE = re.compile(r"-?\d{13,19}")
"""Stamps that floats would round."""
_WORDS = {"": "nan", "true": "1", "false": "0", "none": "nan", "null": "nan", "na": "nan"}
_LONGEST_LINE = 1 << 22
_MOST_COMMENTS = 200
_BYTES_PER_BYTE = 12
"""Memory of a file's cells as text, for each of its bytes."""


@dataclass(frozen=True, kw_only=True)
class Head:
    """How a table begins."""

    names: tuple[str, ...]
    """Of its columns; () of a file that holds none."""
    delimiter: str
    """Between its cells; "" is white space."""
    first_row: int
    """Line of the first samples, from 0."""
    notes: tuple[str, ...]
    """What is unusual."""


def head_of(path: Path) -> Head:
    """Where a table's names stand: in its first line, after comments, in the last comment, or nowhere.

    Raises:
        UnicodeDecodeError, OSError, csv.Error: If it cannot be read as text.
    """
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = [
            line for _, line in zip(range(_MOST_COMMENTS), iter(lambda: file.readline(_LONGEST_LINE), ""), strict=False)
        ]
    above = list(itertools.takewhile(lambda line: not line.strip() or _COMMENT.match(line), lines))
    comments = [_COMMENT.sub("", line).strip().rstrip("\"'") for line in above if line.strip()]
    line = lines[len(above)] if len(above) < len(lines) else ""
    delimiter = max(_DELIMITERS, key=line.count)
    delimiter = delimiter if delimiter in line else ""
    cells = next(_split([line], delimiter), [])
    if not are_numbers(cells, delimiter):
        notes = (f"{len(comments)} line(s) of comment stand before the names.",) if comments else ()
        return Head(names=tuple(cells), delimiter=delimiter, first_row=len(above) + 1, notes=notes)
    named = next(_split(comments[-1:], delimiter), [])
    if len(named) == len(cells) and not are_numbers(named, delimiter):
        return Head(names=tuple(named), delimiter=delimiter, first_row=len(above), notes=())
    names = tuple(f"column {i}" for i in range(1, len(cells) + 1))
    note = f"The file has no line of names: its columns are called '{names[0]}' to '{names[-1]}', in their order."
    return Head(names=names, delimiter=delimiter, first_row=len(above), notes=(note,))


def are_numbers(cells: Sequence[str], delimiter: str = ",") -> bool:
    """Whether cells hold numbers alone."""
    try:
        return bool([float(cell.replace(",", ".") if delimiter == ";" else cell) for cell in cells if cell])
    except ValueError:
        return False


def read_rows(path: Path, *, may_end_early: bool = False) -> tuple[Head, Rows]:
    """How a table begins, and its rows, each with a cell for each name.

    Args:
        may_end_early: Whether an incomplete last row is left out, such as of a logger that was stopped.
    """
    try:
        head = head_of(path)
        numbers = _all_numbers(path, head)
        if numbers is not None:
            return head, numbers
        check_memory(_BYTES_PER_BYTE * path.stat().st_size, f"{path}: reading it", "Cut it.")
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in _split(itertools.islice(file, head.first_row, None), head.delimiter) if any(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: cannot be read as text ({error}). Save it as comma-separated UTF-8.") from error
    if may_end_early and rows and len(rows[-1]) != len(head.names):
        rows.pop()
    for line, row in enumerate(rows, start=head.first_row + 1):
        if len(row) != len(head.names):
            raise ValueError(
                f"{path}: row {line} has {len(row)} cells but the header has {len(head.names)}. Complete or delete the "
                "row (the last one is often cut short)."
            )
    return head, rows


def column_of(rows: Rows, index: int, comma: bool = False) -> np.ndarray:
    """A column as numbers (NaN where empty), whole numbers exactly, or as text.

    Args:
        comma: Whether its decimals stand after a comma.
    """
    if isinstance(rows, np.ndarray):
        return np.ascontiguousarray(rows[:, index])
    cells = [row[index].replace(",", ".") if comma else row[index] for row in rows]
    if all(_WHOLE.fullmatch(cell) for cell in cells[:50]):
        with suppress(ValueError, OverflowError):
            return np.array([int(cell) for cell in cells])
    with suppress(ValueError):
        return np.array([float(_WORDS.get(cell.lower(), cell)) for cell in cells])
    return np.array(cells)


def _split(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    if delimiter:
        return ([cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter))
    return (line.split() for line in lines)


def _all_numbers(path: Path, head: Head) -> np.ndarray | None:
    """All cells, (rows, columns), where every cell is a number; else ``None``.

    It is read many times faster so than cell by cell, and takes as much memory as its numbers.
    """
    check_memory(2 * path.stat().st_size, f"{path}: reading it", "Cut it into parts.")
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = itertools.islice(file, head.first_row, None)
        first = next(lines, "")
        if not first.strip() or any(_WHOLE.fullmatch(cell) for cell in next(_split([first], head.delimiter))):
            return None
        try:
            table = np.loadtxt(
                itertools.chain([first], lines), delimiter=head.delimiter or None, comments=None, ndmin=2
            )
        except ValueError:  # text, an empty cell, or rows of other lengths
            return None
    return table if table.shape[1] == len(head.names) else None
