"""A fit that leaves out where the model is far worse than elsewhere: least trimmed squares.

A joint that rattles in a gap or sticks and slips may, with a nearly right model, go on oscillating in one window where
the robot does not. That window's error then outweighs all others and says nothing of where the truth lies. The
windows that fit best do, and the others follow once the model is right.

Source: Rousseeuw 1984, least median of squares regression (and concentration steps).
"""

from __future__ import annotations

import torch

from pace_optim.diagnosis.fitting.coarse_to_fine import fit_over_wide_steps
from pace_optim.diagnosis.fitting.side_by_side import SideBySide, Slot
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.single_joint_model.problem import TwinProblem

_OUTLIER = 3.0
"""A window is left out whose RMSE is this many times the median."""
_TIMES = 3
"""At most: with a better model others are left out."""
_GAIN = 0.8
"""It goes on where the median has come down to less than this part."""


def fit_trimmed(problem: TwinProblem, now: Fitted, joints: torch.Tensor) -> Fitted | None:
    """A model fitted where it is not far worse than elsewhere; ``None`` where it is about as good in all windows.

    Args:
        problem: The joints simulated alone.
        now: The model.
        joints: Which of them are fitted so, (n,) bool; for the others all windows count.
    """
    result, best = None, torch.full_like(now.score, torch.inf)
    for _ in range(_TIMES):
        rmse = _rmse(problem.in_windows(), now)
        median = rmse.median(dim=0).values
        kept = (rmse <= _OUTLIER * median) | ~joints
        if bool(kept.all()) or not bool(((median < _GAIN * best) & joints).any()):
            break
        best = median
        result = now = fit_over_wide_steps(problem, now, kept)
    return result


def _rmse(windows: TwinProblem, now: Fitted) -> torch.Tensor:
    """Of each window and joint, (R, n) [rad]."""
    batch = SideBySide(windows, [Slot(model=now.model, rows=1)], training=True)
    where = batch.dataset.train
    error = batch.simulate([now.model.to_physical(now.x)[None]], where)[0]
    return (error.double().square().sum(dim=0) / where.sum(dim=0).clamp(min=1)[:, None]).sqrt()
