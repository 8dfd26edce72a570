"""How far a fit of a model file seeks, by the torques of the log's drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pace_actuators.base_parameters import CARRIED
from pace_envs import ManagerBasedEnv, ManagerBasedRLEnv
from pace_envs.from_model import defaults
from pace_envs.from_model.scaling import OF_BOUNDS, largest_parameters
from pace_envs.tasks.pace.pace_cfg import PaceCfg
from pace_optim.problem.drive_steps import of_joints
from pace_optim.recording import Recording

_PLACEHOLDER = 10.0
"""Times what a drive was asked for that its effort limit may be at most."""
_SMOOTH = 0.02
"""Positions are averaged over this time before they are differentiated [s]."""


def widen_bounds(sim2real: PaceCfg, env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> None:
    """Seek as far as the drives allow that the recordings state; a start moves with its bound.

    A model file's bounds are parts of its effort limits. Where it has none, they come from its inertia and gravity: of
    a light link with a strong drive they exclude what is there. A drive's scale then is the limit that a recording
    states; without one, what its gains ask for at an error of half a radian, and what they did ask for. An effort limit
    of ten times that is a placeholder: in a box of a million times a wrist's armature no derivative is right.

    Args:
        sim2real: The bounds and starts; changed.
        env: The environment, for the limits and gains that a recording does not state.
        recordings: On the robot's joints, in its order.
    """
    upper = {name: sim2real.bounds[name][:, 1].clone() for name in CARRIED}
    least, most = np.max([_scales(env, sim2real, recording) for recording in recordings], axis=0)
    speed = np.nan_to_num(of_joints(env, "velocity_limit"), nan=np.inf)
    for j, joint in enumerate(sim2real.joint_order):
        low, high = (
            largest_parameters(float(effort[j]), float(speed[j]), is_slide=joint in sim2real.slide_joints)
            for effort in (least, most)
        )
        for name in CARRIED:
            reach = min(max(float(upper[name][j]), low[name]), high[name])
            if reach != float(upper[name][j]):
                upper[name][j] = reach
                starts = sim2real.start_params[name] | {joint: OF_BOUNDS * reach}  # type: ignore[operator]
                sim2real.start_params = {**sim2real.start_params, name: starts}
    for name, high in upper.items():
        sim2real.set_bounds(name, upper=high)


def _scales(env: ManagerBasedRLEnv, sim2real: PaceCfg, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Least and most that a recording says of each drive's largest torque, (n,) each [N m]; 0 and infinity: nothing."""
    drive, configured = recording.drive, of_joints(env, "effort_limit")
    length = np.where(np.isin(sim2real.joint_order, sim2real.slide_joints), defaults.SLIDE_LENGTH, 1.0)
    if drive.stiffness is None and drive.damping is None:
        asked, most = np.zeros(len(length)), np.full(len(length), np.inf)
    else:
        kp = of_joints(env, "stiffness") if drive.stiffness is None else drive.stiffness
        asked = np.maximum(0.5 * kp * length, np.abs(asked_torque(env, recording)).max(axis=0))
        most = _PLACEHOLDER * asked
    limit = configured if drive.effort_limit is None else drive.effort_limit
    known = np.isfinite(limit) & (drive.effort_limit is not None)
    return np.where(np.isfinite(limit), np.where(known, limit, 0.0), asked), np.where(known, np.inf, most)


def _half(recording: Recording) -> int:
    """Samples on each side that a position is averaged with."""
    return max(1, round(0.5 * _SMOOTH * (recording.num_samples - 1) / recording.duration))


def asked_torque(env: ManagerBasedEnv, recording: Recording) -> np.ndarray:
    """What the drives were asked for, within the configured limits, (T, n) [N m]."""
    speed = np.gradient(_smooth(recording.dof_pos, _half(recording)), recording.time, axis=0)
    kp, kd = gains(env, recording)
    steps = recording.sample_steps
    asked_speed = 0.0 if recording.command_vel is None else recording.command_vel[steps]
    torque = kp * (recording.sampled_command - recording.dof_pos) + kd * (asked_speed - speed)
    torque += 0.0 if recording.command_effort is None else recording.command_effort[steps]
    limit = of_joints(env, "effort_limit")
    return np.clip(torque, -limit, limit)


def gains(env: ManagerBasedEnv, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness [N m/rad] and damping [N m s/rad] of the drives' loops, (n,) each."""
    kp, kd = (
        of_joints(env, name) if getattr(recording.drive, name) is None else getattr(recording.drive, name)
        for name in ("stiffness", "damping")
    )
    return kp, kd


def _smooth(position: np.ndarray, half: int) -> np.ndarray:
    """Each position averaged with its neighbours on both sides, (T, n)."""
    padded = np.pad(position, ((half + 1, half), (0, 0)), mode="edge").cumsum(axis=0)
    return (padded[2 * half + 1 :] - padded[: -2 * half - 1]) / (2 * half + 1)
