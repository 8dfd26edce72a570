"""Box-constrained Levenberg–Marquardt: where dampings lead, which row is taken, and what the damping is next.

A whole robot's fit (``least_squares``) is one problem, that of single joints (``pace_optim/joints/fits``) one for
each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

FIRST_DAMPING = 1e-3
"""Relative to the diagonal of JᵀJ."""
DAMPING_TRIALS = (1.0, 30.0, 1e3, 1e5)
"""Multiples of the damping that are tried side by side; the next damping is a tenth of the one that was best."""
_REFUSED = 1e3
"""The next damping's multiple where none was better."""
_SMALLEST_DAMPING = 1e-9
NO_INFLUENCE = 1e-12
"""Part of the largest diagonal entry of H below which an entry has no influence: rounding is all that is known."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The score where residuals are linear, s(x + d) = s(x) + 2 gᵀd + dᵀHd."""

    hessian: torch.Tensor
    """H = JᵀJ over the number of samples, (size, size)."""
    gradient: torch.Tensor
    """g = Jᵀr over the same, (size,)."""

    def step(self, x: torch.Tensor, damping: float) -> torch.Tensor:
        """Where a damping leads from x (size,), inside the box."""
        return bounded_step(x, self.hessian, self.gradient, damping) if len(x) else x

    def trials(self, x: torch.Tensor, damping: float, trials: Sequence[float] = DAMPING_TRIALS) -> torch.Tensor:
        """Where multiples of a damping lead from x, the favoured first, (trials, size)."""
        return torch.stack([self.step(x, damping * factor) for factor in trials])

    def expected_gain(self, move: torch.Tensor) -> float:
        """How much lower the score is after a move (size,), -(2 gᵀd + dᵀHd)."""
        return -float(2 * self.gradient @ move + move @ self.hessian @ move)


def next_damping(damping: float, best: int | None) -> float:
    """The damping after a step; ``best`` is the trial that was taken, ``None``: none was better."""
    return damping * _REFUSED if best is None else max(_SMALLEST_DAMPING, damping * DAMPING_TRIALS[best] / 10.0)


def bounded_step(x: torch.Tensor, hessian: torch.Tensor, gradient: torch.Tensor, damping: float) -> torch.Tensor:
    """The damped Gauss–Newton step inside the box [-1, 1].

        min_d  ½ dᵀ (H + μ diag H) d + gᵀ d   with  -1 ≤ x + d ≤ 1

    solved with MuJoCo's box-constrained quadratic program, so that entries at their bounds leave the active set.
    Entries without influence stay.

    Args:
        hessian: JᵀJ, (size, size).
        gradient: Jᵀr, (size,).

    Returns:
        The new vector x + d, (size,).
    """
    # scaled to a unit diagonal: entries of very different influence then weigh the same
    diagonal = hessian.diagonal()
    least = NO_INFLUENCE * float(diagonal.max()) + 1e-300
    unit = diagonal.clamp(min=least).rsqrt()
    scale = torch.where(diagonal > least, unit, 0.0)
    n = len(x)
    matrix = (hessian * scale[:, None] * scale[None, :]).numpy() + (damping + 1e-12) * np.eye(n)
    slope = gradient * scale
    size = max(float(slope.norm()), 1e-300)  # of the problem; the solver's tolerances are absolute
    lower = ((-1 - x) / unit / size).clamp(max=0.0).numpy()
    upper = ((1 - x) / unit / size).clamp(min=0.0).numpy()
    result, factor = np.zeros(n), np.zeros((n, n + 7))
    free = mujoco.mju_boxQP(result, factor, None, np.ascontiguousarray(matrix), (slope / size).numpy(), lower, upper)
    if free < 0:
        return x.clone()
    return (x + torch.as_tensor(result) * (size * scale)).clamp(-1.0, 1.0)
