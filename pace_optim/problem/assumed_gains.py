"""Gains that nobody has stated: where they act, where they cannot, and what to do about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pace_envs import ManagerBasedRLEnv
from pace_optim.problem.drive_steps import of_joints
from pace_optim.recording import Recording
from pace_optim.recording.keys import listed

_STATE = (
    "state them beside the log (NAME.json: stiffness, damping), in its column map, or in a configuration of your own "
    "(pace new-robot)"
)


def without_loops_of_torques(env: ManagerBasedRLEnv, recording: Recording) -> Recording:
    """The recording; a torque that it commands is all that moves a joint, where the gains are only assumed.

    Raises:
        ValueError: If a joint is told nothing but positions, and its drive has no position loop.
    """
    stiffness, names = of_joints(env, "stiffness"), np.array(recording.joint_names)
    if recording.drive.stiffness is not None:
        return recording
    other = recording.has_velocity_command | recording.has_effort_command
    if idle := names[recording.has_position_command & ~other & (stiffness == 0.0)].tolist():
        raise ValueError(
            f"{recording.source}: nothing moves {listed(idle, 3)}: there are position targets (des_dof_pos), but the "
            f"drive has no position loop: its stiffness is 0. If it has one, {_STATE}; else add what moves it "
            "(des_dof_vel, des_dof_effort)."
        )
    torque = recording.has_effort_command & np.isin(names, _assumed(env))
    if not torque.any():
        return recording
    gains = {name: np.where(torque, 0.0, of_joints(env, name)) for name in ("stiffness", "damping")}
    note = (
        f"{listed(names[torque], 3)}: the torque that is commanded is taken to be all that the drive gives, since "
        "nothing states the gains of a position loop beside it."
    )
    return replace(recording, drive=replace(recording.drive, **gains), notes=(*recording.notes, note))


def told_of_gains(env: ManagerBasedRLEnv, recordings: Sequence[Recording], unknown: Sequence[str]) -> list[str]:
    """A sentence on the joints that are simulated with assumed gains; those that are identified are not."""
    if "stiffness" in unknown:
        return []
    names, assumed = np.array(env.cfg.sim2real.joint_order), np.isin(env.cfg.sim2real.joint_order, _assumed(env))  # type: ignore[attr-defined]
    follow = [r.has_position_command | r.has_velocity_command for r in recordings if r.drive.stiffness is None]
    where = assumed & np.any(follow, axis=0) if follow else np.zeros(len(names), dtype=bool)
    if not where.any():
        return []
    kp, kd = (of_joints(env, name)[where][0] for name in ("stiffness", "damping"))
    return [
        f"Nobody has stated the gains of {listed(names[where], 3)}: kp = {kp:.3g}, kd = {kd:.3g} ({names[where][0]}) "
        f"are assumed, and every inertia, friction and torque that is found is in proportion to them. If you know the "
        f"real ones, {_STATE}; else let them be sought: --unknown stiffness damping."
    ]


def _assumed(env: ManagerBasedRLEnv) -> list[str]:
    return list(env.cfg.sim2real.assumed_gains)  # type: ignore[attr-defined]
