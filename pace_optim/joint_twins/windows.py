"""Recordings cut into windows that are simulated side by side: a step costs much, a row more in it next to nothing.

Each window begins a little before its own samples, at the measured position and speed, so that what was wrong about its
beginning has died out when they come. What a drive remembers for longer, the position of a joint that sticks for
instance, begins anew: good enough to lead a fit, not to judge by.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch

from pace_optim.dataset import Dataset
from pace_optim.joint_twins.path import ReferencePath

_LENGTH = 2.0
"""Of a window's own samples [s]."""
_BEFORE = 1.0
"""Time before them [s]."""
_SLOPE = 3
"""The speed at the beginning is the slope over so many samples to either side."""


def in_windows(dataset: Dataset, path: ReferencePath, control_dt: float) -> tuple[Dataset, ReferencePath]:
    """The recordings of a dataset and of its reference, cut into windows; each counts as a recording.

    Args:
        dataset: R recordings.
        path: Of the same.
        control_dt: [s].
    """
    recording, first, own, end = (torch.tensor(each) for each in zip(*_windows(dataset, control_dt), strict=True))
    step = first + torch.arange(int((end - first).max()))[:, None]
    counts = (step >= own) & (step < end)
    at = step.clamp(max=len(dataset.command) - 1), recording
    since = first * control_dt
    cut = replace(
        dataset,
        recordings=tuple(dataset.recordings[r] for r in recording.tolist()),
        command=dataset.command[at],
        measured=dataset.measured[at],
        measured_vel=dataset.measured_vel[at],
        sampled=dataset.sampled[at] & counts,
        train=dataset.train[at] & counts,
        torque_enable=None if dataset.torque_enable is None else dataset.torque_enable[at],
        validation_only=tuple(dataset.validation_only[r] for r in recording.tolist()),
        start_vel=torch.stack(
            [_speed(dataset, r, step, control_dt) for r, step in zip(recording.tolist(), first.tolist(), strict=True)]
        ),
        start_time=dataset.start_time[recording] + since,
        session_start=dataset.session_start[recording] + since,
    )
    return cut, path.at(step, recording)


def _windows(dataset: Dataset, control_dt: float) -> list[tuple[int, int, int, int]]:
    """Of each window its recording, the first step, the first step that counts and the one after the last."""
    windows = []
    for r in range(dataset.num_recordings):
        samples = dataset.sampled[:, r].nonzero()[:, 0]
        steps = int(samples[-1]) + 1
        count = max(1, round(steps * control_dt / _LENGTH))
        edges = [round(steps * w / count) for w in range(count + 1)]
        for own, end in itertools.pairwise(edges):
            wanted = max(0, own - round(_BEFORE / control_dt))
            windows.append((r, int(samples[samples <= wanted][-1]), own, end))
    return windows


def _speed(dataset: Dataset, r: int, step: int, control_dt: float) -> torch.Tensor:
    """Speed of a recording at a sample, (n,) [rad/s]."""
    if step == 0:
        return dataset.start_vel[r]
    if dataset.recordings[r].dof_vel is not None:
        return dataset.measured_vel[step, r]
    samples = dataset.sampled[:, r].nonzero()[:, 0]
    place = int((samples == step).nonzero())
    before, after = samples[max(0, place - _SLOPE)], samples[min(len(samples) - 1, place + _SLOPE)]
    return (dataset.measured[after, r] - dataset.measured[before, r]) / ((after - before) * control_dt)
