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
    by_speed: tuple[str, ...] = ()
    """Joints whose drives follow speeds: they get the slope of their targets."""

    @property
    def told_pos(self) -> np.ndarray | None:
        """Positions that drives get, as a recording has them: (T, n) [rad], NaN for joints that follow speeds."""
        by_speed = self._follows_speed
        if by_speed.all():
            return None
        return np.where(by_speed, np.nan, self.des_dof_pos) if by_speed.any() else self.des_dof_pos

    @property
    def told_vel(self) -> np.ndarray | None:
        """Speeds that drives get, (T, n) [rad/s], NaN for joints that follow positions; at rest in the end."""
        by_speed, target = self._follows_speed, self.des_dof_pos
        slope = np.diff(target, axis=0, append=target[-1:]) / (self.time[1] - self.time[0])
        return np.where(by_speed, slope, np.nan) if by_speed.any() else None

    @property
    def _follows_speed(self) -> np.ndarray:
        return np.isin(self.joint_names, self.by_speed)


def write_command_csv(path: str | os.PathLike[str], trajectory: Trajectory) -> Path:
    """Write the commands alone, columns ``time`` and ``des_dof_pos/<joint>``, to play them on a real robot.

    Joints that follow speeds have ``des_dof_vel/<joint>``. Numbers have as many digits as it takes to read back the
    same. The file appears whole or not at all.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        raise ValueError(f"{path}: found the suffix '{path.suffix}'; expected '.csv'. Rename the file.")
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {
        f"{series}/{joint}": values[:, j]
        for series, values in (("des_dof_vel", trajectory.told_vel), ("des_dof_pos", trajectory.told_pos))
        if values is not None
        for j, joint in enumerate(trajectory.joint_names)
        if not np.isnan(values[:, j]).any()
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time", *columns])
    writer.writerows(np.column_stack([trajectory.time, *columns.values()]).tolist())
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))
    return path
