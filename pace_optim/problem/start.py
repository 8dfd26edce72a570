"""Where a fit of a model file begins: what the torques that the log's drives asked for leave possible."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pace_envs import ManagerBasedRLEnv
from pace_optim.problem.drive_steps import of_joints
from pace_optim.recording import Recording

_SHARE = 0.1
"""Of the torque, that each of armature, viscous and Coulomb friction takes at the start."""
_SMOOTH = 0.02
"""Positions are averaged over this time before they are differentiated [s]."""


def start_by_torques(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> dict[str, dict[str, float]]:
    """Where no parameter takes more than a tenth of the torque that its joint's drive asked for.

    With the root mean squares T of τ = kp (q* - q) + kd (q̇* - q̇) + τ*, V of q̇ and A of q̈ over the recordings:

        armature ≤ 0.1 T / A,     viscous friction ≤ 0.1 T / V,     Coulomb friction ≤ 0.1 T

    and no more than the configuration's own start. A model file's is a part of the effort limits, which are
    placeholders in many: with 1000 N m, armatures of 2e-4 kg m² begin at 4, and the fit ends in a wrong valley.

    Args:
        env: The environment, for that start, and the gains that a recording does not state.
        recordings: On the robot's joints, in its order.

    Returns:
        {parameter: {joint: value}}.
    """
    squares = np.array([_mean_squares(env, recording) for recording in recordings])
    weights = [recording.num_samples for recording in recordings]
    torque, speed, acceleration = np.sqrt(np.average(squares, axis=0, weights=weights))
    with np.errstate(divide="ignore", invalid="ignore"):
        most = {
            "armature": _SHARE * torque / acceleration,
            "viscous_friction": _SHARE * torque / speed,
            "friction": _SHARE * torque,
        }
    sim2real = env.cfg.sim2real  # type: ignore[attr-defined]
    return {
        group: {
            joint: float(np.fmin(sim2real.start_params[group][joint], value))
            for joint, value in zip(sim2real.joint_order, values, strict=True)
        }
        for group, values in most.items()
    }


def _mean_squares(env: ManagerBasedRLEnv, recording: Recording) -> np.ndarray:
    """Mean squares of torque, speed and acceleration about their means, (3, n), without the ends."""
    time, half = recording.time, max(1, round(0.5 * _SMOOTH * (recording.num_samples - 1) / recording.duration))
    speed = np.gradient(_smooth(recording.dof_pos, half), time, axis=0)
    kp, kd = (
        of_joints(env, name) if getattr(recording.drive, name) is None else getattr(recording.drive, name)
        for name in ("stiffness", "damping")
    )
    steps = recording.sample_steps
    asked_speed = 0.0 if recording.command_vel is None else recording.command_vel[steps]
    torque = kp * (recording.sampled_command - recording.dof_pos) + kd * (asked_speed - speed)
    torque += 0.0 if recording.command_effort is None else recording.command_effort[steps]
    limit = of_joints(env, "effort_limit")
    torque = np.clip(torque, -limit, limit)
    inner = slice(half + 2, -half - 2)
    return np.array([np.var(each[inner], axis=0) for each in (torque, speed, np.gradient(speed, time, axis=0))])


def _smooth(position: np.ndarray, half: int) -> np.ndarray:
    """Each position averaged with its neighbours on both sides, (T, n)."""
    padded = np.pad(position, ((half + 1, half), (0, 0)), mode="edge").cumsum(axis=0)
    return (padded[2 * half + 1 :] - padded[: -2 * half - 1]) / (2 * half + 1)
