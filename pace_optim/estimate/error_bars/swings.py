"""What is not known of a walking robot's swings, in the error bars."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from pace_optim.estimate.derivatives import Jacobian
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.free_phases import FreePhases


def middle_of_swings(
    jacobian: Jacobian, every: Residuals, phases: FreePhases, sampled: torch.Tensor, recordings: Sequence[int]
) -> np.ndarray:
    """JᵀΣJ, (size, size), with Σ the covariance of each swing's errors, and none between swings.

    Residuals are whitened by C, which a fit follows. What lasts in them is in Σ = L⁻¹ C' L⁻ᵀ, with C' all that is not
    known of a swing. If the errors of a swing are above C', its Σ is as many times as large: each swing is a cluster
    with a variance of its own (Liang and Zeger, Biometrika 73, 1986).

    Args:
        jacobian: On the training samples.
        every: Residuals on all samples, from which those of the Jacobian were taken.
        phases: What is not known of swings.
        sampled: Where there is a sample, (T, R) bool.
        recordings: Of all R, those of the Jacobian.
    """
    residuals, colouring = jacobian.residuals, jacobian.colouring
    row = {entry: c for c, entries in enumerate(colouring.colours) for entry in entries}
    total = np.zeros((len(colouring.joints), len(colouring.joints)))
    if residuals.weight is None:
        return total
    place = torch.full((int(every.step.max()) + 1,), -1)
    place[residuals.step] = torch.arange(len(residuals.step))
    for block, begin, end, expected in phases.expected_of(every.step, sampled):
        if block.recording not in recordings:
            continue
        r, joints, at = list(recordings).index(block.recording), block.joints, place[every.step[begin:end]]
        kept = (at >= 0) & residuals.where[at.clamp(min=0), r]
        if not bool(kept.any()):
            continue
        at, rows = at[kept], kept[:, None].expand(-1, len(joints)).flatten()
        scale = (residuals.weight[at, r][:, joints] * phases.floor[block.recording, joints]).flatten()
        entries = [entry for entry in row if set(joints) & set(colouring.joints[entry])]
        own = jacobian.columns[[row[entry] for entry in entries]][:, at, r][..., joints].flatten(1) * scale
        error = residuals.error[0, at, r][:, joints].flatten() / scale.clamp(min=1e-300)
        spread = expected[rows][:, rows]
        larger = max(1.0, float(error.square().sum() / spread.diagonal().sum()))
        total[np.ix_(entries, entries)] += larger * (own @ spread @ own.T).numpy()
    return total
