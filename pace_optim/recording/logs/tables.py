"""CSV with any names, parquet, and LeRobot datasets: columns over a column of time."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pace_actuators.files import parsed_json
from pace_actuators.memory import check_memory
from pace_actuators.text import listed
from pace_optim.recording.checks import MIN_SAMPLES
from pace_optim.recording.text_table import column_of, read_rows
from pace_optim.recording.time_base import seconds_of, set_back, unix_unit, unrounded
from pace_optim.terminal.arrays import read_arrays

from .column_map import ColumnMap
from .log import Log, cleaned, reader
from .words import TIME_UNITS, TIME_WORDS, is_time, meaning, time_unit

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
_FASTEST, _SLOWEST = 5e-5, 0.12
"""Steps that a log of joints may have [s]."""
_ONE_CLOCK = 0.01
"""Relative difference within which two columns of time are of one clock."""
_MOST_ROWS = 10**8
_BYTES_PER_VALUE = 64
"""Memory of a value of a parquet file while lists of it are read."""
_WHOLE = tuple(word for word, unit in TIME_WORDS.items() if unit == "s")
_FRACTIONS = {word: round(1e9 * TIME_UNITS[unit]) for word, unit in TIME_WORDS.items() if unit != "s"}
"""What a column of the part of a second beside one of whole seconds may be called, in nanoseconds."""


def read_table(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The columns of a table by name, as numbers (NaN where empty) or text, and notes.

    Columns whose names come twice are left out: nothing says which is which.
    """
    head, rows = read_rows(path, may_end_early=True)
    header, notes = head.names, head.notes
    if not len(rows):
        raise ValueError(f"{path}: holds no samples; expected a line of column names, then one line per sample.")
    if not all(header):
        raise ValueError(
            f"{path}: column {header.index('') + 1} has no name in the header ({listed(h or '?' for h in header)}). "
            "Name every column."
        )
    if len(header) > len(rows):
        notes = (*notes, f"It has {len(header)} columns and {len(rows)} rows: transpose it if its rows are series.")
    if repeated := sorted({name for name in header if header.count(name) > 1}):
        notes = (*notes, f"Not used, because their names come more than once: {listed(repeated)}. Rename them.")
    comma = head.delimiter == ";" and not any("." in str(cell) for row in rows[:20] for cell in row)
    return {n: column_of(rows, i, comma) for i, n in enumerate(header) if n not in repeated}, notes


def read_csv_log(path: Path, columns: ColumnMap | None) -> list[Log]:
    """Read a CSV of any names; cells may be empty where a column has no value at an instant.

    If the columns are called as joints are, and nothing more, the file's name says which series they are.
    """
    content, notes = read_table(path)
    names = [name for name in content if not is_time(name)]
    by_file = any(meaning(name, path.stem).quantity for name in names)
    table = path.stem if by_file and not any(meaning(name).quantity for name in names) else ""
    if table:
        content = {f"{table}:{name}" if name in names else name: values for name, values in content.items()}
    return _logs(path.stem, path, content, columns, table, notes)


def read_npz_log(path: Path, columns: ColumnMap | None) -> list[Log]:
    """Read arrays of any names: (T,) one column, (T, n) one for each name of an array of n texts, else numbered."""
    arrays = read_arrays(path, "Save arrays with numpy.savez, a row for each sample.")
    numbers = {key: values for key, values in arrays.items() if values.dtype.kind in "biuf" and values.ndim in (1, 2)}
    texts = [values.astype(str).tolist() for values in arrays.values() if values.dtype.kind == "U" and values.ndim == 1]
    rows, _ = max(Counter(map(len, numbers.values())).items(), key=lambda item: item[1], default=(0, 0))
    content: dict[str, np.ndarray] = {}
    for key, values in numbers.items():
        if len(values) == rows and values.ndim == 1:
            content[key] = values
        elif len(values) == rows:
            names = next((own for own in texts if len(own) == values.shape[1]), range(values.shape[1]))
            content |= {f"{key}/{name}": column for name, column in zip(names, values.T, strict=True)}
    left = [key for key, values in arrays.items() if values.dtype.kind != "U" and len(np.atleast_1d(values)) != rows]
    notes = [f"Not used, because they have other rows: {listed(left)}."] if left else []
    return _logs(path.stem, path, content, columns, notes=notes)


