"""How good a motion is: one number from the error bars that it would give."""

from __future__ import annotations

import numpy as np
import torch

from pace_optim.estimate.derivatives import colour
from pace_optim.estimate.error_bars.uncertainty import Uncertainty, uncertainty_of
from pace_optim.problem.problem import Problem

_UNIFORM = 12.0 / 2.0**2
"""Precision of what is known before: anywhere within the bounds, [-1, 1]."""


def mean_log_error(hessian: np.ndarray, middle: np.ndarray, noise: float, free: np.ndarray) -> float:
    """The criterion: mean over the parameters of log(standard deviation / bound range).

        C = A⁻¹ (M/σ² + P) A⁻¹,   A = H/σ² + P,   criterion = mean_i log(√C_ii / 2)

    in normalised parameters, whose range is 2. P is the precision of a uniform distribution over the bounds (12/range²
    each): it keeps C finite where a motion says nothing. The exponential of the criterion is the geometric mean of the
    error bars as shares of the ranges. Such a mean does not depend on units, as the determinant of D-optimality does
    not, and weighs every parameter's own error bar, as A-optimality does (Atkinson, Donev and Tobias, Optimum
    Experimental Designs, 2007, ch. 10; with a prior: Chaloner and Verdinelli, Statistical Science 10, 1995).

    Args:
        hessian: H, (size, size) [rad²].
        middle: M, (size, size) [rad²].
        noise: σ [rad].
        free: Entries that can vary, (size,) bool.
    """
    at = np.ix_(free, free)
    prior = _UNIFORM * np.eye(int(free.sum()))
    inverse = np.linalg.inv(hessian[at] / noise**2 + prior)
    variance = np.einsum("ij,jk,ki->i", inverse, middle[at] / noise**2 + prior, inverse, optimize=True)
    return float(np.mean(np.log(np.sqrt(variance) / 2)))


def expected_uncertainty(
    problem: Problem, hessian: np.ndarray, middle: np.ndarray, noise: float, x: torch.Tensor
) -> Uncertainty:
    """The error bars that a fit would state.

    Args:
        problem: The robot, with one recording.
        hessian: H, (size, size) [rad²].
        middle: M, (size, size) [rad²].
        noise: σ, standard deviation of the encoder's white noise [rad].
        x: Where the parameters are expected to be, normalised (size,).
    """
    samples = int(problem.dataset.sampled.sum())
    colouring = colour(problem.space, problem.trees, problem.joint_names)
    return uncertainty_of(hessian, noise**2 * middle, samples, colouring, problem.space, x)
