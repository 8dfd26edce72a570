"""Gains that nobody has stated: where they act, where they cannot, and what to do about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv
from pace_optim.problem.drive_steps import of_joints
from pace_optim.recording import Recording
from pace_optim.recording.commands import acting_loops

_STATE = (
    "state them beside the log (NAME.json: stiffness, damping), in its column map, or in a configuration of your own "
    "(pace new-robot)"
)


def without_loops_of_torques(env: ManagerBasedRLEnv, recording: Recording) -> Recording:
    """The recording; a torque that it commands is all that moves a joint, where the gains are only assumed.

    A damping that the recording states stays: it acts on the measured speed.

    Raises:
        ValueError: If a joint is told nothing but positions, and its drive has no position loop.
    """
    drive, names = recording.drive, np.array(recording.joint_names)
    stiffness, damping = (
        of_joints(env, name) if (own := getattr(drive, name)) is None else own for name in ("stiffness", "damping")
    )
    other = recording.has_velocity_command | recording.has_effort_command
    idle = names[recording.has_position_command & ~other & (stiffness == 0.0)].tolist()
    if idle and drive.stiffness is None:
        raise ValueError(
            f"{recording.source}: nothing moves {listed(idle, 3)}: there are position targets (des_dof_pos), but the "
            f"drive has no position loop: its stiffness is 0. If it has one, {_STATE}; else add what moves it "
            "(des_dof_vel, des_dof_effort)."
        )
    alone = recording.has_effort_command & np.isin(names, _assumed(env)) & (drive.stiffness is None)
    stiffness = np.where(alone, 0.0, stiffness)
    damping = np.where(alone & (drive.damping is None), 0.0, damping)
    notes = []
    if alone.any():
        notes.append(
            f"{listed(names[alone], 3)}: the torque that is commanded is taken to be all that the drive gives"
            f"{'' if drive.damping is None else ', less its damping'}, since nothing states the gains of a position "
            "loop beside it."
        )
        drive = replace(drive, stiffness=stiffness, damping=damping)
    _, on_speed = acting_loops(recording, stiffness)
    told = recording.has_position_command | recording.has_velocity_command
    if (braked := names[on_speed & ~told & (damping > 0.0)]).size:
        notes.append(f"{listed(braked, 3)}: the drive's damping acts on the measured speed; no speed is commanded.")
    return replace(recording, drive=drive, notes=(*recording.notes, *notes)) if notes else recording


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
