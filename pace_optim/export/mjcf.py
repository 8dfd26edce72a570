"""A robot's MJCF with what was identified: its joints, its changed bodies, and its drives."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from pace_actuators import IdentifiedDrives
from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.drive_result import ALL
from pace_actuators.effects import Effect
from pace_actuators.effects.command import GravityCompensation
from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv
from pace_envs.identified import load_identified_cfg, use_identified
from pace_envs.link_inertia import FIELDS, state_inertia, state_inertias
from pace_envs.model_file import compile_model, missing_files, read_model_file
from pace_envs.motor_coordinates import DrivenJoints, add_motors
from pace_envs.robot_spec import load_robot_spec
from pace_optim.export.configs import drive_groups
from pace_optim.export.mjcf_drives import write_drives
from pace_optim.export.plain_drive import (
    GAIN_EFFECTS,
    JOINT_EFFECTS,
    PlainDrive,
    effect_notes,
    joint_values,
    plain_drives,
    plain_step_notes,
    soft_frictions,
)

_BODY_FIELDS = (*FIELDS, "body_pos", "body_quat")


_SAME_GRAVITY = 0.05
"""Largest difference of two values of the same gravity [m/s²]."""


def mjcf(drives: IdentifiedDrives, *, joints_only: bool = False) -> tuple[str, list[str]]:
    """The robot's model with identified armature, damping and frictionloss, changed rigid bodies, and its drives.

    Args:
        joints_only: Leave the actuators as they were: for a program that runs the drive itself.
    """
    cfg = load_identified_cfg(drives)
    source = Path(cfg.scene.robot.mjcf_path)
    cfg.scene.num_envs = 1
    cfg.sim.dt, cfg.decimation = drives.at.physics_dt, round(drives.at.control_dt / drives.at.physics_dt)
    plain = ManagerBasedRLEnv(cfg)
    use_identified(cfg, drives.path)
    env = ManagerBasedRLEnv(cfg)
    robot, model = env.scene["robot"], env.sim.model
    spec, left_out = model_of(source)
    couplings = cfg.scene.robot.couplings
    add_motors(spec, couplings, source)
    of_the_fit = _as_in_the_fit(spec, cfg)
    driven = int(robot.dof_columns[0])
    for element in [*spec.joints, *spec.tendons]:  # what has no drive rubs as in the fit too
        element.solref_friction, element.solimp_friction = model.dof_solref[driven], model.dof_solimp[driven]
    attributes = {each.name: each.mujoco for each in BASE_PARAMETERS.values() if each.mujoco}
    for name in robot.joint_names:
        joint = _carrier(spec, name)  # the base parameters: an elastic joint's inertia sits in the drive while it runs
        for attribute, value in joint_values(drives, name, attributes).items():
            _set(joint, attribute, value)
        joint.actfrcrange = [0.0, 0.0]  # none: the drive has its limit
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    if spec.meshes:
        spec.meshdir = str((source.parent / spec.meshdir).resolve())
    changed = _write_bodies(spec, source, plain, env)
    weights = dict(zip(robot.joint_names, env.sim.friction_weights(robot.dof_columns)[0].tolist(), strict=True))
    env.close()
    plain.close()
    held = [e.effect_class.name for e in drives.effects if _in_the_model(e.effect_class)]
    actuators: dict[str, PlainDrive] = {}
    if joints_only:
        notes = _notes_of_joints(drives)
    else:
        actuators, notes = plain_drives(drives)
        actuators, more = _in_plain_steps(spec, actuators, drives.at.physics_dt)
        notes += more
        notes += write_drives(spec, actuators, drives.at.physics_dt, couplings)
        held += [*GAIN_EFFECTS, *JOINT_EFFECTS, *_compensated(spec, drives, notes)]
    _write_soft_friction(spec, source, drives, weights, actuators)
    if changed:
        notes.append(f"changed rigid bodies, which are in the model: {', '.join(changed)}.")
    notes += [*of_the_fit, *effect_notes(drives, held), *left_out]
    return _with_comment(spec, notes, drives, joints_only), notes


def _as_in_the_fit(spec: mujoco.MjSpec, cfg: Any) -> list[str]:
    """Let gravity be the fit's; returns how the fit's rig differs from the file, in words."""
    notes, gravity = [], np.array(cfg.sim.gravity)
    if np.abs(spec.option.gravity - gravity).max() > _SAME_GRAVITY:
        notes.append(f"gravity is that of the fit, {gravity.tolist()} m/s²; the model file has another.")
    spec.option.gravity = gravity
    if held := [f"{name} at {position:.4g}" for name, position in cfg.scene.robot.held_joints.items()]:
        notes.append(f"held in the fit, free here: {', '.join(held)} [rad, of slides m].")
    return notes


def _compensated(spec: mujoco.MjSpec, drives: IdentifiedDrives, notes: list[str]) -> list[str]:
    """Let MuJoCo compensate the weight of all bodies if the drives do so alike; returns the effect that it holds."""
    name = GravityCompensation.name
    shares = drives.parameters.get(f"{name}.share", {})
    if len(set(shares.values())) != 1 or not ({ALL} == set(shares) or set(drives.joint_names) <= set(shares)):
        return []
    for body in spec.bodies[1:]:
        body.gravcomp = next(iter(shares.values()))
    notes.append(f"{name} is gravcomp of all bodies: of their weight, not of other joints' motion; beside the limits.")
    return [name]


def pulled_notes(drives: IdentifiedDrives) -> list[str]:
    """Which drives pull joints that follow theirs, which a drive of a joint does not, in words."""
    try:
        couplings = load_identified_cfg(drives).scene.robot.couplings
    except ValueError:
        return []
    return [
        f"the drive of {name} pulls {listed([joint for joint in row if joint != name])} too: omitted; here the drive "
        "moves its joint, and the others follow."
        for name, row in couplings.items()
        if name in row and name in drives.joint_names
    ]


def motors_of(drives: IdentifiedDrives) -> dict[str, dict[str, float]]:
    """The drives that move several joints together, {motor: {joint: ratio}}; none where the robot is not known."""
    try:
        robot = load_identified_cfg(drives).scene.robot
        driven = DrivenJoints.of_model(compile_model(load_robot_spec(robot), robot.mjcf_path), drives.joint_names)
    except ValueError:
        return {}
    return {name: driven.row_of(name) for name in driven.names if name not in driven.joints}


def _in_plain_steps(
    spec: mujoco.MjSpec, actuators: Mapping[str, PlainDrive], dt: float
) -> tuple[dict[str, PlainDrive], list[str]]:
    """Drives, and armatures in the model, that move in MuJoCo's own steps as they did in steps of second order."""
    result, least = dict(actuators), []
    for name, drive in actuators.items():
        if not drive.second_order:
            continue
        joint = _carrier(spec, name)
        viscous = float(np.ravel(joint.damping)[0])
        result[name], more = drive.for_steps_of(dt, viscous if spec.joint(name) else -viscous)  # a tendon's: explicit
        if joint.armature + more < 0 or drive.damping > 0 == result[name].damping:
            least.append(name)
        joint.armature = max(0.0, joint.armature + more)
    return result, plain_step_notes(actuators, least)


