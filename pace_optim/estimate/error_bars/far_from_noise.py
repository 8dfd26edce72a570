"""How far above the measurement's noise a fit has ended."""

from __future__ import annotations

from collections.abc import Sequence

from pace_actuators.joint_units import JointType, units_for
from pace_optim.problem.problem import Problem
from pace_optim.recording.noise import noise_variance
from pace_optim.terminal.cli import command

FAR_ABOVE_NOISE = 10.0
"""Above this multiple of the noise the residual is not noise, and the error bars mean nothing."""


def times_noise(problem: Problem, rmse: float | None) -> float | None:
    """An RMSE of all joints [rad] as a multiple of the recordings' noise; ``None`` without noise.

    Args:
        rmse: Of all joints [rad].
    """
    noise = (_of_positions(problem) / len(problem.joint_names)) ** 0.5
    return rmse / noise if rmse and noise > 0 else None


def noise_score(problem: Problem) -> float:
    """The score that the noise of what is trained on leaves, Σ_joints of its mean variance [rad²].

    Where torques are followed, it is the mean over their samples and the positions'.
    """
    positions, torques = _of_positions(problem), problem.dataset.torques
    if torques is None:
        return positions
    count = int(problem.dataset.train.sum())
    known = torques.known & problem.dataset.train[..., None]
    of_torques = float((known * (torques.weight * torques.floor).square()).sum())
    return (positions * count + of_torques) / (count + int(known.any(dim=2).sum()))


def _of_positions(problem: Problem) -> float:
    """Σ_joints of the mean variance of the positions' noise [rad²]."""
    trained = [problem.dataset.recordings[r] for r in problem.dataset.trained()]
    return noise_variance(trained) * len(problem.joint_names)


def far_end(times: float | None, rmse: float, optimizer: str, joint_types: Sequence[JointType] = ()) -> list[str]:
    """A warning with a cure if a fit ended far above the noise, else nothing.

    Args:
        times: Its error as a multiple of the noise.
        rmse: Its error [rad].
        joint_types: Whether each joint turns or slides; none: all turn.
    """
    if times is None or times < FAR_ABOVE_NOISE:
        return []
    search = (
        "" if optimizer != "least_squares" else f" {command('fit')} --optimizer hybrid searches for another valley."
    )
    unit = units_for("mrad", joint_types)
    return [
        f"The error of {1e3 * rmse:.3g} {unit} is {times:,.0f} times the measurement noise: the values make up for "
        f"something else, and error bars mean nothing. First check gains, torque limits and loads.{search} [W1]"
    ]
