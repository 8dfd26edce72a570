"""Identified drives as MuJoCo's own actuators.

    τ = clip(kp (ctrl - q_enc) - kd q̇, ± limit, torque-speed line),    ctrl delayed

A drive with a torque-speed line is a ``dcmotor`` with its on-board controller. Its terminal voltage, back-EMF and
current limit are exactly the four-quadrant clip of ``PaceDCMotor``. A drive without that line is a ``position`` servo
(``velocity`` if kp is 0, ``motor`` if kd is 0 too). The encoder's bias is in the joint's ``ref``: positions, targets
and sensors of the model are what the encoder shows. Torques beside the drive's are the joint's (of a motor that moves
several, its tendon's): ``stiffness`` with ``springref``, the second coefficient of ``damping``, and an actuator
``NAME_offset`` of constant force.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import numpy as np

from pace_envs.from_model.couplings import followed_ratio
from pace_envs.motor_coordinates import DrivenJoints, Rows
from pace_optim.export.plain_drive import PlainDrive

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