def read_parquet_log(path: Path, columns: ColumnMap | None) -> list[Log]:
    """Read a parquet file or a LeRobot dataset (a folder with meta/info.json), one log per episode."""
    parquet = reader("pyarrow.parquet", path)
    root = path if path.is_dir() else next((p for p in path.parents if (p / "meta" / "info.json").is_file()), None)
    info = _info(root) if root else {}
    files = sorted((path / "data").glob("**/*.parquet")) if path.is_dir() else [path]
    if not files:
        raise ValueError(
            f"{path}: holds no data/**/*.parquet. Give the folder of a LeRobot dataset, or a parquet file."
        )
    logs: list[Log] = []
    for file in files:
        try:
            _check_size(file, parquet.ParquetFile(file).metadata)
            table = parquet.read_table(file)
        except ValueError:
            raise
        except Exception as error:  # pyarrow raises many kinds
            text = " ".join(str(error).split())[:200]
            raise ValueError(
                f"{file}: cannot be read as parquet ({type(error).__name__}: {text}). Copy it again."
            ) from error
        every: dict[str, np.ndarray] = {}
        for name in table.column_names:
            if not name.startswith("observation.images"):
                every |= dict(_unfolded(name, table.column(name), _names_of(info, name)))
        for episode, part in _episodes(every):
            name = path.stem if episode is None else f"{path.stem} episode {episode}"
            logs += _logs(name, path, _with_exact_time(part, info), columns)
    if len(logs) == 1:
        logs = [replace(logs[0], name=path.stem)]
    return logs


def _check_size(path: Path, metadata: Any) -> None:
    """Refuse a parquet file that unpacks to more than can be read: of a constant it holds 1e8 in a megabyte."""
    if metadata.num_rows > _MOST_ROWS:
        raise ValueError(
            f"{path}: holds {metadata.num_rows:.3g} rows; expected at most {_MOST_ROWS:.0e} (28 h at 1 kHz). Cut it."
        )
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    values = sum(group.column(j).num_values for group in groups for j in range(group.num_columns))
    check_memory(_BYTES_PER_VALUE * values, f"{path}: reading its {values:.3g} values", "Cut it.")


def _unfolded(name: str, column: Any, names: tuple[str, ...]) -> Iterator[tuple[str, np.ndarray]]:
    """A parquet column as columns of numbers: lists by the names of their items, else by their places."""
    text = str(column.type)
    if "list" not in text:
        if text.startswith(("timestamp", "date")):
            yield name, column.to_numpy().astype("datetime64[ns]")
        elif text in ("string", "large_string"):
            yield name, np.array(["" if cell is None else cell for cell in column.to_pylist()])
        elif text.startswith(("int", "uint", "float", "double", "bool", "half")):
            values = column.to_numpy()
            yield name, values if values.dtype.kind in "iuf" else values.astype(np.float64)
        return
    rows = column.to_pylist()
    first = next((row for row in rows if row), None)
    if not isinstance(first, list) or isinstance(first[0], (list, str)):
        return
    length = len(first)
    values = np.array(
        [row if row is not None and len(row) == length else [np.nan] * length for row in rows], dtype=float
    )
    for i in range(length):
        place = f"{i} of {length}, {len(names)} names" if names else str(i)  # whose names these are is not known
        yield f"{name}[{names[i] if len(names) == length else place}]", values[:, i]


