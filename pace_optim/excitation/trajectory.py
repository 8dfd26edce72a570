"""A commanded trajectory, and its file form for a real robot."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pace_actuators.files import write_atomically


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Position targets of n joints at T instants; target k is issued at ``time[k]`` and holds until the next."""

    name: str
    """Name of the motion; part of a file's name."""
    time: np.ndarray
    """Instants, (T,) [s], evenly spaced from 0."""
    des_dof_pos: np.ndarray
    """Position targets, (T, n) [rad]."""
    joint_names: tuple[str, ...]
    """The joints, in the order of the columns."""
    has_jumps: bool = False
    """Whether targets jump on purpose (steps), so that their difference says nothing about speed."""


def write_command_csv(path: str | os.PathLike[str], trajectory: Trajectory) -> Path:
    """Write the targets alone, columns ``time`` and ``des_dof_pos/<joint>``, to play them on a real robot.

    Numbers have as many digits as it takes to read back the same. The file appears whole or not at all.

    Raises:
        ValueError: If the path does not end in ``.csv``.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        raise ValueError(f"{path}: found the suffix '{path.suffix}'; expected '.csv'. Rename the file.")
    path.parent.mkdir(parents=True, exist_ok=True)
    header = ["time", *(f"des_dof_pos/{joint}" for joint in trajectory.joint_names)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(np.column_stack([trajectory.time, trajectory.des_dof_pos]).tolist())
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))
    return path
