"""How much noise a measured torque has, by what a fit leaves of it."""

from __future__ import annotations

from pace_optim.estimate.error_bars.uncertainty import autocovariance, filtered
from pace_optim.problem.evaluator import Residuals
from pace_optim.recording.dataset import Torques


def torque_noise(residuals: Residuals, torques: Torques) -> list[float]:
    """Standard deviation of the white noise that would hide as much of each joint's torque, (n,) [N m].

    With e what is left of a torque τ, and Σ the covariance of e by its autocovariance, a scale of the torque would have
    the variance τᵀΣτ / (τᵀτ)². White noise of the variance

        σ² = τᵀΣτ / τᵀτ

    leaves it the same. Errors that go on from sample to sample, as a filter makes them, count as the noise of few.

    Args:
        residuals: Of one candidate.
        torques: What is measured.
    """
    error, known = residuals.torque_errors(torques)
    measured, result = torques.measured[residuals.step], []
    for j in range(error.shape[-1]):
        spread = power = 0.0
        for r in range(error.shape[1]):
            at = known[:, r, j]
            if int(at.sum()) > 1:
                torque, left = measured[at, r, j].numpy(), error[at, r, j].numpy()
                spread += float(torque @ filtered(torque[None], autocovariance(left))[0])
                power += float(torque @ torque)
        result.append((max(spread, 0.0) / power) ** 0.5 if power > 0 else 0.0)
    return result
