"""Recordings of a robot whose base moves, brought onto its model: how the model's frame moves, when joints are free."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from pace_actuators.text import listed
from pace_envs import ManagerBasedEnv
from pace_optim.problem.kinematic_trees import independent_trees
from pace_optim.problem.legs_in_the_air import standing_legs
from pace_optim.recording import Recording
from pace_optim.recording.data import ImuPose
from pace_optim.recording.keys import did_you_mean
from pace_optim.recording.moving_base import free_phases, standing_feet


def on_moving_base(recording: Recording, env: ManagerBasedEnv) -> Recording:
    """A conformed recording with its base's motion in the model's axes, and where its joints are free.

    Args:
        recording: On the robot's joints and control grid.
        env: The robot, its base fixed in the model.
    """
    if recording.base_ang_vel is None or recording.base_lin_acc is None:
        return recording
    axes, point = imu_pose(env.sim.model, recording.imu, recording.label)
    at = recording.sample_steps
    steps = np.arange(int(at[-1]) + 1)
    when = at if recording.sample_offset is None else at + recording.sample_offset
    shown = np.concatenate([recording.base_ang_vel @ axes.T, recording.base_lin_acc @ axes.T], axis=1)
    frame = np.stack([np.interp(steps, when, column) for column in shown.T], axis=1)
    legs, names = joints_of_feet(env, recording.feet, recording.label), recording.feet
    standing, how = standing_feet(recording), "a leg counts while its foot is in the air"
    if standing is None and _gains_are_stated(recording, env):
        legs = trees_of(env)
        names = tuple(recording.joint_names[joints[0]] for joints in legs)
        standing = standing_legs(recording, env, legs, shown, point)
        how = "no contact is logged: a leg counts while its drives' torques balance without a force of the ground"
    free = np.ones((len(steps), recording.num_joints), dtype=bool)
    if standing is None:
        said = (
            "nothing says when feet touch the ground: all of the recording counts. A robot that walks needs contact "
            "or foot_force, or gains that are stated."
        )
    elif recording.contact is None and recording.foot_force is None and not standing.any():
        said = (
            "no contact is logged: the drives' torques balance without a force of the ground, so all of the recording "
            "counts."
        )
    else:
        dt = float(np.median(np.diff(recording.time)))
        sample = np.searchsorted(at, steps, side="right") - 1
        for leg, joints in enumerate(legs):
            free[:, joints] &= free_phases(standing[:, leg], dt)[sample][:, None]
        said = f"{how}: {_swings(recording, names, legs, free)}"
    notes = (*recording.notes, f"The base moves as the IMU shows, and {said}")
    return replace(recording, frame=frame, frame_point=point, free=free, notes=notes)


def _gains_are_stated(recording: Recording, env: ManagerBasedEnv) -> bool:
    """Whether the drives' torques are known."""
    return recording.drive.stiffness is not None or not env.cfg.sim2real.assumed_gains  # type: ignore[attr-defined]


def _swings(recording: Recording, names: Sequence[str], legs: Sequence[Sequence[int]], free: np.ndarray) -> str:
    """How often each leg swings, and which joints never do."""
    said = []
    for name, joints in zip(names, legs, strict=True):
        own = free[:, joints[0]]
        phases = int((np.diff(own.astype(int), prepend=0) == 1).sum())
        said.append(f"{name} {100 * own.mean():.0f} % of the time in {phases} swings")
    held = [name for i, name in enumerate(recording.joint_names) if not free[:, i].any()]
    never = (
        f" {listed(held, 6)}: always held by the ground, so nothing of them is identified. Lift that leg, or record it "
        "in the air."
        if held
        else ""
    )
    return f"{listed(said)}.{never}"