def _write_soft_friction(
    spec: mujoco.MjSpec,
    source: Path,
    drives: IdentifiedDrives,
    weights: Mapping[str, float],
    actuators: Mapping[str, PlainDrive],
) -> None:
    """Write the solver parameters of soft frictions, which follow the armatures and dampings of the file.

    MuJoCo's constraint does not know of damping. A fit in steps of first order has the same constraint.

    Args:
        spec: The model with its drives; it is changed.
        source: The model's own file.
        drives: What was identified.
        weights: What a torque on each joint accelerates it by there [1 / kg m²].
        actuators: The drives in the file.
    """
    if not soft_frictions(drives):
        return
    fixed, dt = spec.copy(), drives.at.physics_dt
    for joint in [each for each in fixed.joints if each.type == mujoco.mjtJoint.mjJNT_FREE]:
        fixed.delete(joint)  # the base is held in the fit
    for each in [*fixed.keys, *fixed.sensors]:
        fixed.delete(each)
    model = compile_model(fixed, source)
    scales, late = {}, {}
    second_order = any(drive.second_order for drive in drive_groups(drives).values())
    takes_slopes = spec.option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name, weight in weights.items():
        of_joint = spec.joint(name) is not None
        own = model.dof_invweight0[model.joint(name).dofadr[0]] if of_joint else model.tendon(name).invweight0
        scales[name] = float(np.ravel(own)[0]) / weight
        damping = float(np.ravel(_carrier(spec, name).damping)[0]) if of_joint else 0.0  # a tendon's acts explicitly
        damping += actuators[name].damping if takes_slopes and name in actuators else 0.0
        late[name] = dt * damping * scales[name] * weight if second_order else 0.0
    for name, (constant, impedance) in soft_frictions(drives, scales, late).items():
        joint = _carrier(spec, name)
        joint.solref_friction, joint.solimp_friction = [constant, 1.0], [impedance, impedance, 0.001, 0.5, 2.0]


def _carrier(spec: mujoco.MjSpec, name: str) -> Any:
    """What carries a drive's armature, damping and friction: its joint, or the tendon of a motor of several."""
    return spec.joint(name) or spec.tendon(name)


