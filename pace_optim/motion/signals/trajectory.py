"""A commanded trajectory, and its file form for a real robot."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pace_actuators.files import write_atomically
from pace_envs.tasks.pace import PaceCfg
from pace_optim.recording import Drive, Load, Recording

_MIN_SAMPLES = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """A request for a motion. An excitation makes signals that stay within ±1 and start at 0; this scales them.

    The target of each joint is

        target = (signal + bias) * direction * scale        (bias, direction, scale: PaceCfg.excitation)
    """

    cfg: PaceCfg
    """The robot's configuration; its ``excitation`` must not be None."""
    duration: float
    """Duration of one trajectory [s]."""
    control_dt: float
    """Time between two targets [s]."""
    min_frequency: float
    """Lower end of the band [Hz]."""
    max_frequency: float
    """Upper end of the band [Hz]."""
    rng: np.random.Generator
    """The only source of randomness."""
    time: np.ndarray = field(init=False)
    """Instants, (T,) [s]."""
    scale: np.ndarray = field(init=False)
    """Amplitude of a signal of 1, with the sign of its direction, (n,) [rad]."""
    bias: np.ndarray = field(init=False)
    """Centre of the motion before scaling, (n,)."""

    def __post_init__(self) -> None:
        """Check the request and lay out the time base."""
        excitation, names = self.cfg.excitation, self.cfg.joint_order
        if excitation is None:
            raise ValueError(
                f"{self.cfg.robot_name} has no excitation, so it is not known how far its joints may move. Set "
                "PaceCfg.excitation = ExcitationCfg(bias=..., direction=..., scale=...), one value per joint."
            )
        for key in ("bias", "direction", "scale"):
            values = getattr(excitation, key)
            if len(values) != len(names) or not np.all(np.isfinite(values)):
                raise ValueError(
                    f"excitation.{key} of {self.cfg.robot_name} is {tuple(values)}; expected {len(names)} finite "
                    f"numbers, one per joint of joint_order ({', '.join(names)}). Correct the configuration."
                )
        self._check_time_and_band()
        steps = round(self.duration / self.control_dt)
        object.__setattr__(self, "time", np.arange(steps) * self.control_dt)
        signed = np.asarray(excitation.direction, dtype=float) * np.asarray(excitation.scale, dtype=float)
        object.__setattr__(self, "scale", signed)
        object.__setattr__(self, "bias", np.asarray(excitation.bias, dtype=float))

    @property
    def num_joints(self) -> int:
        """Number of joints n."""
        return len(self.cfg.joint_order)

    def trajectory(self, name: str, signal: np.ndarray, *, has_jumps: bool = False) -> Trajectory:
        """Scale a signal to the robot.

        Args:
            signal: (T,), the same for all joints, or (T, n); within ±1.
            has_jumps: Whether it jumps on purpose.
        """
        signal = signal[:, None] if signal.ndim == 1 else signal
        return Trajectory(
            name=name,
            time=self.time,
            des_dof_pos=(signal + self.bias) * self.scale,
            joint_names=tuple(self.cfg.joint_order),
            has_jumps=has_jumps,
        )

    def _check_time_and_band(self) -> None:
        if not (np.isfinite(self.control_dt) and self.control_dt > 0):
            raise ValueError(f"control_dt is {self.control_dt}; expected a time above zero [s].")
        shortest = _MIN_SAMPLES * self.control_dt
        if not (np.isfinite(self.duration) and shortest <= self.duration <= 3600):
            raise ValueError(
                f"The duration is {self.duration:g} s; expected {shortest:g} s ({_MIN_SAMPLES} samples) to 3600 s. "
                "20 s is usual."
            )
        low, high, nyquist = self.min_frequency, self.max_frequency, 0.5 / self.control_dt
        if not (0 < low < high < nyquist):
            raise ValueError(
                f"The band is {low:g} to {high:g} Hz; expected 0 < min_frequency < max_frequency < {nyquist:g} Hz "
                "(half the control rate). 0.1 to 10 Hz is usual."
            )


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

    def draft(self, drive: Drive, load: Load) -> Recording:
        """The recording before it is made: the encoder at the first target."""
        return Recording(
            name=self.name,
            joint_names=self.joint_names,
            time=self.time,
            dof_pos=np.repeat(self.des_dof_pos[:1], len(self.time), axis=0),
            des_dof_pos=self.told_pos,
            des_dof_vel=self.told_vel,
            drive=drive,
            load=load,
        )

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
