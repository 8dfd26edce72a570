"""The drive in force while recording: what the recording states, else the robot; and the torque it was asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pace_actuators import match_names, resolve_joint_values
from pace_actuators.identified import DRIVE_FIELDS
from pace_envs import ManagerBasedEnv, ManagerBasedEnvCfg
from pace_optim.recording import Drive, Recording
from pace_optim.recording.commands import acting_loops

_SMOOTH = 0.02
"""Positions are averaged over this time before they are differentiated [s]."""


def of_joints(env: ManagerBasedEnv, name: str, only_implicit: bool = False) -> np.ndarray:
    """A drive's values per joint, (n,); ``_run_dt``: time between two runs of a loop that holds its torque [s]."""
    robot = env.scene["robot"]
    result = np.zeros(robot.num_joints)
    for drive in robot.actuators.values():
        ids = drive.joint_indices
        where = ids if isinstance(ids, slice) else np.asarray(ids)
        if name == "_run_dt":
            result[where] = 0.0 if drive.cfg.implicit else drive.run_dt
        elif drive.cfg.implicit or not only_implicit:
            result[where] = getattr(drive, name)[0].cpu().numpy()
    return result


def configured_drive(cfg: ManagerBasedEnvCfg, joints: Sequence[str]) -> dict[str, np.ndarray]:
    """Gains and limits as a configuration has them, by field, (n,) each; NaN where it says nothing."""
    found = {name: np.full(len(joints), np.nan) for name in DRIVE_FIELDS}
    for drive in cfg.scene.robot.actuators.values():
        at = [i for group in match_names(drive.joint_names_expr, joints) for i in group]
        for name, values in found.items():
            if (value := getattr(drive, name)) is not None:
                values[at] = resolve_joint_values(value, [joints[i] for i in at], field=name).numpy()
    return found


def in_force(configured: Mapping[str, np.ndarray], recording: Recording) -> Drive:
    """What the recording states, else what is configured: all five fields, (n,) each."""
    stated = {name: getattr(recording.drive, name) for name in DRIVE_FIELDS}
    return Drive(
        **{
            name: configured[name] if own is None else np.broadcast_to(np.asarray(own, float), configured[name].shape)
            for name, own in stated.items()
        }
    )


def drive_in(env: ManagerBasedEnv, recording: Recording) -> Drive:
    """The drive in force, of an environment that has been built."""
    return in_force({name: of_joints(env, name) for name in DRIVE_FIELDS}, recording)


def gains(drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness [N m/rad] and damping [N m s/rad] of a drive in force, (n,) each; 0 where nothing says it."""
    stiffness, damping = (np.asarray(each) for each in (drive.stiffness, drive.damping))
    return np.where(np.isfinite(stiffness), stiffness, 0.0), np.where(np.isfinite(damping), damping, 0.0)


def acting_gains(drive: Drive, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """The same of the loops that act: without a target, a position loop does not."""
    kp, kd = gains(drive)
    on_position, on_speed = acting_loops(recording, kp)
    return np.where(on_position, kp, 0.0), np.where(on_speed, kd, 0.0)


def asked_torque(
    drive: Drive, recording: Recording, speed: np.ndarray | None = None, *, clip: bool = True
) -> np.ndarray:
    """What the drives were asked for, without the delay, (T, n) [N m].

        τ = kp (q* − q) + kd (q̇* − q̇) + τ_ff

    Args:
        drive: In force (:func:`in_force`).
        recording: On the control grid.
        speed: Measured speeds, (T, n) [rad/s]; ``None``: the slopes of averaged positions.
        clip: Whether it stays within the effort limit.
    """
    kp, kd = acting_gains(drive, recording)
    at = recording.sample_steps
    if speed is None:
        speed = np.gradient(_smooth(recording), recording.time, axis=0)
    asked_speed = 0.0 if recording.command_vel is None else recording.command_vel[at]
    torque = kp * (recording.sampled_command - recording.dof_pos) + kd * (asked_speed - speed)
    torque += 0.0 if recording.command_effort is None else recording.command_effort[at]
    limit = effort_limit(drive)
    return np.clip(torque, -limit, limit) if clip else torque


def effort_limit(drive: Drive) -> np.ndarray:
    """The torque limit of a drive in force, (n,) [N m]; infinite where none is stated."""
    return np.nan_to_num(np.asarray(drive.effort_limit), nan=np.inf, posinf=np.inf)


def _smooth(recording: Recording) -> np.ndarray:
    """Each position averaged with its neighbours on both sides, (T, n)."""
    half = max(1, round(0.5 * _SMOOTH * (recording.num_samples - 1) / recording.duration))
    padded = np.pad(recording.dof_pos, ((half + 1, half), (0, 0)), mode="edge").cumsum(axis=0)
    return (padded[2 * half + 1 :] - padded[: -2 * half - 1]) / (2 * half + 1)
