"""Tables of text: what parts their cells, where their names stand, and their columns."""

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
from pace_actuators.text import listed

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
_DELIMITERS = ",;\t"
_COMMENT = re.compile(r"""\s*["']?\s*(#|%|//)""")
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
    cells = next(_rows([line], delimiter), [])
    if not _are_numbers(cells, delimiter):
        notes = (f"{len(comments)} line(s) of comment stand before the names.",) if comments else ()
        return Head(names=tuple(cells), delimiter=delimiter, first_row=len(above) + 1, notes=notes)
    named = next(_rows(comments[-1:], delimiter), [])
    if len(named) == len(cells) and not _are_numbers(named, delimiter):
        return Head(names=tuple(named), delimiter=delimiter, first_row=len(above), notes=())
    names = tuple(f"column {i}" for i in range(1, len(cells) + 1))
    note = f"The file has no line of names: its columns are called '{names[0]}' to '{names[-1]}', in their order."
    return Head(names=names, delimiter=delimiter, first_row=len(above), notes=(note,))


def read_table(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The columns of a table by name, as numbers (NaN where empty) or text, and notes.

    Columns whose names come twice are left out: nothing says which is which.
    """
    check_memory(_BYTES_PER_BYTE * path.stat().st_size, f"{path}: reading it", "Cut it.")
    try:
        head = head_of(path)
        with path.open(encoding="utf-8-sig", newline="") as file:
            body = [row for row in _rows(itertools.islice(file, head.first_row, None), head.delimiter) if any(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: cannot be read as text ({error}). Save it as comma-separated UTF-8.") from error
    header, notes = head.names, head.notes
    if not body:
        raise ValueError(f"{path}: holds no samples; expected a line of column names, then one line per sample.")
    if not all(header):
        raise ValueError(
            f"{path}: column {header.index('') + 1} has no name in the header ({listed(h or '?' for h in header)}). "
            "Name every column."
        )
    if len(header) > len(body):
        notes = (*notes, f"It has {len(header)} columns and {len(body)} rows: transpose it if its rows are series.")
    if repeated := sorted({name for name in header if header.count(name) > 1}):
        notes = (*notes, f"Not used, because their names come more than once: {listed(repeated)}. Rename them.")
    if len(body[-1]) != len(header):
        body = body[:-1]  # cut short where the logger was stopped
    for line, row in enumerate(body, start=head.first_row + 1):
        if len(row) != len(header):
            raise ValueError(f"{path}: row {line} has {len(row)} cells but the header has {len(header)}. Complete it.")
    comma = head.delimiter == ";" and not any("." in cell for row in body[:20] for cell in row)
    columns = {n: _cells([row[i] for row in body], comma) for i, n in enumerate(header) if n not in repeated}
    return columns, notes


def _rows(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    if delimiter:
        return ([cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter))
    return (line.split() for line in lines)


def _are_numbers(cells: Sequence[str], delimiter: str) -> bool:
    """Whether a line has numbers alone."""
    try:
        return bool([float(cell.replace(",", ".") if delimiter == ";" else cell) for cell in cells if cell])
    except ValueError:
        return False


def _cells(cells: Sequence[str], comma: bool) -> np.ndarray:
    """A column's cells as numbers (NaN where empty), whole numbers exactly, or as text."""
    if comma:
        cells = [cell.replace(",", ".") for cell in cells]
    if all(re.fullmatch(r"-?\d{13,19}", cell) for cell in cells[:50]):
        with suppress(ValueError, OverflowError):
            return np.array([int(cell) for cell in cells])
    words = {"": "nan", "true": "1", "false": "0", "none": "nan", "null": "nan", "na": "nan"}
    with suppress(ValueError):
        return np.array([float(words.get(cell.lower(), cell)) for cell in cells])
    return np.array(cells)