def imu_pose(model: mujoco.MjModel, imu: ImuPose, label: str) -> tuple[np.ndarray, np.ndarray]:
    """The IMU's axes as columns in the model's world, (3, 3), and where it is, (3,) [m]."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    if imu.body:
        bodies = [model.body(b).name for b in range(1, model.nbody)]
        if imu.body not in bodies:
            raise ValueError(
                f"{label}: imu.body is {imu.body!r}{did_you_mean(imu.body, bodies)} Bodies: {listed(bodies)}."
            )
        body, turned, axes = model.body(imu.body).id, np.empty(9), data.body(imu.body).xmat.reshape(3, 3)
        mujoco.mju_quat2Mat(turned, np.asarray(imu.quat))
        point, axes = data.body(imu.body).xpos + axes @ np.asarray(imu.pos), axes @ turned.reshape(3, 3)
    else:
        sites = [model.site(s).name for s in range(model.nsite)]
        if imu.site not in sites:
            raise ValueError(
                f"{label}: the model has no site {imu.site!r}, where the IMU is; it has {listed(sites)}. Add a site of "
                'that name to the base, or state the fact imu, such as {"body": "base", "pos": [0.1, 0, 0.02]}.'
            )
        body, site = int(model.site(imu.site).bodyid[0]), data.site(imu.site)
        point, axes = site.xpos.copy(), site.xmat.reshape(3, 3).copy()
    if int(model.body_weldid[body]) != 0:
        raise ValueError(
            f"{label}: the IMU is on {model.body(body).name!r}, which joints move; expected it on the base. Name a "
            "site or body of the base in the fact imu."
        )
    return axes, point


def joints_of_feet(env: ManagerBasedEnv, feet: Sequence[str], label: str) -> list[list[int]]:
    """For each foot, the joints that the ground holds where it stands, by index: all of its kinematic tree.

    Args:
        feet: Bodies, geoms, sites or legs: a leg's name begins those of its joints.
        label: Of the recording, for messages.
    """
    robot, model = env.scene["robot"], env.sim.model
    names, trees, result = list(robot.joint_names), trees_of(env), []
    for foot in feet:
        own = chain_of_foot(model, foot, names)
        if not own:
            known = [model.body(b).name for b in range(1, model.nbody)]
            raise ValueError(
                f"{label}: feet names {foot!r}, which is no body, geom, site or leg of the model"
                f"{did_you_mean(foot, known)} Bodies: {listed(known)}. Correct the name."
            )
        result.append(sorted({j for tree in trees if set(tree) & set(own) for j in tree}))
    return result


def trees_of(env: ManagerBasedEnv) -> list[list[int]]:
    """Joints that move each other, by index."""
    names = list(env.scene["robot"].joint_names)
    return [[names.index(name) for name in tree] for tree in independent_trees(env)]


def chain_of_foot(model: mujoco.MjModel, foot: str, joints: Sequence[str]) -> list[int]:
    """Joints of the leg of a foot, by index; none where the model has no such foot."""
    begins = re.compile(re.escape(foot) + r"(?![A-Za-z0-9])", re.IGNORECASE)
    return _chain(model, foot, joints) or [j for j, name in enumerate(joints) if begins.match(name)]


def _chain(model: mujoco.MjModel, name: str, joints: Sequence[str]) -> list[int]:
    """Joints between the world and a body, geom or site, by index; none where the model has no such thing."""
    body = -1
    for kind, owner in ((mujoco.mjtObj.mjOBJ_BODY, None), (mujoco.mjtObj.mjOBJ_GEOM, model.geom_bodyid),
                        (mujoco.mjtObj.mjOBJ_SITE, model.site_bodyid)):  # fmt: skip
        found = mujoco.mj_name2id(model, kind, name)
        if body < 0 <= found:
            body = found if owner is None else int(owner[found])
    result: list[int] = []
    while body > 0:
        first = int(model.body_jntadr[body])
        own = [model.joint(j).name for j in range(first, first + int(model.body_jntnum[body]))]
        result += [joints.index(joint) for joint in own if joint in joints]
        body = int(model.body_parentid[body])
    return result
