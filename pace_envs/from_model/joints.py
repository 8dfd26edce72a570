"""What a model says of each driven joint: inertia, gravity, friction, range, home."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from pace_actuators.joint_units import SLIDE_LENGTH
from pace_envs.closed_loops import ClosedLoops
from pace_envs.from_model import defaults
from pace_envs.from_model.actuators import FileDrive, Kind
from pace_envs.motor_coordinates import DrivenJoints, joint_ranges, single_joints


@dataclass(frozen=True, kw_only=True)
class JointFacts:
    """A driven joint; of a slide, lengths [m] stand for angles and forces [N] for torques."""

    name: str
    """Its name; of a motor that moves several joints, its tendon's."""
    joints: tuple[str, ...]
    """The joints that its drive moves."""
    is_slide: bool
    """Whether it slides."""
    inertia: float
    """Inertia of what it moves at the home posture, without its rotor [kg m^2]."""
    gravity: float
    """Size of gravity's torque at the home posture [N m]."""
    armature: float
    """The file's rotor inertia [kg m^2]; 0 where it has none."""
    viscous_friction: float
    """The file's damping [N m s/rad]."""
    friction: float
    """The file's Coulomb friction [N m]."""
    range: tuple[float, float]
    """Lower and upper limit [rad]; infinite where it has none."""
    home: float
    """Position at the home posture [rad]."""
    drive: FileDrive | None
    """Its drive in the file; ``None`` where the file has no gains for it."""
    command: Kind
    """What its drive is commanded by."""
    velocity_limit: float
    """Largest speed [rad/s]; infinite where the file has none."""
    effort_limit: float
    """Largest torque of its drive [N m]; infinite where the file has none."""
    effort: float
    """The same, or what it needs at least where the file has none. It is the scale of all that is in torques [N m]."""


_KINDS: dict[str, Kind] = {"velocity": "velocity", "effort": "effort"}


def joint_facts(
    model: mujoco.MjModel,
    home: np.ndarray,
    names: Sequence[str],
    drives: Mapping[str, FileDrive],
    velocity_limits: Mapping[str, float],
    command: Mapping[str, str],
) -> list[JointFacts]:
    """Read the facts of some joints.

    Args:
        home: Its home posture, (nq,).
        velocity_limits: Largest speeds by joint, where known.
        command: What joints without a drive in the file are commanded by, where known.
    """
    driven = DrivenJoints.of_model(model, names)
    places = [model.joint(joint) for joint in driven.joints]
    dofs, turn = [int(place.dofadr[0]) for place in places], driven.inverse
    own = copy.copy(model)  # without what drives leave to the simulation
    driven.clear(own)
    data, loops = mujoco.MjData(own), ClosedLoops.of_model(own, dofs)
    data.qpos[:] = posture = home if loops is None else loops.close(home)
    follow = (np.eye(model.nv) if loops is None else loops.following(posture))[:, dofs]  # a drive carries what follows
    mujoco.mj_forward(own, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(own, data, mass)
    inertia = np.diag(turn.T @ follow.T @ mass @ follow @ turn)
    gravity = driven.efforts_of_motors((data.qfrc_bias - data.qfrc_gravcomp) @ follow)
    limits = driven.range_within(joint_ranges(model, driven.joints), home[[int(place.qposadr[0]) for place in places]])
    at_home = driven.to_motors(home[[int(place.qposadr[0]) for place in places]])
    result = []
    for i, (name, place) in enumerate(zip(names, places, strict=True)):
        drive = drives.get(name)
        is_joint = name == place.name
        effort = drive.effort_limit if drive else _joint_effort_limit(model, place.id) if is_joint else np.inf
        carrier, at = ("dof", dofs[i]) if is_joint else ("tendon", model.tendon(name).id)
        armature, viscous, friction = (
            float(getattr(model, f"{carrier}_{field}")[at]) for field in ("armature", "damping", "frictionloss")
        )
        slides = [int(model.joint(joint).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE for joint in driven.joints_of(name)]
        result.append(
            JointFacts(
                name=name,
                joints=driven.joints_of(name),
                is_slide=all(slides),
                inertia=max(float(inertia[i]), 0.0),
                gravity=abs(float(gravity[i])),
                armature=armature,
                viscous_friction=viscous,
                friction=friction,
                range=(float(limits[i, 0]), float(limits[i, 1])),
                home=float(at_home[i]),
                drive=drive,
                command=drive.kind if drive else _KINDS.get(command.get(name, ""), "position"),
                velocity_limit=velocity_limits.get(name, np.inf),
                effort_limit=effort if effort > 0 else np.inf,
                effort=0.0,
            )
        )
    return _with_efforts(result)


def _with_efforts(joints: Sequence[JointFacts]) -> list[JointFacts]:
    """Give each joint a scale of its torque: its limit, or what it needs and no less than a part of the strongest."""
    least = [joint.effort_limit if np.isfinite(joint.effort_limit) else _least_effort(joint) for joint in joints]
    floor = defaults.SMALLEST_SHARE * max(least)
    return [
        replace(joint, effort=effort if np.isfinite(joint.effort_limit) else max(effort, floor))
        for joint, effort in zip(joints, least, strict=True)
    ]


def _least_effort(joint: JointFacts) -> float:
    """What holds the joint against gravity three times, swings it, and breaks it loose [N m]."""
    length = SLIDE_LENGTH if joint.is_slide else 1.0
    stiffness = 0.0 if joint.drive is None else joint.drive.stiffness
    swing = (2 * np.pi * defaults.NATURAL_FREQUENCY) ** 2 * defaults.LARGEST_AMPLITUDE * length
    needed = 3.0 * joint.gravity + swing * (joint.inertia + joint.armature)
    return float(max(needed, 0.5 * stiffness * length, 2.0 * joint.friction, 1e-3))


def _joint_effort_limit(model: mujoco.MjModel, j: int) -> float:
    return float(np.abs(model.jnt_actfrcrange[j]).max()) if model.jnt_actfrclimited[j] else np.inf


HOME_NAMES = ("home", "stand", "standing", "init", "initial", "rest")
"""Names of keyframes that are taken for the home posture, in this order; else the first one is."""


def home_posture(model: mujoco.MjModel) -> tuple[np.ndarray, str]:
    """The home posture (nq,) and where it comes from: a keyframe's name, or nothing.

    Without a keyframe it is the model's own zero posture; joints whose range does not hold it are in its middle.
    """
    names = [model.key(k).name for k in range(model.nkey)]
    for wanted in HOME_NAMES:
        for k, name in enumerate(names):
            if name.lower() == wanted:
                return model.key_qpos[k].copy(), name
    if names:
        return model.key_qpos[0].copy(), names[0] or "the first keyframe"
    home = model.qpos0.copy()
    for j in single_joints(model):
        low, high = model.jnt_range[j]
        if model.jnt_limited[j] and not low < home[model.jnt_qposadr[j]] < high:
            home[model.jnt_qposadr[j]] = 0.5 * (low + high)
    return home, ""
