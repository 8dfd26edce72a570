"""Recordings cut into windows that are simulated side by side: a step costs much, a row more in it next to nothing.

Each window begins a little before its own samples, at the measured position and speed, so that what was wrong about its
beginning has died out when they come. What a drive remembers for longer, the position of a joint that sticks for
instance, begins anew: good enough to lead a fit, not to judge by.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from pace_optim.recording.dataset import Dataset

_LENGTH = 2.0
"""Of a window's own samples [s]."""
_BEFORE = 1.0
"""Time before them [s]."""
_SLOPE = 3
"""The speed at the beginning is the slope over so many samples to either side."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Windows:
    """W windows of the recordings of a dataset, padded to the longest; T' control steps."""

    recording: torch.Tensor
    """Of each window, (W,)."""
    step: torch.Tensor
    """Its control steps in its recording, (T', W); they go on after its end."""
    counts: torch.Tensor
    """Which of them are its own, (T', W) bool."""
    control_dt: float
    """[s]."""

    @classmethod
    def of(cls, dataset: Dataset, control_dt: float) -> Windows:
        """All windows of a dataset.

        Args:
            control_dt: [s].
        """
        recording, first, own, end = (torch.tensor(each) for each in zip(*_windows(dataset, control_dt), strict=True))
        step = first + torch.arange(int((end - first).max()))[:, None]
        return cls(recording=recording, step=step, counts=(step >= own) & (step < end), control_dt=control_dt)

    def with_samples(self, where: torch.Tensor) -> Windows:
        """Those that have samples that count, of (T, R)."""
        kept = self.mask(where).any(dim=0)
        return replace(self, recording=self.recording[kept], step=self.step[:, kept], counts=self.counts[:, kept])

    def part(self, share: float) -> Windows:
        """A share of each recording's windows, at least one, evenly spread."""
        kept = torch.zeros(len(self.recording), dtype=torch.bool)
        for r in self.recording.unique().tolist():
            own = (self.recording == r).nonzero()[:, 0]
            count = math.ceil(share * len(own))
            kept[own[((torch.arange(count) + 0.5) * len(own) / count).long()]] = True
        return replace(self, recording=self.recording[kept], step=self.step[:, kept], counts=self.counts[:, kept])

    def mask(self, where: torch.Tensor) -> torch.Tensor:
        """Which samples of windows count, (T', W) bool, of those of recordings (T, R)."""
        return where[self._at(where)] & self.counts

    def cut(self, dataset: Dataset) -> Dataset:
        """The dataset of windows, each a recording."""
        since = self.step[0] * self.control_dt
        begins = zip(self.recording.tolist(), self.step[0].tolist(), strict=True)
        return replace(
            dataset.at(*self._at(dataset.command)),
            sampled=self.mask(dataset.sampled),
            train=self.mask(dataset.train),
            settling=None if dataset.settling is None else self.mask(dataset.settling),
            start_vel=torch.stack([_speed(dataset, r, step, self.control_dt) for r, step in begins]),
            start_time=dataset.start_time[self.recording] + since,
            session_start=dataset.session_start[self.recording] + since,
        )

    def _at(self, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Where values (T, R, …) of windows are; after the end, the last."""
        return self.step.clamp(max=len(values) - 1), self.recording


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
    if (recorded := dataset.recordings[r].dof_vel) is not None and not np.isnan(recorded).any():
        return dataset.measured_vel[step, r]
    samples = dataset.sampled[:, r].nonzero()[:, 0]
    place = int((samples == step).nonzero())
    before, after = samples[max(0, place - _SLOPE)], samples[min(len(samples) - 1, place + _SLOPE)]
    return (dataset.measured[after, r] - dataset.measured[before, r]) / ((after - before) * control_dt)
