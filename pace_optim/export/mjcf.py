"""A robot's MJCF with what was identified: its joints, its changed bodies, and its drives."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
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
from pace_actuators.effects.fading_friction import SoftFriction
from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv
from pace_envs.from_model.couplings import followed_ratio
from pace_envs.identified import load_identified_cfg, use_identified
from pace_envs.model_file import compile_model, missing_files, read_model_file
from pace_envs.motor_coordinates import DrivenJoints, Rows, add_motors
from pace_envs.robot_spec import load_robot_spec
from pace_optim.export.plain_drive import (
    GAIN_EFFECTS,
    JOINT_EFFECTS,
    PlainDrive,
    effect_notes,
    is_undetermined,
    plain_drives,
)

_LINEAR = 1
"""Interpolation of a delayed command between two samples."""
_INPUT = mujoco.mjtCtrlInput
"""What a ``dcmotor`` is commanded by."""
_OF_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def write_drives(
    spec: mujoco.MjSpec, drives: Mapping[str, PlainDrive], dt: float, couplings: Rows | None = None
) -> list[str]:
    """Give each joint or motor its drive: an actuator that it has is changed in its place, otherwise one is added.

    Args:
        spec: The model; it is changed.
        drives: The drives by joint, and of motors that move several by their tendon.
        dt: Physics step that they were identified at [s].
        couplings: Joints whose drives pull joints that follow them too: each gets a tendon with this row.

    Returns:
        What the model does not hold, or holds in an unexpected way, in words.
    """
    notes = _delay_notes(drives, dt)
    spec.option.timestep = dt
    spec.option.integrator = _integrator(drives)
    notes += _rate_notes(drives, dt)
    keys = [key for key in spec.keys if len(key.ctrl)]
    _shift_encoders(spec, drives, notes, couplings or {})
    for name, drive in drives.items():
        joints = {joint.name for joint in spec.joints}
        row = (couplings or {}).get(name, {}) if name in joints else {}
        kinds = _OF_JOINT if name in joints else (mujoco.mjtTrn.mjTRN_TENDON,)
        own = [a for a in spec.actuators if a.target == name and a.trntype in kinds]
        if name in joints:
            own += [a for a in spec.actuators if _pulled_by(spec, a) == set(row or [name])]
        first, *more = own or [None]
        for other in more:
            _delete(spec, other, notes)
        if first is None:
            taken = {a.name for a in spec.actuators}
            first = spec.add_actuator(name=name if name not in taken else f"{name}_drive")
        first.target, first.trntype = name, kinds[0]
        if row:
            tendon = spec.add_tendon(name=f"{name}_drive")
            for joint, ratio in row.items():
                tendon.wrap_joint(joint, ratio)
            first.target, first.trntype = tendon.name, mujoco.mjtTrn.mjTRN_TENDON
        _write(first, drive, dt)
        _write_beside(spec, name, drive, notes)
    if keys:
        notes.append("control values of keyframes are omitted: they belonged to other actuators.")
        for key in keys:
            key.ctrl = []
    return notes


def _pulled_by(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> set[str]:
    """The joints of an actuator's tendon."""
    if actuator.trntype != mujoco.mjtTrn.mjTRN_TENDON:
        return set()
    return {wrap.target.name for wrap in spec.tendon(actuator.target).path if wrap.target is not None}


