"""Where a robot was measured beside its simulation, smooth enough to be differentiated twice."""

from __future__ import annotations

import numpy as np
import torch
from scipy import fft, optimize

from pace_optim.recording import Recording
from pace_optim.recording.dataset import Dataset
from pace_optim.recording.noise import noise_floor

_SOFTEST, _STIFFEST = 1e-6, 1e24
"""Stiffness of the smoothing, between which it is sought."""


def at_every_step(dataset: Dataset, values: np.ndarray, count: int) -> torch.Tensor:
    """Values at samples, (T, R, n), at control steps, (count, R, n): straight between them, held after the last."""
    steps = np.arange(count)
    result = np.empty((count, *values.shape[1:]))
    for r in range(dataset.num_recordings):
        at = dataset.sampled[:, r].nonzero()[:, 0].numpy()
        taken = at if dataset.sample_offset is None else at + dataset.sample_offset[at, r].numpy()
        for j in range(values.shape[2]):
            result[:, r, j] = np.interp(steps, taken, values[at, r, j])
    return torch.from_numpy(result)


def beside_simulation(dataset: Dataset, shown: torch.Tensor) -> torch.Tensor:
    """How far the robot was from its simulation at control steps, without the measurement's noise, (count, R, n) [rad].

    Args:
        dataset: The recordings.
        shown: What encoders show in the simulation where there are samples, (count, R, n) [rad].
    """
    count = len(shown)
    error = at_every_step(dataset, (dataset.measured[:count] - shown).numpy(), count)
    for r, recording in enumerate(dataset.recordings):
        dt = float(np.median(np.diff(recording.time)))
        last = int(dataset.sampled[:count, r].nonzero()[-1]) + 1
        if dataset.carried is not None:
            _smooth_phases(error[:, r], dataset.carried.free[:count, r], recording, dt)
            continue
        for j in range(error.shape[2]):
            noise = noise_floor(recording.dof_pos[:, j], dt).sigma
            each = error[:last, r, j].numpy()
            error[:last, r, j] = torch.from_numpy(_smooth(each, noise))
            error[last:, r, j] = error[last - 1, r, j]
    return error


def _smooth_phases(error: torch.Tensor, free: torch.Tensor, recording: Recording, dt: float) -> None:
    """Smooth errors (T, n) in each free phase by itself; a joint that is held is where it was measured."""
    for j in range(error.shape[1]):
        noise = noise_floor(recording.dof_pos[:, j], dt).sigma
        own = free[:, j].numpy().astype(int)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], own, [0]])))
        error[:, j] *= free[:, j]
        for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            error[first:end, j] = torch.from_numpy(_smooth(error[first:end, j].numpy(), noise))


def _smooth(values: np.ndarray, noise: float) -> np.ndarray:
    """The curve of least bending that is as far from the values as their noise, (T,).

        min Σ (y - x)² + λ Σ (Δ²y)²    with λ such that the mean of (y - x)² is σ²

    What drives a joint beside its model is torque, which is integrated twice: of such errors, hidden in white noise,
    this is the best estimate (Whittaker's graduation, a discrete smoothing spline). Solved in cosines.
    """
    waves = fft.dct(values, norm="ortho")
    bending = (2 - 2 * np.cos(np.pi * np.arange(len(values)) / len(values))) ** 2

    def left(stiffness: float) -> float:
        return float(np.mean((waves * (1 - 1 / (1 + stiffness * bending))) ** 2)) - noise**2

    if left(_STIFFEST) <= 0:
        stiffness = _STIFFEST
    elif left(_SOFTEST) >= 0:
        return values
    else:
        low, high = np.log(_SOFTEST), np.log(_STIFFEST)
        stiffness = float(np.exp(optimize.brentq(lambda x: left(np.exp(x)), low, high, xtol=0.01)))
    return fft.idct(waves / (1 + stiffness * bending), norm="ortho")
