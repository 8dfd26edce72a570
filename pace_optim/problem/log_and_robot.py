"""Whether recordings fit what is stated of their robot: limits, gains that are only assumed, closed chains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from numpy.typing import ArrayLike

from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv
from pace_envs.tasks.pace import PaceSim2realEnvCfg
from pace_optim.problem.drive_steps import of_joints
from pace_optim.recording import Recording
from pace_optim.recording.commands import acting_loops

_STATE = (
    "state them beside the log (NAME.json: stiffness, damping), in its column map, or in your configuration "
    "(pace new-robot)"
)


def without_loops_of_torques(env: ManagerBasedRLEnv, recording: Recording) -> Recording:
    """The recording; a torque that it commands is all that moves a joint, where the gains are only assumed.

    A damping that the recording states stays: it acts on the measured speed.
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
            f"{listed(names[alone], 3)}: nothing states gains of a position loop beside the commanded torque. It is "
            f"taken as all that the drive gives{'' if drive.damping is None else ', less its damping'}. No loop "
            "corrects the simulation, so errors of this torque add up along the recording."
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
        f"The gains of {listed(names[where], 3)} are not stated: kp = {kp:.3g}, kd = {kd:.3g} ({names[where][0]}) are "
        f"assumed. Every inertia, friction and torque of the fit is proportional to them. If you know the real gains, "
        f"{_STATE}; otherwise identify them: --unknown stiffness damping. [W5]"
    ]


def _assumed(env: ManagerBasedRLEnv) -> list[str]:
    return list(env.cfg.sim2real.assumed_gains)  # type: ignore[attr-defined]


_CLOSED = 1e-4
"""A loop that is open by less starts closed enough [m or rad]: its constraints are as soft as that."""


def refuse_open_loops(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> None:
    """Refuse recordings in whose first posture a loop cannot be closed by any encoder bias within its bounds.

    Args:
        env: The environment; its first simulation takes each posture.
        recordings: On the robot's joints, in its order.
    """
    robot = env.scene["robot"]
    loops = robot.closed_loops
    if loops is None:
        return
    cfg = cast(PaceSim2realEnvCfg, env.cfg).sim2real
    n = robot.num_joints
    slack = np.full(env.sim.model.nv, np.inf)
    slack[robot.dof_columns.numpy()] = cfg.bounds["encoder_bias"].abs().max(dim=1).values.numpy()
    for recording in recordings:
        robot.write_joint_state_to_sim(torch.as_tensor(recording.dof_pos[0])[None], torch.zeros(1, n))
        posture = env.sim.qpos[0].numpy()
        gap, name = loops.gap(posture)
        if gap > _CLOSED and not loops.closable(posture, slack):
            raise ValueError(
                f"{recording.name}: where it begins, the closed chain ({name}) is open by {gap:.3g} (m or rad), "
                "and no encoder bias within its bounds closes it. Check the joints' zeros, signs and units. Or state "
                "the assembly as init_state.joint_pos of the passive joints, or in a keyframe of the model file."
            )
    env.scene.reset()


_BEYOND = 1.1
"""Times the stated limit: below, noise and a load that drives the motor may be the reason."""
_SPAN = 0.02
"""Time over which a speed is taken from positions [s]."""


def contradicted_limits(
    recording: Recording, velocity_limit: ArrayLike, effort_limit: ArrayLike, joint_types: Sequence[JointType] = ()
) -> list[str]:
    """Measured speeds and torques beyond what is stated, in words.

    Args:
        recording: The recording; its own facts come before what is configured.
        velocity_limit: No-load speed as configured, (n,) [rad/s]; NaN or infinite without a limit.
        effort_limit: Torque limit as configured, (n,) [N m]; NaN or infinite without a limit.
        joint_types: Whether each joint turns or slides; none: all turn.
    """
    n = recording.num_joints
    span = max(1, round(_SPAN / float(np.median(np.diff(recording.time)))))
    moved = recording.dof_pos[span:] - recording.dof_pos[:-span]
    speed = np.abs(moved / (recording.time[span:] - recording.time[:-span])[:, None])
    found = [("velocity_limit", "no-load speed", "rad/s", speed, recording.drive.velocity_limit, velocity_limit)]
    if recording.dof_effort is not None:
        torque = np.abs(recording.dof_effort)
        found.append(("effort_limit", "torque limit", "N m", torque, recording.drive.effort_limit, effort_limit))
    notes = []
    for field, words, unit, measured, own, configured in found:
        stated = np.broadcast_to(np.asarray(configured if own is None else own, dtype=float), (n,))
        beyond = []
        for j, name in enumerate(recording.joint_names):
            values = measured[np.isfinite(measured[:, j]), j]
            largest = float(np.quantile(values, 0.999)) if values.size else 0.0
            if np.isfinite(stated[j]) and largest > _BEYOND * stated[j]:
                own_unit = units_for(unit, joint_types[j : j + 1])
                beyond.append(f"{name} reaches {largest:.3g} {own_unit}, {field} is {stated[j]:.3g} {own_unit}")
        if beyond:
            notes.append(f"the recording contradicts the stated {words}: {'; '.join(beyond)}. Correct {field}. [W2]")
    return notes
