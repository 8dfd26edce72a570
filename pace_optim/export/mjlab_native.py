"""Identified drives as mjlab's own actuators, for those who want no code of this project there."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Any

from pace_actuators import IdentifiedDrives
from pace_actuators.representable import link_notes
from pace_envs.generated_python import Call, python_page
from pace_optim.export import mjlab_native_template
from pace_optim.export.configs import about, digits
from pace_optim.export.plain_drive import (
    GAIN_EFFECTS,
    PlainDrive,
    effect_notes,
    in_plain_steps,
    joint_values,
    plain_drives,
    soft_frictions,
    whole_steps_note,
)

HELD = (*GAIN_EFFECTS, "parallel_spring", "quadratic_friction", "soft_friction")
"""Effects that the page holds."""
_START = "# --- the page starts here\n"


def mjlab_native_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """A page that needs mjlab alone: an actuator per joint, with mjlab's delay fields; friction; encoder bias."""
    plain, notes = plain_drives(drives)
    plain, armatures, changed = in_plain_steps(drives, plain)
    notes = [*notes, *changed, *_notes(drives, plain), *effect_notes(drives, HELD), *link_notes(drives)]
    calls = [mjlab_actuator(drives, joint, drive, armatures.get(joint)) for joint, drive in plain.items()]
    values = {
        "_ABOUT_": about(drives, ", for mjlab 1.6 alone", notes),
        "_PHYSICS_DT_": drives.at.physics_dt,
        "_ACTUATORS_": tuple(calls),
        "_BESIDE_": {
            joint: {name: digits(getattr(drive, name)) for name in ("spring", "rest", "quadratic")}
            for joint, drive in plain.items()
            if drive.spring or drive.quadratic
        },
        "_SOFT_": {joint: tuple(map(digits, pair)) for joint, pair in soft_frictions(drives).items()},
        "_BIAS_": {joint: digits(-drive.encoder_bias) for joint, drive in plain.items() if drive.encoder_bias},
    }
    classes = ", ".join(sorted({call.name for call in calls}))
    functions = inspect.getsource(mjlab_native_template).split(_START)[1]
    return python_page(_HEAD.replace("CLASSES", classes) + functions, values), notes


_HEAD = '''\
_ABOUT_

from mjlab.actuator import CLASSES
from mjlab.entity import EntityArticulationInfoCfg
from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

PHYSICS_DT = _PHYSICS_DT_
"""Set MujocoCfg(timestep=PHYSICS_DT): delays count these steps [s]."""

ACTUATORS = _ACTUATORS_
ARTICULATION = EntityArticulationInfoCfg(actuators=ACTUATORS)
"""For EntityCfg(articulation=ARTICULATION)."""

ENCODER_BIAS = _BIAS_
"""mjlab's encoder shows q + these [rad, of slides m]."""

SOFT_FRICTION = _SOFT_
"""Joints whose Coulomb friction is soft: time constant [s] and impedance of MuJoCo's constraint."""

BESIDE = _BESIDE_
"""Torques beside the drives: spring k [N m/rad] and rest q₀ [rad], quadratic b₂: - k (q - q₀) - b₂ v |v|."""
'''


def mjlab_actuator(drives: IdentifiedDrives, joint: str, drive: PlainDrive, armature: float | None) -> Call:
    """The call that makes a joint's actuator, by the class of mjlab that holds this kind of drive."""
    return Call(name=_class(drive), values=_fields(drives, joint, drive, armature))


def _class(drive: PlainDrive) -> str:
    if drive.has_line:
        return "DcMotorActuatorCfg"
    if drive.run_dt:
        return "IdealPdActuatorCfg"
    return "BuiltinPositionActuatorCfg" if drive.stiffness else "BuiltinVelocityActuatorCfg"


def _fields(drives: IdentifiedDrives, joint: str, drive: PlainDrive, armature: float | None) -> dict[str, Any]:
    values: dict[str, float] = {"stiffness": drive.stiffness} if drive.stiffness or drive.run_dt else {}
    values["damping"] = drive.damping
    if math.isfinite(drive.effort_limit):
        values["effort_limit"] = drive.effort_limit
    if drive.has_line:
        values |= {"stiffness": drive.stiffness, "saturation_effort": drive.saturation_effort}
        values["velocity_limit"] = drive.velocity_limit
    if armature is not None:
        values["armature"] = armature
    values |= joint_values(drives, joint, {"friction": "frictionloss", "viscous_friction": "viscous_damping"})
    return {
        "target_names_expr": (_expression(joint),),
        **{name: digits(v) for name, v in values.items()},
        **_lags(drives, drive),
    }


def _lags(drives: IdentifiedDrives, drive: PlainDrive) -> dict[str, int | bool]:
    """Delay and jitter of commands in physics steps; one that jitters is drawn again with each command."""
    dt, timing = drives.at.physics_dt, drives.command_timing
    early, late = (0.0, 0.0) if timing is None else (timing.early_s, timing.late_s)
    least, most = max(0, round((drive.delay_s - early) / dt)), round((drive.delay_s + late) / dt)
    lags: dict[str, int | bool] = {"delay_min_lag": least, "delay_max_lag": most} if most else {}
    if timing is not None and most > least:
        lags |= {"delay_update_period": max(1, round(timing.interval_s / dt)), "delay_per_env_phase": False}
    return lags


def _expression(joint: str) -> str:
    """The joint's name as the regular expression that mjlab takes it for."""
    return "".join(f"\\{letter}" if letter in r".^$*+?{}[]\|()" else letter for letter in joint)


def _notes(drives: IdentifiedDrives, plain: Mapping[str, PlainDrive]) -> list[str]:
    dt, notes = drives.at.physics_dt, whole_steps_note(drives, plain)
    most = max((abs(drive.encoder_bias) for drive in plain.values()), default=0.0)
    notes.append(f"encoder bias (up to {most:.3g} rad, of slides m): add EVENTS to the environment's events.")
    notes.append("Coulomb friction is soft by default: call write_joints(spec) in your spec_fn, for springs too.")
    if drives.command_timing is not None and drives.command_timing.lost > 0:
        notes.append(f"{100 * drives.command_timing.lost:.2g} % of the commands were lost: mjlab loses none.")
    rates = {drive.run_dt for drive in plain.values()}
    if 0.0 in rates and any(drive.has_line for drive in plain.values()):
        notes.append(
            "the drive ran continuously (implicit): with a torque-speed line mjlab holds its torque over a step."
        )
    elif 0.0 in rates:
        notes.append("the drive ran continuously (implicit): keep mjlab's integrator implicitfast.")
    held = max((drive.run_dt for drive in plain.values() if not drive.second_order), default=0.0)
    if held > dt * (1 + 1e-9):
        notes.append(f"the controller ran every {1e3 * held:.3g} ms: mjlab's runs at each step of {1e3 * dt:g} ms.")
    return notes
