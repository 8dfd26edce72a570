"""What recordings say of their robot's drives: whether stated facts fit, how far a fit seeks, how hard they work."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from numpy.typing import ArrayLike

from pace_actuators.base_parameters import CARRIED
from pace_actuators.joint_units import SLIDE_LENGTH, JointType, units_for
from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv
from pace_envs.from_model.scaling import OF_BOUNDS, largest_parameters
from pace_envs.tasks.pace import PaceSim2realEnvCfg
from pace_envs.tasks.pace.pace_cfg import PaceCfg
from pace_optim.problem.drive_facts import asked_torque, drive_in, effort_limit, gains, of_joints
from pace_optim.recording import Recording
from pace_optim.recording.commands import acting_loops
from pace_optim.recording.dataset import Dataset, Work

_PLACEHOLDER = 10.0
"""Times what a drive was asked for that its effort limit may be at most."""


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
    drive, own = recording.drive, drive_in(env, recording)
    length = np.where(np.isin(sim2real.joint_order, sim2real.slide_joints), SLIDE_LENGTH, 1.0)
    if drive.stiffness is None and drive.damping is None:
        asked, most = np.zeros(len(length)), np.full(len(length), np.inf)
    else:
        asked = np.maximum(0.5 * gains(own)[0] * length, np.abs(asked_torque(own, recording)).max(axis=0))
        most = _PLACEHOLDER * asked
    limit = effort_limit(own)
    known = np.isfinite(limit) & (drive.effort_limit is not None)
    return np.where(np.isfinite(limit), np.where(known, limit, 0.0), asked), np.where(known, np.inf, most)


_STATE = (
    "state them beside the log (NAME.json: stiffness, damping), in its column map, or in your configuration "
    "(pace new-robot)"
)


def without_loops_of_torques(env: ManagerBasedRLEnv, recording: Recording) -> Recording:
    """The recording; a torque that it commands is all that moves a joint, where the gains are only assumed.

    A damping that the recording states stays: it acts on the measured speed.
    """
    drive, names = recording.drive, np.array(recording.joint_names)
    stiffness, damping = gains(drive_in(env, recording))
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


_BIN = 0.25
"""Over so much time the square of a torque is averaged [s]."""
_TIMES_ASKED = 2.0
"""How many times the largest torque that was asked a drive may give that states no limit."""


def drive_reach(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> dict[str, float]:
    """The largest torque of each joint's drive [N m]: its limit, else twice what was asked; infinite: not known."""
    drives = [drive_in(env, recording) for recording in recordings]
    limit = np.max([effort_limit(drive) for drive in drives], axis=0)
    asked = [np.abs(asked_torque(drive, each)).max(axis=0) for drive, each in zip(drives, recordings, strict=True)]
    asked = np.max(asked, axis=0)
    largest = np.where(np.isfinite(limit), limit, np.where(asked > 0, _TIMES_ASKED * asked, math.inf))
    return dict(zip(env.scene["robot"].joint_names, largest.tolist(), strict=True))


def loop_stiffness(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> dict[str, float]:
    """The stiffness of each joint's position loop [N m/rad], the median of the recordings' where it has one."""
    median = np.median([gains(drive_in(env, each))[0] for each in recordings], axis=0)
    names = env.scene["robot"].joint_names
    return {name: each for name, each in zip(names, median.tolist(), strict=True) if each > 0 and math.isfinite(each)}


def with_work(dataset: Dataset, env: ManagerBasedRLEnv) -> Dataset:
    """The dataset with how hard the drives worked, where its recordings are of one session: they do not overlap.

    Args:
        env: The environment, whose facts hold where a recording states none.
    """
    begins, ends, squares = [], [], []
    for start, recording in zip(dataset.session_start.tolist(), dataset.recordings, strict=True):
        since = recording.time - recording.time[0]
        edges = np.linspace(0.0, since[-1], max(1, round(since[-1] / _BIN)) + 1)
        square = np.nan_to_num(asked_torque(drive_in(env, recording), recording)) ** 2
        bins = (np.searchsorted(edges, since, side="right") - 1).clip(max=len(edges) - 2)
        count = np.bincount(bins, minlength=len(edges) - 1).clip(min=1)
        squares.append([np.bincount(bins, column, len(edges) - 1) / count for column in square.T])
        begins.append(start + edges[:-1])
        ends.append(start + edges[1:])
    order = np.argsort([each[0] for each in begins])
    if any(ends[a][-1] > begins[b][0] + _BIN for a, b in itertools.pairwise(order.tolist())):
        return dataset
    begin, end, square = (torch.as_tensor(np.concatenate(each, axis=-1)) for each in (begins, ends, squares))
    return replace(dataset, work=Work(begin=begin, end=end, square=square.T))
