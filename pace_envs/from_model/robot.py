"""From a model file to an identification environment's configuration, and to a robot for training tasks."""

from __future__ import annotations

import copy
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from pace_actuators import PaceDCMotorCfg, resolve_joint_values
from pace_actuators.base_parameters import PER_JOINT
from pace_actuators.joint_units import units_for
from pace_actuators.text import listed
from pace_envs.articulation_cfg import ArticulationCfg, InitialStateCfg
from pace_envs.from_model import defaults
from pace_envs.from_model.actuators import read_drives
from pace_envs.from_model.couplings import followers
from pace_envs.from_model.joints import JointFacts, home_posture, joint_facts
from pace_envs.from_model.scaling import (
    OF_BOUNDS,
    base_bounds,
    gains,
    has_gains,
    motion,
    runs_continuously,
    sample_values,
    start_values,
)
from pace_envs.model_file import ModelFile, compile_model, read_model_file
from pace_envs.motor_coordinates import DrivenJoints, Rows, add_motors, single_joints
from pace_envs.robot_spec import load_robot_spec
from pace_envs.simulation import SimulationCfg
from pace_envs.tasks.pace import ExcitationCfg, PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg

_UNNAMED = {"", "mujoco model", "robot", "model", "scene"}
_NARROW = 0.2
"""Median width of ranges [rad] below which the file may mean radians where MuJoCo reads degrees."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """A robot as its model file states it."""

    file: ModelFile
    """The file."""
    model: mujoco.MjModel
    """The compiled model, its base as in the file."""
    name: str
    """Its name, fit for a folder."""
    joints: tuple[JointFacts, ...]
    """The driven joints, in the order of the model."""
    home: np.ndarray
    """The home posture, (nq,)."""
    notes: tuple[str, ...]
    """What was assumed and what was left out, in plain sentences."""


def read_robot(path: str | Path, control_dt: float = defaults.CONTROL_DT, motors: Rows | None = None) -> Robot:
    """Read a robot from a model file.

    Args:
        control_dt: Time between two commands [s].
        motors: Motors that move several joints and that the file lacks. Its drives of these joints are left out.
    """
    file, motors = read_model_file(path), motors or {}
    add_motors(file.spec, motors, path)
    model = compile_model(file.spec, path, file.notes if file.urdf is None else ())
    drives, notes = read_drives(model)
    names = _with_motors([drive.joint for drive in drives] or _to_drive(model, file), motors)
    if not names:
        raise ValueError(f"The model {path} has no hinge or slide joint that a drive could move.")
    home, key = home_posture(model)
    home = at_rest(model, home, DrivenJoints.of_model(model, names).joints)
    stated = {drive.joint: drive for drive in drives}
    velocity, command = ({}, {}) if file.urdf is None else (file.urdf.velocity_limits, file.urdf.command)
    joints = joint_facts(model, home, names, stated, velocity, command)
    return Robot(
        file=file,
        model=model,
        name=_folder_name(file),
        joints=tuple(joints),
        home=home,
        notes=(
            *_degrees_note(joints, file),
            *file.notes,
            *notes,
            *_beside_drives(model, [name for joint in joints for name in joint.joints]),
            *_assumptions(joints, key, model, control_dt),
            _loop_note(joints, model, control_dt),
        ),
    )


def cfg_from_model(
    path: str | Path, control_dt: float = defaults.CONTROL_DT, motors: Rows | None = None
) -> PaceSim2realEnvCfg:
    """The identification environment of the robot in a model file, its base held in the air.

    Joints and their order, gains, limits, armature, damping, friction, ranges and the home posture are the file's.
    Bounds and motion of each joint are scaled by its effort limit and inertia. What the file does not say is assumed
    (:mod:`pace_envs.from_model.defaults`) and listed in ``sim2real.notes``.

    Args:
        path: MJCF (``.xml``) or URDF (``.urdf``).
        control_dt: Time between two commands [s], which no file says.
        motors: Motors that move several joints, {motor: {joint: ratio}}. The file lacks them.

    Raises:
        ValueError: If the file cannot be used; the message says what to do.
    """
    if not 0 < control_dt <= defaults.LONGEST_DELAY:
        raise ValueError(
            f"control_dt is {control_dt:g} s, expected a time above 0 and up to {defaults.LONGEST_DELAY:g} s, such as "
            "0.001 for commands at 1 kHz."
        )
    robot = read_robot(path, control_dt, motors)
    joints, names = robot.joints, tuple(joint.name for joint in robot.joints)
    position, orientation = _base_pose(robot)
    continuous = runs_continuously(joints, robot.model, control_dt)
    longest_delay = defaults.LONGEST_DELAY / control_dt
    articulation = ArticulationCfg(
        mjcf_path=Path(path),
        init_state=InitialStateCfg(pos=position, rot=orientation, joint_pos=_home_positions(robot)),
        actuators={"drives": _drive_cfg(joints, longest_delay, continuous=continuous)},
        joint_order=names,
        assumed_gains={joint.name: gains(joint) for joint in joints if not has_gains(joint)},
        couplings={joint.name: dict(joint.drive.row) for joint in joints if joint.drive and joint.drive.row}
        | {name: dict(row) for name, row in (motors or {}).items() if name in names and name not in row},
    )
    bounds = {name: [base_bounds(joint)[name] for joint in joints] for name in PER_JOINT}
    moves = [motion(joint) for joint in joints]
    starts = [start_values(joint) for joint in joints]
    samples = {group: {joint.name: sample_values(joint)[group] for joint in joints} for group in PER_JOINT}
    cfg = PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=articulation),
        sim=SimulationCfg(
            dt=control_dt,
            integrator="leapfrog",
            gravity=_gravity(robot.model),
        ),
        sim2real=PaceCfg(
            robot_name=robot.name,
            data_dir=Path("data") / robot.name / "chirp.npz",
            joint_order=names,
            bounds={**bounds, "delay": (0.0, longest_delay)},
            excitation=ExcitationCfg(
                bias=tuple(centre / amplitude for centre, amplitude in moves),
                direction=(1.0,) * len(joints),
                scale=tuple(amplitude for _, amplitude in moves),
            ),
            sample_params={**samples, "delay": 2.0},
            start_params={
                **{group: dict(zip(names, [at[group] for at in starts], strict=True)) for group in starts[0]},
                "delay": OF_BOUNDS * longest_delay,
            },
            slide_joints=tuple(joint.name for joint in joints if joint.is_slide),
            assumed_gains=tuple(joint.name for joint in joints if not has_gains(joint)),
            physics_steps=defaults.physics_steps(control_dt),
            notes=robot.notes,
        ),
    )
    cfg.sim2real.prepare()
    return cfg


def robot_cfg_from_model(
    path: str | Path, joint_pos: Mapping[str, float] | None = None, control_dt: float = 0.005
) -> ArticulationCfg:
    """The robot of a model file for a training task, with the joints and drives of :func:`cfg_from_model`.

    It stands on the ground with its lowest colliding geom. Gains that the file does not state are assumed;
    :func:`~pace_envs.use_identified` replaces them by those of the recordings.

    Args:
        path: MJCF (``.xml``) or URDF (``.urdf``).
        joint_pos: Its stance, by expressions of joints [rad]; other joints are as in the file's home posture.
        control_dt: Time between two commands to the drives [s].

    Raises:
        ValueError: If the file cannot be used, or an expression matches no joint.
    """
    robot = replace(cfg_from_model(path, control_dt).scene.robot, fix_base=None)
    names = robot.joint_order or ()
    own = resolve_joint_values(dict(joint_pos or {}), names, field="joint_pos", default=math.nan).tolist()
    stated = {re.escape(name): value for name, value in zip(names, own, strict=True) if not math.isnan(value)}
    stance = {**dict(robot.init_state.joint_pos), **stated}  # type: ignore[arg-type]
    return replace(robot, init_state=_on_ground(robot, stance))


def _on_ground(robot: ArticulationCfg, stance: Mapping[str, float]) -> InitialStateCfg:
    """A stance whose lowest colliding geom touches the ground; the base's origin is on it if nothing collides."""
    at_origin = replace(robot, fix_base=True, init_state=InitialStateCfg(rot=robot.init_state.rot))
    with warnings.catch_warnings(action="ignore"):  # shown when the environment is built
        spec = load_robot_spec(at_origin, touches=True)
    depth = 1e3
    ground = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], pos=[0.0, 0.0, -depth])
    model = spec.compile()
    data = mujoco.MjData(model)
    driven = DrivenJoints.of_model(model, robot.joint_order or ())
    positions = driven.to_joints(np.array([stance.get(re.escape(name), 0.0) for name in driven.names]))
    of_joints = dict(zip(driven.joints, positions.tolist(), strict=True))
    for j in range(model.njnt):
        name = model.joint(j).name
        data.qpos[model.jnt_qposadr[j]] = of_joints.get(name, stance.get(re.escape(name), 0.0))
    mujoco.mj_kinematics(model, data)
    colliding = model.geom_contype | model.geom_conaffinity
    own = [g for g in range(model.ngeom) if colliding[g] and model.geom_bodyid[g]]
    above = [mujoco.mj_geomDistance(model, data, ground.id, g, 2 * depth, None) for g in own]
    base = data.body(1)
    w, x, y, z = base.xquat.tolist()
    height = float(base.xpos[2]) + depth - min(above) if above else 0.0
    return InitialStateCfg(pos=(0.0, 0.0, height), rot=(w, x, y, z), joint_pos=dict(stance))