def model_of(source: Path) -> tuple[mujoco.MjSpec, list[str]]:
    """The model of a file as it stands; without what is missing, which is noted.

    A URDF's bodies that overlap in its own posture do not touch: URDF has no word for that.
    """
    if source.suffix == ".urdf":
        file = read_model_file(source, touches=True)
        return file.spec, [*file.notes, *_exclude_overlaps(file.spec, source)]
    spec = mujoco.MjSpec.from_file(str(source))
    if not (missing := missing_files(spec, source)):
        return spec, []
    named = ", ".join(Path(name).name for name in missing[:2]) + (", …" if len(missing) > 2 else "")
    return read_model_file(source).spec, [f"{len(missing)} files of the model are missing ({named}): left out."]


def _exclude_overlaps(spec: mujoco.MjSpec, source: Path) -> list[str]:
    """Let bodies pass through each other that overlap where all joints are at their zero."""
    model = compile_model(spec, source)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pairs = {tuple(sorted(int(model.geom_bodyid[g]) for g in contact.geom)) for contact in data.contact}
    named = [(model.body(first).name, model.body(second).name) for first, second in sorted(pairs)]
    for first, second in named:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    if not named:
        return []
    return [f"bodies that overlap in the file's posture do not touch: {listed([' and '.join(p) for p in named], 3)}."]


def _in_the_model(kind: type[Effect]) -> bool:
    return kind.overrides("constraint") or kind.overrides("write_model")


def _set(joint: Any, attribute: str, value: float) -> None:
    """Armature, frictionloss, or linear damping: since MuJoCo 3.5 damping is a polynomial."""
    if np.ndim(before := getattr(joint, attribute)):
        setattr(joint, attribute, [value, *[0.0] * (len(before) - 1)])
    else:
        setattr(joint, attribute, value)


def _write_bodies(spec: mujoco.MjSpec, source: Path, plain: ManagerBasedRLEnv, env: ManagerBasedRLEnv) -> list[str]:
    """Write the rigid bodies that effects have changed; returns their names."""
    model = env.sim.model
    changed: list[str] = []
    for b in range(1, model.nbody):
        before = {field: plain.sim.expand(field)[0, b] for field in _BODY_FIELDS}
        after = {field: env.sim.expand(field)[0, b] for field in _BODY_FIELDS}
        if all(torch.allclose(before[f], after[f], rtol=1e-12, atol=1e-15) for f in _BODY_FIELDS):
            continue
        if not changed:
            state_inertias(spec, compile_model(spec, source))
        body = spec.body(model.body(b).name)
        changed.append(body.name)
        mass, com, moments, quat = (after[field].numpy() for field in FIELDS)
        state_inertia(body, float(mass), com, moments, quat)
        for field, attribute in (("body_pos", "pos"), ("body_quat", "quat")):
            if not torch.equal(before[field], after[field]):
                setattr(body, attribute, after[field].numpy())
    return changed


def _notes_of_joints(drives: IdentifiedDrives) -> list[str]:
    bias = [abs(value) for value in drives.parameters["encoder_bias"].values()]
    delayed = "targets" if drives.delay_mode == "command" else "the controller's torque"
    return [
        f"encoder bias (up to {max(bias):.3g} rad, of slides m): the encoder shows q - bias; it is not in the model.",
        f"delay of {1e3 * drives.delay_s:.3g} ms of {delayed}: it is not in the model.",
        "gains and torque-speed limits of the drives: there are no actuators in the model but those it had.",
    ]


def _with_comment(spec: mujoco.MjSpec, notes: list[str], drives: IdentifiedDrives, joints_only: bool) -> str:
    try:
        spec.compile()
        xml = spec.to_xml()
    except ValueError as error:
        raise ValueError(f"MuJoCo does not take the robot's model with the identified values: {error}") from None
    what = "armature, damping, frictionloss" if joints_only else "joints and drives (actuators)"
    if motors := [name for name in drives.joint_names if not spec.joint(name)]:
        notes.append(f"{listed(motors)}: tendons, which carry the motors' armature, damping and frictionloss.")
    lines = [f"Identified with {drives.task}: {what}. Beside that:", *(f"- {note}" for note in notes)]
    if not joints_only:
        lines.append(f"The timestep is the identification's ({1e3 * drives.at.physics_dt:g} ms).")
    body = "\n".join(textwrap.fill(line, 118, subsequent_indent="  ") for line in lines)
    body = body.replace("--", "- -")
    head, found, rest = xml.partition("<mujoco")
    return f"{head}<!--\n{body}\n-->\n{found}{rest}"