def _info(root: Path) -> Mapping[str, Any]:
    try:
        content = parsed_json((root / "meta" / "info.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{root / 'meta' / 'info.json'}: cannot be read ({error}). Is this a LeRobot dataset?"
        ) from None
    return content if isinstance(content, Mapping) else {}


def _names_of(info: Mapping[str, Any], feature: str) -> tuple[str, ...]:
    """The names of a feature's items: in a list, or in lists and tables within each other, or {name: place}."""
    names: Any = info.get("features", {}).get(feature, {}).get("names")
    if isinstance(names, Mapping) and names and all(isinstance(place, int) for place in names.values()):
        return tuple(sorted(names, key=lambda name: names[name]))
    return tuple(_texts(names))


def _texts(names: Any) -> Iterator[str]:
    """Every text in lists and tables within each other, in order."""
    if isinstance(names, str):
        yield names
    elif isinstance(names, Mapping):
        for each in names.values():
            yield from _texts(each)
    elif isinstance(names, list):
        for each in names:
            yield from _texts(each)


def _episodes(columns: dict[str, np.ndarray]) -> Iterator[tuple[int | None, dict[str, np.ndarray]]]:
    number = columns.get("episode_index")
    if number is None:
        yield None, columns
        return
    for episode in np.unique(number):
        at = number == episode
        yield int(episode), {name: values[at] for name, values in columns.items()}


def _with_exact_time(columns: dict[str, np.ndarray], info: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Stamps in float32 that are frame / fps, as such."""
    fps, frame, stamp = info.get("fps"), columns.get("frame_index"), columns.get("timestamp")
    if not isinstance(fps, (int, float)) or fps <= 0 or frame is None:
        return columns
    exact = frame / fps
    if stamp is None or (stamp.dtype.kind == "f" and np.abs(stamp - exact).max() < 0.02 / fps):
        return {**columns, "timestamp": exact}
    return columns


def _logs(
    name: str,
    path: Path,
    columns: dict[str, np.ndarray],
    chosen: ColumnMap | None,
    table: str = "",
    notes: Sequence[str] = (),
) -> list[Log]:
    """The log of a table; several where its clock was set back in between."""
    column, time, origin, note = _time(path, columns, chosen, notes)
    numbers, text = {}, []
    for key, values in columns.items():
        if key == column or is_time(key):
            continue
        if values.dtype.kind in "biuf":
            numbers[key] = values
        else:
            text.append(key)
    notes = [*notes, note, *([f"Not used, because they are text: {listed(text)}."] if text else [])]
    back = _set_back(time, numbers)
    parts = [slice(a, b) for a, b in zip([0, *back], [*back, len(time)], strict=True)]
    if len(back):
        known = np.isfinite(time)
        last = time[np.maximum.accumulate(np.where(known, np.arange(len(time)), 0))]
        first = time[known][0]
        jumps = [f"by {last[k - 1] - time[k]:.4g} s after row {k} ({last[k - 1] - first:.4g} s)" for k in back]
        short = [rows for rows in parts if rows.stop - rows.start < MIN_SAMPLES]
        parts = [rows for rows in parts if rows not in short] or parts
        left = f" Parts of fewer than {MIN_SAMPLES} rows are left out." if 0 < len(short) <= len(back) else ""
        notes.append(
            f"The clock goes back {listed(jumps, 4)}: read as {len(parts)} recording{'s' * (len(parts) > 1)}.{left}"
        )
    logs = []
    for number, rows in enumerate(parts, start=1):
        stamps, rounding = time[rows], ""
        if all(np.isfinite(values[rows]).all() or not np.isfinite(values[rows]).any() for values in numbers.values()):
            stamps, rounding = unrounded(stamps)
        channels, more = cleaned(table, stamps, {key: values[rows] for key, values in numbers.items()})
        logs.append(
            Log(
                name=name if len(parts) == 1 else f"{name} part {number}",
                channels={channel.key: channel for channel in channels},
                time_origin=origin,
                notes=(*(notes if number == 1 else []), *([rounding] if rounding else []), *more),
            )
        )
    return logs


def _set_back(time: np.ndarray, columns: Mapping[str, np.ndarray]) -> list[int]:
    """Rows at which the clock was set back, where the same columns go on: not of channels one after another."""
    filled = np.array([np.isfinite(values) for values in columns.values()]).reshape(len(columns), -1)
    stamped = np.flatnonzero(np.isfinite(time))
    back = stamped[set_back(time[stamped])].tolist()
    return [k for k in back if np.any(filled[:, :k].any(axis=1) & filled[:, k:].any(axis=1))]


def _time(
    path: Path, columns: dict[str, np.ndarray], chosen: ColumnMap | None, notes: Sequence[str]
) -> tuple[str, np.ndarray, float, str]:
    """The column of time, stamps [s], Unix time at zero, and a note on what they were taken for."""
    if chosen and chosen.time and chosen.time not in columns:
        raise ValueError(f"{path}: has no column '{chosen.time}' for the time. Columns: {listed(columns)}.")
    joined = _join_seconds(columns)
    named = [chosen.time] if chosen and chosen.time else [name for name in columns if is_time(name)]
    usable = [name for name in named if (chosen and chosen.time) or _mostly_rises(columns[name])]
    if usable:
        best = max(usable, key=lambda name: _share_rising(columns[name]))
        unit = (chosen.time_unit if chosen else "") or ("ns" if best in joined else time_unit(best))
        time, origin, note = _seconds(path, best, columns[best], unit)
        others = [_beside(best, time, name, columns[name]) for name in usable if name != best]
        others += [f"The rate of {chosen.rate:g} Hz is not used."] if chosen and chosen.rate else []
        return best, time, origin, " ".join([note, *others])
    if chosen and chosen.rate:
        count = len(next(iter(columns.values())))
        return "", np.arange(count) / chosen.rate, 0.0, f"Time is the row's number at the stated {chosen.rate:g} Hz."
    raise ValueError(
        f"{' '.join([f'{path}: no column of time found.', *notes])} Columns: {listed(columns, 12)}. Name it time, or "
        'write a column map: [time] column = "NAME", unit = "s". If the log has none, state its rate: --rate HZ.'
    )


def _beside(name: str, time: np.ndarray, other: str, values: np.ndarray) -> str:
    """What is to be said of a second column of time: that it runs at another rate than the one that is used."""
    if values.dtype.kind in "UM":
        return ""
    other_time = seconds_of(values)[0] if unix_unit(values) else values
    both = np.isfinite(time) & np.isfinite(other_time)
    if not both.any():
        return ""
    spans = float(np.ptp(time[both])), float(np.ptp(other_time[both]))
    ratio = min((spans[1] * unit / spans[0] for unit in TIME_UNITS.values()), key=lambda ratio: abs(np.log(ratio)))
    if abs(ratio - 1.0) < _ONE_CLOCK:
        return ""
    return (
        f"The log has two clocks: '{other}' spans {ratio:.3g} times as long as '{name}'. If '{other}' is right, write "
        f'it into a column map: [time] column = "{other}".'
    )


def _join_seconds(columns: dict[str, np.ndarray]) -> set[str]:
    """Make separate columns of whole seconds and their parts one column of nanoseconds; names of those."""
    tokens = {name: re.split(r"[^a-z]+", name.lower()) for name in columns}
    joined = set()
    for part, own in tokens.items():
        unit = next((_FRACTIONS[word] for word in own if word in _FRACTIONS), 0)
        if not unit or columns[part].dtype.kind not in "iuf" or not 0 <= np.nanmax(columns[part]) * unit < 1e9:
            continue
        forms = [[whole if word in _FRACTIONS else word for word in own] for whole in _WHOLE]
        whole = next((name for name, words in tokens.items() if words in forms), None)
        if whole is None or columns[whole].dtype.kind not in "iuf" or np.any(columns[whole] % 1):
            continue
        nano = columns.pop(part)
        columns[whole] = columns[whole].astype(np.int64) * 1_000_000_000 + (nano * unit).astype(np.int64)
        joined.add(whole)
    return joined


def _mostly_rises(values: np.ndarray) -> bool:
    """Whether a column may be time: it hardly ever falls, and does not stand still."""
    if values.dtype.kind in "UM":
        return True
    step = np.diff(values.astype(np.float64))
    step = step[np.isfinite(step)]
    return len(step) > 0 and float(np.mean(step < 0)) < 0.5 and bool(np.any(step > 0))


def _share_rising(values: np.ndarray) -> float:
    """In how many rows a column rises; dates always."""
    return 1.0 if values.dtype.kind in "UM" else float(np.mean(np.diff(values.astype(np.float64)) > 0))


def _seconds(path: Path, column: str, values: np.ndarray, unit: str) -> tuple[np.ndarray, float, str]:
    """Stamps [s], Unix time at zero, and a note on what they were taken for."""
    if values.dtype.kind in "UM":
        try:
            time, origin, _ = seconds_of(values)
        except ValueError as error:
            raise ValueError(f"{path}: the column '{column}' holds no dates ({error}). Correct it.") from None
        return time, origin, f"Time is '{column}', dates."
    if unix := unix_unit(values):
        time, origin, _ = seconds_of(values)
        return time, origin, f"Time is '{column}', Unix time in {unix}."
    if unit:
        return values * TIME_UNITS[unit], 0.0, f"Time is '{column}' in {unit}."
    step = np.diff(values.astype(np.float64))
    median = float(np.median(step[step > 0])) if np.any(step > 0) else 0.0
    fitting = [u for u, seconds in TIME_UNITS.items() if _FASTEST <= median * seconds <= _SLOWEST]
    if 0.5 <= median <= 1.5 or not fitting:
        raise ValueError(
            f"{path}: '{column}' steps by {median:g}. In s that is {1 / median if median else 0:.3g} Hz, too slow for "
            "joints. If it has another unit, state it in a column map: [time] unit = "
            '"ms" (or "us", "ns").'
        )
    unit = "s" if "s" in fitting else fitting[0]
    return (
        values * TIME_UNITS[unit],
        0.0,
        f"Time is '{column}', taken to be in {unit} ({1 / (median * TIME_UNITS[unit]):.4g} Hz).",
    )