def _write(actuator: mujoco.MjsActuator, drive: PlainDrive, dt: float) -> None:
    actuator.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    actuator.armature, actuator.damping = 0.0, np.zeros_like(actuator.damping)  # the joint has the identified ones
    actuator.dyntype, actuator.dynprm = mujoco.mjtDyn.mjDYN_NONE, np.zeros_like(actuator.dynprm)
    actuator.biastype, actuator.biasprm = mujoco.mjtBias.mjBIAS_NONE, np.zeros_like(actuator.biasprm)
    actuator.actdim, actuator.inheritrange = -1, 0.0
    for limited in ("ctrllimited", "forcelimited", "actlimited"):
        setattr(actuator, limited, mujoco.mjtLimited.mjLIMITED_FALSE)
    actuator.ctrlrange = actuator.actrange = [0.0, 0.0]
    limit = drive.effort_limit if math.isfinite(drive.effort_limit) else 0.0
    kp, kd = drive.stiffness, drive.damping
    if drive.has_line:
        actuator.set_to_dcmotor(
            motorconst=[0.0, 0.0],
            resistance=0.0,
            nominal=[1.0, drive.saturation_effort, drive.velocity_limit],  # at one volt: only the ratios count
            saturation=[limit, 0.0, 0.0],
            controller=[kp, 0.0, kd, 0.0, 0.0, 1.0],
            ctrlspec=_INPUT.mjINPUT_POS if kp else _INPUT.mjINPUT_VEL if kd else _INPUT.mjINPUT_FF,
        )
    elif kp:
        actuator.set_to_position(kp=kp, kv=kd)
    elif kd:
        actuator.set_to_velocity(kv=kd)
    else:
        actuator.set_to_motor()
    if limit:
        actuator.forcerange = [-limit, limit]
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    steps = drive.delay_s / dt
    if steps >= 0.5:
        actuator.delay = max(steps, 1.0) * dt
        actuator.nsample, actuator.interp = math.ceil(max(steps, 1.0) - 1e-9), _LINEAR
    else:
        actuator.delay, actuator.nsample = 0.0, 0


def _write_beside(spec: mujoco.MjSpec, name: str, drive: PlainDrive, notes: list[str]) -> None:
    """Torques that act beside the drive's; positions of the model are the encoder's already."""
    carrier, is_joint = spec.joint(name) or spec.tendon(name), bool(spec.joint(name))
    if drive.quadratic:
        carrier.damping = [carrier.damping[0], drive.quadratic, *carrier.damping[2:]]
    if drive.spring:
        unit = math.degrees(1.0) if is_joint and spec.compiler.degree and _turns(carrier) else 1.0
        before, length = carrier.stiffness[0], carrier.springref if is_joint else np.mean(carrier.springlength)
        both = before + drive.spring
        rest = (before * length / unit + drive.spring * (drive.rest - drive.encoder_bias)) / (both or 1.0)
        carrier.stiffness = [both, *carrier.stiffness[1:]]
        if is_joint:
            carrier.springref = rest * unit
        else:
            carrier.springlength = [rest, rest]
    if drive.offset:
        offset = spec.add_actuator(name=f"{name}_offset", target=name, trntype=_OF_JOINT[0])
        if not is_joint:
            offset.trntype = mujoco.mjtTrn.mjTRN_TENDON
        offset.gainprm, offset.biastype = np.zeros_like(offset.gainprm), mujoco.mjtBias.mjBIAS_AFFINE
        offset.biasprm = [drive.offset, *np.zeros(len(offset.biasprm) - 1)]
        notes.append(f"torque_offset of {name} is the actuator {offset.name}; its control does nothing.")


def _turns(joint: mujoco.MjsJoint) -> bool:
    return joint.type == mujoco.mjtJoint.mjJNT_HINGE


def _shift_encoders(spec: mujoco.MjSpec, drives: Mapping[str, PlainDrive], notes: list[str], couplings: Rows) -> None:
    """Let joint positions be what the encoders show: q - bias; joints that follow a drive's move with it."""
    if not any(drive.encoder_bias for drive in drives.values()):
        return
    model = spec.compile()
    driven = DrivenJoints.of_model(model, list(drives))
    of_joints = driven.to_joints(np.array([drive.encoder_bias for drive in drives.values()]))
    shifted = {name: bias for name, bias in zip(driven.joints, of_joints.tolist(), strict=True) if bias}
    for name, row in couplings.items():
        if bias := shifted.get(name):
            follow = {j: followed_ratio(model, model.joint(j).id, model.joint(name).id) for j in row}
            shifted |= {joint: ratio[0] * bias for joint, ratio in follow.items() if ratio is not None}
    addresses = {name: int(model.joint(name).qposadr[0]) for name in shifted} if spec.keys else {}
    for name, bias in shifted.items():
        joint = spec.joint(name)
        is_degree = spec.compiler.degree and _turns(joint)
        own = math.degrees(bias) if is_degree else bias
        joint.ref, joint.springref = joint.ref - own, joint.springref - own
        if np.any(joint.range):
            joint.range = joint.range - own
        for key in spec.keys:
            if len(key.qpos):
                qpos = np.array(key.qpos)
                qpos[addresses[name]] -= bias
                key.qpos = qpos
    most = max(abs(drive.encoder_bias) for drive in drives.values())
    notes.append(
        f"encoder bias of up to {most:.3g} rad (of slides m): positions, targets and keyframes of this model are what "
        "the encoders show, q - bias. The joints' ref is shifted."
    )
    if spec.tendons:
        notes.append("tendons over joints with a bias have lengths of what the encoders show.")


