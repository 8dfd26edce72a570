"""Identified drives as Newton's actuators: delay of the command, PD control, clamping."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping

from pace_actuators import IdentifiedDrives
from pace_actuators.representable import link_notes
from pace_envs.generated_python import python_page
from pace_optim.export import newton_template
from pace_optim.export.configs import about, digits
from pace_optim.export.plain_drive import (
    GAIN_EFFECTS,
    PlainDrive,
    effect_notes,
    in_plain_steps,
    joint_values,
    plain_drives,
    whole_steps_note,
)

HELD = (*GAIN_EFFECTS, "parallel_spring", "torque_offset")
"""Effects that the page holds."""
_START = "# --- the page starts here\n"


def newton_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """A page that needs Newton alone: drives for a ``newton.ModelBuilder``, or for a USD stage.

    The encoder's bias is a constant torque before the clamps, kp · bias: exact, as targets are the encoder's. So is a
    torque offset, but where a clamp acts. A spring beside the drive is the joint's.
    """
    plain, notes = plain_drives(drives)
    plain, armatures, changed = in_plain_steps(drives, plain)
    notes = [*notes, *changed, *_notes(drives, plain), *effect_notes(drives, HELD), *link_notes(drives)]
    names = {"friction": "friction", "viscous_friction": "damping"}
    joints = {
        joint: ({"armature": armatures[joint]} if joint in armatures else {})
        | joint_values(drives, joint, names)
        | ({"stiffness": drive.spring, "rest_q": drive.rest} if drive.spring else {})
        for joint, drive in plain.items()
    }
    values = {
        "_ABOUT_": about(drives, ", for Newton 1.8", notes),
        "_PHYSICS_DT_": drives.at.physics_dt,
        "_JOINTS_": _table(joints),
        "_DRIVES_": _table({joint: _parts(drive) for joint, drive in plain.items()}),
    }
    return python_page(_HEAD + inspect.getsource(newton_template).split(_START)[1], values), notes


_HEAD = '''\
_ABOUT_

PHYSICS_DT = _PHYSICS_DT_
"""Step of the identification [s]."""

JOINTS = _JOINTS_
"""Armature [kg m²], Coulomb friction [N m], damping [N m s/rad]; of a slide [kg], [N], [N s/m].

A spring beside the drive: stiffness [N m/rad] and rest_q [rad]."""

DRIVES = _DRIVES_
"""Delay [s], control law and clamp, in SI units."""
'''


def _parts(drive: PlainDrive) -> dict[str, float]:
    parts = {"delay_s": drive.delay_s, "kp": drive.stiffness, "kd": drive.damping}
    parts["const_effort"] = drive.stiffness * drive.encoder_bias + drive.offset
    limit = drive.effort_limit
    if drive.has_line:
        parts |= {"saturation_effort": drive.saturation_effort, "velocity_limit": drive.velocity_limit}
        parts |= {"max_motor_effort": limit} if math.isfinite(limit) else {}
    elif math.isfinite(limit):
        parts["max_effort"] = limit
    return parts


def _notes(drives: IdentifiedDrives, plain: Mapping[str, PlainDrive]) -> list[str]:
    dt, notes = drives.at.physics_dt, whole_steps_note(drives, plain)
    most = max((abs(drive.encoder_bias) for drive in plain.values()), default=0.0)
    notes.append(
        f"encoder bias (up to {most:.3g} rad, of slides m): in const_effort. Targets are the encoder's, joint "
        "positions are true: observe q - bias."
    )
    if any(drive.spring for drive in plain.values()):
        notes.append("parallel_spring: add_actuators writes it; a USD stage has no place for it.")
    if any(drive.offset for drive in plain.values()):
        notes.append("torque_offset: in const_effort, which the limits clamp too.")
    rates = {drive.run_dt for drive in plain.values()}
    if 0.0 in rates:
        notes.append("the drive ran continuously (implicit): use Newton's implicit effort mode.")
    held = max((drive.run_dt for drive in plain.values() if not drive.second_order), default=0.0)
    if any(drive.second_order for drive in plain.values()):
        notes.append(f"step the actuators with the physics, every {1e3 * dt:.3g} ms.")
    elif held > dt * (1 + 1e-9):
        notes.append(f"the controller ran every {1e3 * held:.3g} ms: step the actuators at that rate.")
    notes.append("joint friction: its solver's time constant is the simulation's (MuJoCo's: solreffriction).")
    return notes


def _table(values: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    return {joint: {name: digits(value) for name, value in row.items()} for joint, row in values.items()}
