"""Recordings too long to fit: the parts of them that move the joints most, each a separate recording.

A refinement keeps the derivative of every sample by every parameter, and simulates every step for each of them: with 30
joints, ten minutes at 400 Hz are 3 GB and hours. A motion says nearly all that it has to say in its best minute. A part
begins at the measured position and speed; what the drive remembers, such as commands under way, begins anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pace_actuators.memory import check_memory

from .data import Recording
from .keys import SAMPLED_SERIES

_NUMBERS = 20_000_000
"""Derivatives that a fit keeps by default: 0.16 GB."""
_EVALUATIONS = 200_000_000
"""Times that a joint's acceleration is computed for them: half a minute of two cores."""
_COPIES = 4
"""Arrays of that size that there are at once."""
_WALKING = 20.0
"""Of a robot that walks, so much is used by default [s]: a walk repeats itself."""
_LENGTH = 5.0
"""Of a part [s]."""
_SLOPE = 3
"""The speed at the beginning of a part is the slope over so many samples to either side."""
_LITTLE = 0.01
"""Of a joint's best part: motion that is as good as none."""


def affordable(
    recordings: Sequence[Sequence[Recording]],
    control_dt: float,
    columns: int,
    evaluations: int,
    max_duration: float | None,
    tell: Callable[[str], None],
) -> list[list[Recording]]:
    """The recordings, or parts of them where all would be too much.

    Args:
        recordings: Conformed; those to train on, and those to validate on.
        control_dt: Control step [s].
        columns: Parameters whose derivatives are computed each by itself.
        evaluations: Of the accelerations in a control step.
        max_duration: How long each may be [s]; ``None``: as long as there are not too many derivatives.
    """
    every = [recording for group in recordings for recording in group]
    per_second = columns * max((recording.num_joints for recording in every), default=1) / control_dt
    affordable_numbers = min(_NUMBERS, _EVALUATIONS / evaluations)
    share = min(1.0, affordable_numbers / max(1.0, per_second * sum(recording.duration for recording in every)))
    result: list[list[Recording]] = [[] for _ in recordings]
    for group, kept in zip(recordings, result, strict=True):
        for recording in group:
            longest = share * recording.duration if max_duration is None else max_duration
            if max_duration is None and recording.frame is not None:
                longest = min(longest, _WALKING)
            parts = informative_parts(recording, longest)
            if parts[0] is not recording:
                tell(f"note: {parts[0].notes[-1]}")
            kept += parts
    seconds = sum(recording.duration for kept in result for recording in kept)
    check_memory(8 * _COPIES * per_second * seconds, f"Fitting {seconds:.4g} s", "Give a smaller --max_duration.")
    return result


def informative_parts(recording: Recording, longest: float) -> list[Recording]:
    """The recording, or parts of it of 5 s, in their order, that together move every joint most.

        parts = argmax Σ_j log(0.01 + Σ_parts e_j / max e_j),  e_j = mean square of the joint's speed,

    chosen one after another. Of a robot that walks, only the speed of joints that are free counts.

    Args:
        longest: How long they may be together [s].
    """
    dt = float(recording.time[1] - recording.time[0])
    length, count = round(_LENGTH / dt), int(longest / _LENGTH)
    if recording.duration <= max(longest, 2 * _LENGTH):
        return [recording]
    number = recording.num_samples // length
    speed = np.diff(recording.dof_pos, axis=0, prepend=recording.dof_pos[:1]) / dt
    if recording.free is not None:  # what joints do where the ground holds them says nothing
        speed = speed * recording.free[recording.sample_steps]
    energy = np.square(speed[: number * length]).reshape(number, length, -1).mean(axis=1)
    energy /= energy.max(axis=0) + 1e-300
    chosen: list[int] = []
    for _ in range(min(max(1, count), number)):
        gain = np.log(_LITTLE + energy[chosen].sum(axis=0) + energy).sum(axis=1)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
    parts = [_part(recording, w * length, (w + 1) * length, dt) for w in sorted(chosen)]
    many = f"{len(chosen)} part{'s' * (len(chosen) > 1)} of {_LENGTH:g} s"
    note = (
        f"{recording.name}: of {recording.duration:.4g} s the {len(chosen) * _LENGTH:g} s that move the joints most "
        f"are used ({100 * len(chosen) * _LENGTH / recording.duration:.2g} %), in {many}; --max_duration SECONDS takes "
        "more or fewer."
    )
    return [replace(parts[0], notes=(*recording.notes, note)), *parts[1:]]


def _part(recording: Recording, first: int, end: int, dt: float) -> Recording:
    """Some samples, copied so that the rest can go; it begins at the speed that it has there."""
    at, begin = recording.sample_steps[first:end], float(recording.time[first])
    grid = slice(int(at[0]), int(at[-1]) + 1)
    measured: dict[str, Any] = {
        key: value[first:end].copy() for key in SAMPLED_SERIES if (value := getattr(recording, key)) is not None
    }
    commands: dict[str, Any] = {
        key: value[grid].copy()
        for key in ("command", "command_vel", "command_effort", "command_torque_enable", "frame", "free")
        if (value := getattr(recording, key)) is not None
    }
    own: dict[str, Any] = {  # which joints have which commands is read from these
        f"des_dof_{key}": np.where(has, commands[name][at - at[0]], np.nan)
        for key, name, has in (
            ("pos", "command", recording.has_position_command),
            ("vel", "command_vel", recording.has_velocity_command),
            ("effort", "command_effort", recording.has_effort_command),
        )
        if getattr(recording, f"des_dof_{key}") is not None and name in commands
    }
    low, high = max(0, first - _SLOPE), min(recording.num_samples - 1, first + _SLOPE)
    slope = (recording.dof_pos[high] - recording.dof_pos[low]) / ((high - low) * dt)
    speed = np.full_like(recording.dof_pos[first:end], np.nan) if recording.dof_vel is None else measured["dof_vel"]
    measured["dof_vel"] = np.concatenate([np.where(np.isnan(speed[:1]), slope, speed[:1]), speed[1:]])
    return replace(
        recording,
        **measured,
        **commands,
        **own,
        name=f"{recording.name} {begin:g} to {recording.time[end - 1] + dt:g} s",
        part_of=recording.name,
        time=recording.time[first:end] - begin,
        sample_at=None if recording.sample_at is None else at - at[0],
        sample_offset=None if recording.sample_offset is None else recording.sample_offset[first:end],
        effort_offset=None if recording.effort_offset is None else recording.effort_offset[first:end],
        des_time=None,
        time_origin=recording.time_origin + begin,
        notes=(),
    )