def _integrator(drives: Mapping[str, PlainDrive]) -> mujoco.mjtIntegrator:
    """The one with which the actuators' damping acts as it did: within the step, or as a torque held over it."""
    continuous = any(drive.run_dt == 0 and not drive.second_order for drive in drives.values())
    return mujoco.mjtIntegrator.mjINT_IMPLICITFAST if continuous else mujoco.mjtIntegrator.mjINT_EULER


def _rate_notes(drives: Mapping[str, PlainDrive], dt: float) -> list[str]:
    if any(drive.second_order for drive in drives.values()):
        return [
            "the integrator is Euler; the fit's steps were of second order. MuJoCo's joint friction turns at the end "
            "of a step, the fit's within it. If joints reverse often, use a shorter timestep."
        ]
    rates = sorted({drive.run_dt for drive in drives.values()})
    how = "implicitfast: kd acts within the step" if rates[0] == 0 else "Euler: a drive's torque is held over the step"
    notes = [f"the integrator is {how}, as in the identification."]
    if rates[0] == 0 < rates[-1]:
        notes.append("some drives held their torque over a step: here all act within it.")
    if rates[-1] > dt * (1 + 1e-9):
        notes.append(f"controllers ran every {1e3 * rates[-1]:.3g} ms: here at each step of {1e3 * dt:.3g} ms.")
    return notes


def _delete(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator, notes: list[str]) -> None:
    notes.append(f"the actuator {actuator.name or 'without a name'} moved a joint beside another one; it is omitted.")
    for sensor in spec.sensors:
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR and sensor.objname == actuator.name:
            spec.delete(sensor)
    spec.delete(actuator)


def _delay_notes(drives: Mapping[str, PlainDrive], dt: float) -> list[str]:
    delay = max((drive.delay_s for drive in drives.values()), default=0.0)
    if delay == 0:
        return []
    if delay < dt * (1 - 1e-9):
        near = dt if delay >= 0.5 * dt else 0.0
        return [
            f"delay of {1e3 * delay:.3g} ms: MuJoCo's shortest is one step, so it is {1e3 * near:.3g} ms in the model."
        ]
    notes = [
        f"delay of {1e3 * delay:.3g} ms of the targets: the actuators have it. After a reset MuJoCo's history holds "
        "zeros. Call mj_initCtrlHistory with the first targets then."
    ]
    if abs(delay / dt - round(delay / dt)) > 1e-6 and any(math.isfinite(d.effort_limit) for d in drives.values()):
        notes.append(
            "commands that arrive within a step: the fit limits the torque before and after one, MuJoCo limits the "
            "mean of both."
        )
    return notes


_BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat")


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
    driven = int(robot.dof_columns[0])
    for element in [*spec.joints, *spec.tendons]:  # what has no drive rubs as in the fit too
        element.solref_friction, element.solimp_friction = model.dof_solref[driven], model.dof_solimp[driven]
    for name in robot.joint_names:
        joint = _carrier(spec, name)  # the base parameters: an elastic joint's inertia sits in the drive while it runs
        for parameter in BASE_PARAMETERS.values():
            if parameter.mujoco and not is_undetermined(drives, parameter.name, name):
                _set(joint, parameter.mujoco, drives.values(parameter.name, [name])[name])
        joint.actfrcrange = [0.0, 0.0]  # none: the drive has its limit
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for name, time_constant in _soft_frictions(drives, robot.joint_names).items():
        joint = _carrier(spec, name)
        joint.solref_friction = [time_constant, 1.0]
        joint.solimp_friction = [SoftFriction.impedance, SoftFriction.widest, 0.001, 0.5, 2.0]
    if spec.meshes:
        spec.meshdir = str((source.parent / spec.meshdir).resolve())
    changed = _write_bodies(spec, plain, env)
    env.close()
    plain.close()
    held = [e.effect_class.name for e in drives.effects if _in_the_model(e.effect_class)]
    if joints_only:
        notes = _notes_of_joints(drives)
    else:
        actuators, notes = plain_drives(drives)
        actuators, more = _in_plain_steps(spec, actuators, drives.at.physics_dt)
        notes += more
        notes += write_drives(spec, actuators, drives.at.physics_dt, couplings)
        held += [*GAIN_EFFECTS, *JOINT_EFFECTS, *_compensated(spec, drives, notes)]
    if changed:
        notes.append(f"changed rigid bodies, which are in the model: {', '.join(changed)}.")
    notes += [*effect_notes(drives, held), *left_out]
    return _with_comment(spec, notes, drives, joints_only), notes


def _compensated(spec: mujoco.MjSpec, drives: IdentifiedDrives, notes: list[str]) -> list[str]:
    """Let MuJoCo compensate the weight of all bodies if the drives do so alike; returns the effect that it holds."""
    name = GravityCompensation.name
    shares = drives.parameters.get(f"{name}.share", {})
    alike = set(shares.values())
    if len(alike) != 1 or not ({ALL} == set(shares) or set(drives.joint_names) <= set(shares)):
        return []
    for body in spec.bodies[1:]:
        body.gravcomp = alike.copy().pop()
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
    notes = []
    if any(drive.second_order for drive in actuators.values()):
        notes.append(
            "kd, delay and armature differ from the identified ones: they compensate for MuJoCo's steps of first order "
            "and for torques that the drive holds. In such a step the speed is half a step older than the position."
        )
    if least:
        notes.append(f"armature or kd of {', '.join(least)} would be below 0: it is 0, and the motion differs.")
    return result, notes


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
    return kind is SoftFriction or kind.overrides("write_model")


def _soft_frictions(drives: IdentifiedDrives, joint_names: Sequence[str]) -> dict[str, float]:
    """Time constants [s] of the joints whose friction is that of MuJoCo's own constraint."""
    own = [cfg.joints(joint_names) for cfg in drives.effects if cfg.effect_class is SoftFriction]
    values = drives.values("soft_friction.time_constant", own[0]) if own else {}
    return {name: value for name, value in values.items() if value > 0}


def _set(joint: Any, attribute: str, value: float) -> None:
    """Armature, frictionloss, or linear damping: since MuJoCo 3.5 damping is a polynomial."""
    if np.ndim(before := getattr(joint, attribute)):
        setattr(joint, attribute, [value, *[0.0] * (len(before) - 1)])
    else:
        setattr(joint, attribute, value)


def _write_bodies(spec: mujoco.MjSpec, plain: ManagerBasedRLEnv, env: ManagerBasedRLEnv) -> list[str]:
    """Write the rigid bodies that effects have changed; returns their names."""
    model, changed = env.sim.model, []
    for b in range(1, model.nbody):
        before = {field: plain.sim.expand(field)[0, b] for field in _BODY_FIELDS}
        after = {field: env.sim.expand(field)[0, b] for field in _BODY_FIELDS}
        if all(torch.allclose(before[f], after[f], rtol=1e-12, atol=1e-15) for f in _BODY_FIELDS):
            continue
        body = spec.body(model.body(b).name)
        changed.append(body.name)
        body.explicitinertial = True
        body.mass = float(after["body_mass"])
        body.inertia, body.fullinertia = after["body_inertia"].numpy(), np.full(6, np.nan)
        body.ipos, body.iquat = after["body_ipos"].numpy(), after["body_iquat"].numpy()
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
