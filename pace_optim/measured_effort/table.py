"""The columns of the regression of a joint's measured torque: every series at every lag that is tried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pace_optim.recording import Recording

FEEDBACK_LAGS = (-1, 0, 1, 2, 3)
"""Samples by which a log's torque may come later than the position that it was made of."""
_MOST_SAMPLES = 20_000
"""More say nothing new of six numbers."""
_LEAST_SAMPLES = 100
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
    stride: int
    """Control steps in a sample."""
    commands: dict[str, np.ndarray]
    """Columns of each commanded series ("position", "velocity", "effort") at rising lags in control steps."""
    first_lag: int
    """The first of those lags."""
    position: np.ndarray
    """Columns of the position at each of ``FEEDBACK_LAGS``."""
    speeds: list[np.ndarray]
    """The same of the speed; more than one where it is taken from positions, in more than one way."""

    @classmethod
    def of(cls, recording: Recording, j: int, longest_delay: float) -> Table | None:
        """The table of a joint; ``None`` where its torque is not known, or too little of it.

        Args:
            recording: On the control grid.
            j: Column of the joint.
            longest_delay: Longest delay of commands [control steps].
        """
        if recording.dof_effort is None:
            return None
        stride, torque, position = recording.sample_stride, recording.dof_effort[:, j], recording.dof_pos[:, j]
        given = {name: series for name, series in _commands(recording, j).items() if series is not None}
        speeds = _speeds(recording, j)
        steps = int(np.ceil(longest_delay)) + FEEDBACK_LAGS[-1] * stride
        before = -(-steps // stride) + 1
        usable = np.isfinite(torque) & np.all([np.isfinite(speed) for speed in speeds], axis=0)
        usable[:before] = usable[-3:] = False
        if recording.torque_enable is not None:
            off = np.convolve(~recording.torque_enable.astype(bool), np.ones(before))[: len(torque)]
            usable &= off == 0
        rows = np.flatnonzero(usable)
        rows = rows[:: max(1, len(rows) // _MOST_SAMPLES)]
        if not given or len(rows) < _LEAST_SAMPLES or np.ptp(torque[rows]) == 0:
            return None
        columns: list[np.ndarray] = []

        def add(*new: np.ndarray) -> np.ndarray:
            columns.extend(new)
            return np.arange(len(columns) - len(new), len(columns))

        at = [np.clip(rows * stride - lag, 0, None) for lag in range(-stride, steps + 1)]
        commands = {name: add(*(s[np.minimum(k, len(s) - 1)] for k in at)) for name, s in given.items()}
        return cls(
            torque=torque[rows],
            commands=commands,
            first_lag=-stride,
            position=add(*(position[rows - lag] for lag in FEEDBACK_LAGS)),
            speeds=[add(*(speed[rows - lag] for lag in FEEDBACK_LAGS)) for speed in speeds],
            columns=np.stack([*columns, np.ones(len(rows))], axis=1),
            follows=np.diff(rows) == rows[1] - rows[0],
            stride=stride,
        )


def _commands(recording: Recording, j: int) -> dict[str, np.ndarray | None]:
    """What is commanded of a joint on the control grid, by kind; ``None`` where nothing is."""
    found = {
        "position": (recording.has_position_command[j], recording.command),
        "velocity": (recording.has_velocity_command[j], recording.command_vel),
        "effort": (recording.has_effort_command[j], recording.command_effort),
    }
    return {name: series[:, j] if there and series is not None else None for name, (there, series) in found.items()}


def _speeds(recording: Recording, j: int) -> list[np.ndarray]:
    """The measured speed, or the speed from positions in two ways, (T,) each [rad/s]; NaN at the ends."""
    if recording.dof_vel is not None and np.isfinite(recording.dof_vel[:, j]).any():
        return [recording.dof_vel[:, j]]
    dt = float(recording.time[1] - recording.time[0])
    results = []
    for weights in (_SMOOTH, _SHARP):
        speed = np.full(recording.num_samples, np.nan)
        speed[2:-2] = np.correlate(recording.dof_pos[:, j], weights) / dt
        results.append(speed)
    return results
