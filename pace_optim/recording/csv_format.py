"""The CSV form of a recording: columns `time`, `torque_enable`, and `<series>/<joint>`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from .keys import JOINT_SERIES, listed

_WORDS = {"true": 1.0, "false": 0.0}


def read_csv(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the fields of a CSV file, and its columns as they are called there."""
    header, rows = _read_cells(path)
    if repeated := sorted({c for c in header if header.count(c) > 1}):
        raise ValueError(f"{path}: the column(s) {listed(repeated)} appear twice. Keep one of each.")
    columns: dict[str, dict[str, int]] = {}
    for index, column in enumerate(header):
        series, _, joint = column.partition("/")
        columns.setdefault(series, {})[joint] = index
    joints = list(columns.get("dof_pos", {}))
    fields: dict[str, Any] = {}
    for series, index_of in columns.items():
        if series in ("time", "torque_enable"):
            indices = list(index_of.values())
            values = np.stack([_numbers(path, header[i], rows, i) for i in indices], axis=1)
            fields[series] = values[:, 0] if len(indices) == 1 else values
        elif series in JOINT_SERIES and joints:
            _check_joints(path, series, list(index_of), joints, header)
            fields[series] = np.stack([_numbers(path, f"{series}/{j}", rows, index_of[j]) for j in joints], axis=1)
        else:
            fields[series] = ()  # the check of the keys says what becomes of it
    if joints:
        fields["joint_names"] = joints
    return fields, tuple(header)


def write_csv(file: IO[bytes], series: Mapping[str, np.ndarray], joint_names: tuple[str, ...]) -> None:
    """Write series as CSV; every number with as many digits as it takes to read back the same."""
    num_joints = series["dof_pos"].shape[1]
    joints = joint_names or tuple(f"joint_{i}" for i in range(num_joints))
    header: list[str] = []
    columns: list[list[Any]] = []
    for key, values in series.items():
        if values.ndim == 1:
            header.append(key)
            columns.append((values.astype(int) if values.dtype == bool else values).tolist())
        else:
            header += [f"{key}/{joint}" for joint in joints]
            columns += values.T.tolist()
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    text.flush()
    text.detach()


def _read_cells(path: Path) -> tuple[list[str], list[list[str]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: cannot be read as CSV text ({error}). Save it as comma-separated UTF-8.") from error
    if not rows:
        raise ValueError(f"{path}: is empty; expected a line of column names, then one line per sample.")
    header = [column.strip() for column in rows[0]]
    if len(header) == 1:
        raise ValueError(
            f"{path}: has one column, '{header[0][:60]}'; expected time, dof_pos/<joint>, "
            "des_dof_pos/<joint>. Separate the columns by commas."
        )
    for line, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise ValueError(
                f"{path}: row {line} has {len(row)} cells but the header has {len(header)}. "
                "Complete or delete the row (the last one is often cut short)."
            )
    return header, rows[1:]


def _check_joints(path: Path, series: str, found: list[str], joints: list[str], header: list[str]) -> None:
    if "" in found:
        raise ValueError(
            f"{path}: the column '{series}' names no joint; expected '{series}/<joint>'. Rename it. "
            f"Columns found: {listed(header)}."
        )
    if joints and set(found) != set(joints):
        raise ValueError(
            f"{path}: {series} has the joints {listed(found)} but dof_pos has {listed(joints)}. "
            f"Give every series the same joints. Columns found: {listed(header)}."
        )


def _numbers(path: Path, column: str, rows: list[list[str]], index: int) -> np.ndarray:
    words = _WORDS if column.startswith("torque_enable") else {}
    values = np.empty(len(rows))
    for row, cells in enumerate(rows):
        cell = cells[index].strip()
        try:
            values[row] = words[cell.lower()] if cell.lower() in words else float(cell)
        except ValueError:
            raise ValueError(
                f"{path}: row {row + 2}, column '{column}' holds '{cell}'; expected a number. "
                "Correct the cell, or delete the row."
            ) from None
    return values