def _drive_cfg(joints: Sequence[JointFacts], longest_delay: float, *, continuous: bool) -> PaceDCMotorCfg:
    pairs = [gains(joint) for joint in joints]
    limits = [joint.effort_limit for joint in joints]
    speeds = [joint.velocity_limit for joint in joints]
    return PaceDCMotorCfg(
        joint_names_expr=[re.escape(joint.name) for joint in joints],
        stiffness=[stiffness for stiffness, _ in pairs],
        damping=[damping for _, damping in pairs],
        effort_limit=limits if np.isfinite(limits).any() else None,
        velocity_limit=speeds if np.isfinite(speeds).any() else None,
        delay=0.0,
        max_delay=longest_delay,
        implicit=continuous,
    )


def _to_drive(model: mujoco.MjModel, file: ModelFile) -> list[str]:
    """What to drive where the file has no actuators: joints that it names, else all that follow no other."""
    if file.urdf is not None and file.urdf.driven:
        return [name for name in (model.joint(j).name for j in range(model.njnt)) if name in file.urdf.driven]
    follow = followers(model)
    return [model.joint(j).name for j in single_joints(model) if j not in follow]


def _with_motors(names: Sequence[str], motors: Rows) -> list[str]:
    """The driven names. Motors replace joints that they turn and that have no row."""
    result = list(names)
    for motor, row in motors.items():
        if motor not in result and (place := next((j for j in row if j in result and j not in motors), "")):
            result[result.index(place)] = motor
    return result


