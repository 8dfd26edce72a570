"""The columns of the regression of a joint's measured torque: every series at every lag that is tried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pace_optim.recording import Recording
from pace_optim.recording.resample import interpolate_smooth

_FEEDBACK_LAGS = np.arange(-1.0, 4.0)
"""Samples by which a log's torque may come later than the position or speed that it was made of."""
_BETWEEN = np.arange(-1.0, 3.5, 0.5)
"""The same where a log's samples are not those of the drive: their noise separates whole samples from others."""
_MOST_SAMPLES = 10_000
"""More say nothing new of six numbers."""
_LEAST_SAMPLES = 100
_MEMORY = 0.25
"""Time over which residuals may go on [s]."""
_IDLE = 1e-6
"""A joint whose position and commands change by less says nothing [rad, rad/s, N m]."""
_TOLERANCE = 1e-3
"""Part of a command's period by which stamps of one instant may differ."""
_SMOOTH = np.array([-2, -1, 0, 1, 2]) / 10
"""Speed in samples from five positions: the slope of a parabola through them."""
_SHARP = np.array([1, -8, 0, 8, -1]) / 12
"""The same of a quartic: less smooth, more exact where the motion is fast for the rate of the log."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Torque and candidates for its causes, at the samples that can be used."""

    torque: np.ndarray
    """(K,) [N m]."""
    columns: np.ndarray
    """(K, m)."""
    follows: np.ndarray
    """Whether a sample comes right after the one before, (K - 1,) bool."""
    stride: float
    """Control steps in a sample."""
    sampled: bool
    """Whether the samples are those of the drive."""
    phase: float | None
    """When the drive is taken to run [control steps]; ``None``: whenever there is a sample."""
    memory: int
    """Samples over which residuals may go on."""
    commands: dict[str, np.ndarray]
    """Columns of each commanded series ("position", "velocity", "effort") at each of ``command_lags``."""
    command_lags: np.ndarray
    """Evenly rising [control steps]."""
    position: np.ndarray
    """Columns of the position at each of ``feedback_lags``."""
    speeds: list[np.ndarray]
    """The same of the speed; more than one where it is taken from positions, in more than one way."""
    feedback_lags: np.ndarray
    """Evenly rising [control steps]."""

    @classmethod
    def of(
        cls,
        recording: Recording,
        j: int,
        longest_delay: float,
        phase: float | None = None,
        most: int = _MOST_SAMPLES,
        shift: float = 0.0,
    ) -> Table | None:
        """The table of a joint; ``None`` where its torque is not known, or too little of it.

        It is made of the samples as they were logged, which belong to the torques that came with them.

        Args:
            recording: On the control grid.
            j: Column of the joint.
            longest_delay: Longest delay of commands [control steps].
            phase: When the drive runs, once a control step, of a log that does not sample it [control steps].
            shift: By how much later its position and speed are taken [control steps].
        """
        log = recording if recording.logged is None else recording.logged
        if log.dof_effort is None:
            return None
        control_dt = float(recording.time[1] - recording.time[0]) / recording.sample_stride
        stride = float(np.median(np.diff(log.time))) / control_dt
        sampled = log is recording
        feedback = np.arange(3.0) if phase is not None else stride * (_FEEDBACK_LAGS if sampled else _BETWEEN)
        steps = np.ceil(longest_delay) + feedback[-1]
        lags = np.arange(-np.ceil(stride), steps + 1, 1.0 if sampled or phase is not None else 0.5)
        time, torque, position = log.time, log.dof_effort[:, j], log.dof_pos[:, j]
        given, speeds = _commands(recording, j), _speeds(log, j)
        before = int(np.ceil(steps / stride)) + 2
        usable = np.isfinite(torque) & np.all([np.isfinite(speed) for speed in speeds], axis=0)
        usable[:before] = usable[-3:] = False
        if log.torque_enable is not None:
            off = np.convolve(~log.torque_enable.astype(bool), np.ones(before))[: len(torque)]
            usable &= off == 0
        rows = np.flatnonzero(usable)
        rows = rows[:: max(1, len(rows) // most)]
        at = time[rows]
        if phase is not None:
            at = control_dt * (np.floor(at / control_dt - phase + 1e-6) + phase)
        if not given or len(rows) < _LEAST_SAMPLES or np.ptp(torque[rows]) == 0:
            return None
        told = any(np.ptp(values) > _IDLE for _, values in given.values())
        if not told and np.ptp(position[rows]) <= _IDLE:  # an idle joint's torque is no law's
            return None
        columns: list[np.ndarray] = []

        def add(new: list[np.ndarray]) -> np.ndarray:
            columns.extend(new)
            return np.arange(len(columns) - len(new), len(columns))

        def seen(series: np.ndarray) -> list[np.ndarray]:
            there = np.isfinite(series)  # the slope has no ends
            return [
                interpolate_smooth(time[there], series[there, None], at - (lag - shift) * control_dt)[:, 0]
                for lag in feedback
            ]

        return cls(
            torque=torque[rows],
            commands={name: add([_held(*c, at - lag * control_dt) for lag in lags]) for name, c in given.items()},
            command_lags=lags,
            position=add(seen(position)),
            speeds=[add(seen(speed)) for speed in speeds],
            feedback_lags=feedback,
            columns=np.stack([*columns, np.ones(len(rows))], axis=1),
            follows=np.diff(rows) == rows[1] - rows[0],
            stride=stride,
            sampled=sampled,
            phase=phase,
            memory=round(_MEMORY / (float(np.median(np.diff(time))) * float(rows[1] - rows[0]))),
        )


def _held(stamps: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Commands as they are in force at some times."""
    tolerance = _TOLERANCE * float(stamps[1] - stamps[0])
    return values[np.clip(np.searchsorted(stamps, at + tolerance, side="right") - 1, 0, None)]


def _commands(recording: Recording, j: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What is commanded of a joint, by kind: stamps and values; those kinds that there are."""
    there = {
        "position": recording.has_position_command[j],
        "velocity": recording.has_velocity_command[j],
        "effort": recording.has_effort_command[j],
    }
    log = recording.logged
    if log is None:
        series = recording.command, recording.command_vel, recording.command_effort
        dt = float(recording.time[1] - recording.time[0]) / recording.sample_stride
        stamps = dt * np.arange(max(len(s) for s in series if s is not None))
    else:
        series = log.des_dof_pos, log.des_dof_vel, log.des_dof_effort
        stamps = log.time if log.des_time is None else log.des_time
    return {
        name: (stamps, values[:, j])
        for (name, has), values in zip(there.items(), series, strict=True)
        if has and values is not None
    }


def _speeds(recording: Recording, j: int) -> list[np.ndarray]:
    """The measured speed, or the speed from positions in two ways, (T,) each [rad/s]; NaN at the ends."""
    if recording.dof_vel is not None and np.isfinite(recording.dof_vel[:, j]).any():
        return [recording.dof_vel[:, j]]
    dt = float(np.median(np.diff(recording.time)))
    results = []
    for weights in (_SMOOTH, _SHARP):
        speed = np.full(recording.num_samples, np.nan)
        speed[2:-2] = np.correlate(recording.dof_pos[:, j], weights) / dt
        results.append(speed)
    return results