def _base_pose(robot: Robot) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Pose of a floating base at home; a fixed one is where the file has it.

    A keyframe leans as the robot stands. A stand holds the base as the file has its body.
    """
    model = robot.model
    for j in range(model.njnt):
        if int(model.jnt_type[j]) == mujoco.mjtJoint.mjJNT_FREE:
            at = model.jnt_qposadr[j]
            x, y, z = robot.home[at : at + 3].tolist()
            turn = model.qpos0[at + 3 : at + 7].tolist()
            return (x, y, z), (turn[0], turn[1], turn[2], turn[3])
    return (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)


def _home_positions(robot: Robot) -> dict[str, float]:
    """Positions at home, by name, where they are not 0: of drives, and of the hinge and slide joints without."""
    model = robot.model
    driven = {joint for facts in robot.joints for joint in facts.joints}
    result = {facts.name: facts.home for facts in robot.joints}
    for j in single_joints(model):
        if model.joint(j).name not in driven:
            result[model.joint(j).name] = float(robot.home[model.jnt_qposadr[j]])
    return {re.escape(name): value for name, value in result.items() if value}


def _gravity(model: mujoco.MjModel) -> tuple[float, float, float]:
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY):
        return (0.0, 0.0, 0.0)
    x, y, z = model.opt.gravity.tolist()
    return (x, y, z)


def _assumptions(joints: Sequence[JointFacts], key: str, model: mujoco.MjModel, control_dt: float) -> list[str]:
    middle = "0 for each joint, or the middle of its range where 0 lies outside"
    notes = [f"home posture: {f'keyframe {key}' if key else middle}"]
    if not all(has_gains(joint) for joint in joints):
        notes.append(
            "gains: the file has none; a recording that has none gets kp = effort limit / "
            f"{defaults.ERROR_AT_LIMIT:g} rad, at least {defaults.NATURAL_FREQUENCY:g} Hz, and kd for a damping ratio "
            f"of {defaults.DAMPING_RATIO:g}"
        )
    without = [joint.name for joint in joints if not np.isfinite(joint.effort_limit)]
    if without:
        notes.append(f"effort limit: none ({listed(without, 3)})")
    if limits := [joint.effort_limit for joint in joints if np.isfinite(joint.effort_limit)]:
        unit = units_for("N m", ["slide" if joint.is_slide else "hinge" for joint in joints])
        span = f"{min(limits):g}" if min(limits) == max(limits) else f"{min(limits):g} to {max(limits):g}"
        notes.append(
            f"effort limit: {span} {unit}, the file's; it cuts the torques. If it is a guess, state "
            "effort_limit beside the log, or find it with --unknown effort_limit"
        )
    if not any(np.isfinite(joint.velocity_limit) for joint in joints):
        notes.append("speed limit: none")
    notes.append(f"control rate: {1 / control_dt:g} Hz; delay: 0 to {1e3 * defaults.LONGEST_DELAY:g} ms (--control_dt)")
    if any(int(kind) == mujoco.mjtJoint.mjJNT_FREE for kind in model.jnt_type):
        notes.append("the base is held in the air, turned as its body in the file; nothing touches")
    return notes


def _beside_drives(model: mujoco.MjModel, driven: Sequence[str]) -> list[str]:
    """What the file lets act on the joints beside their drives: it stays in the model."""
    follow, notes = followers(model), []
    joints = single_joints(model)
    loose = [model.joint(j).name for j in joints if j not in follow and model.joint(j).name not in driven]
    if loose:
        notes.append(
            f"no drive: {listed(loose, 3)} (no actuator, transmission or ros2_control command): free to move. Name the "
            "joint there if it is driven"
        )
    springs = {model.joint(j).name: float(np.ravel(model.jnt_stiffness[j])[0]) for j in joints}
    if sprung := [f"{name} {value:g}" for name, value in springs.items() if value]:
        notes.append(f"springs of the file act beside the drives: stiffness {listed(sprung, 3)}")
    option = model.opt
    medium = {"density": option.density, "viscosity": option.viscosity}
    acting = [f"{name} {value:g}" for name, value in medium.items() if value]
    if acting:
        wind = [f"wind {' '.join(f'{each:g}' for each in option.wind)} m/s"] if option.wind.any() else []
        notes.append(f"a medium of the file acts on the robot: {', '.join([*acting, *wind])}")
    return notes


def _degrees_note(joints: Sequence[JointFacts], file: ModelFile) -> list[str]:
    """Whether the ranges of an MJCF seem to be radians that are read as degrees, which is MuJoCo's default."""
    widths = [high - low for low, high in (j.range for j in joints if not j.is_slide) if np.isfinite(high - low)]
    if file.urdf is not None or not file.spec.compiler.degree or not widths or np.median(widths) > _NARROW:
        return []
    return [
        f"ranges: {np.degrees(np.median(widths)):.2g} degrees wide in the median; MuJoCo reads an MJCF's angles in "
        'degrees. If they are radians, say so in the file: <compiler angle="radian"/>'
    ]


def _loop_note(joints: Sequence[JointFacts], model: mujoco.MjModel, control_dt: float) -> str:
    if runs_continuously(joints, model, control_dt):
        return "drive loops: their period is --drive_dt; without it they are continuous, as MuJoCo's gains are"
    return "drive loops: their period is --drive_dt; without it they hold a torque for a control step"


def _folder_name(file: ModelFile) -> str:
    stated = file.spec.modelname
    name = stated if stated.lower() not in _UNNAMED else file.path.stem
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "robot"


_STEP = 1e-3
"""Of the simulation that comes to rest [s]."""
_LONGEST = 10.0
"""It takes this long at most [s]."""
_LOOK = 200
"""Steps between two looks at whether it rests, ..."""
_STILL = 1e-7
"""which it does where nothing has moved further in between [rad or m]."""
_HEAVY = 1e6
"""Inertia that holds joints [kg m²]."""


def at_rest(model: mujoco.MjModel, posture: np.ndarray, driven: Sequence[str]) -> np.ndarray:
    """A posture (nq,) with the joints without drives at rest, the others held where they are.

    A recording begins at rest, and loops alone do not say where a finger's links are that its spring pushes against a
    stop. They fall, and are stopped where their energy is highest (dynamic relaxation), until nothing moves.

    Args:
        driven: Joints that are held; so is a floating base.
    """
    own = copy.copy(model)
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    own.opt.timestep, own.opt.integrator = _STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    free = np.flatnonzero([_is_free(model, int(joint), driven) for joint in model.dof_jntid])
    if not len(free):
        return posture
    places = [a for j in set(model.dof_jntid[free]) for a in _places(model, int(j))]
    held = np.setdiff1d(np.arange(model.nv), free)
    own.dof_armature[held] = _HEAVY
    own.dof_damping[free] = own.dof_frictionloss[free] = 0.0
    own.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(own)
    mujoco.mj_setConst(own, data)
    data.qpos[:] = last = posture
    fastest = 0.0
    for step in range(1, round(_LONGEST / _STEP) + 1):
        mujoco.mj_step(own, data)
        energy = float(data.energy[1])
        if energy < fastest:
            data.qvel[:] = 0.0
        fastest = energy if energy >= fastest else 0.0
        if step % _LOOK == 0:
            if not np.isfinite(data.qpos).all():
                return posture
            moved, last = np.abs(data.qpos - last)[places].max(), data.qpos.copy()
            if moved < _STILL:
                break
    result = posture.copy()
    result[places] = last[places]
    return result


def _places(model: mujoco.MjModel, joint: int) -> range:
    """Where a joint's position is in qpos."""
    first = int(model.jnt_qposadr[joint])
    return range(first, first + (4 if int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_BALL else 1))


def _is_free(model: mujoco.MjModel, joint: int, driven: Sequence[str]) -> bool:
    """Whether a joint has no drive; a floating base does not count."""
    return int(model.jnt_type[joint]) != mujoco.mjtJoint.mjJNT_FREE and model.joint(joint).name not in driven
