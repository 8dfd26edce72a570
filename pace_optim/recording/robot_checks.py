"""Checks of a recording against the robot that it claims to show: joints, limits, loads."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TypeVar

import numpy as np

from pace_actuators.joint_units import JointType, all_hinges, units_for
from pace_actuators.text import listed

from .data import Recording
from .keys import COMMAND_SERIES, did_you_mean

_STILL = 2e-3  # [rad, of slides m]
_FAR = 0.5  # [rad, of slides m]
_T = TypeVar("_T")
_DEGREES = "The values look like degrees: multiply them by pi/180."


def column_order(
    recording: Recording, joint_order: Sequence[str], undriven: Collection[str] = ()
) -> tuple[list[int], list[str]]:
    """Return the column of each joint of `joint_order`, and notes; `undriven` joints of the model have no drive."""
    names, source = recording.joint_names, recording.label
    if not names:
        if recording.num_joints != len(joint_order):
            raise ValueError(
                f"{source}: has {recording.num_joints} joints (columns of dof_pos) but the robot has "
                f"{len(joint_order)} ({listed(joint_order)}). Record these joints, or choose the robot's "
                "task."
            )
        return list(range(len(joint_order))), [
            f"The file has no joint_names: its columns were taken to be {listed(joint_order)}."
        ]
    unknown = [name for name in names if name not in joint_order]
    missing = [name for name in joint_order if name not in names]
    if unknown or missing:
        found = [
            f"the joint '{name}' has no drive in the model: give it a transmission (URDF) or an actuator (MJCF)."
            if name in undriven
            else f"unknown joint '{name}'{did_you_mean(name, missing)}"
            for name in unknown[:3]
        ]
        found += [f"no column for {listed(missing)}."] if missing else []
        raise ValueError(
            f"{source}: {' '.join(found)} The recording has {len(names)} joints ({listed(names)}), the robot "
            f"has {len(joint_order)} ({listed(joint_order)}). Rename the columns, choose the robot's task, or name the "
            "joints to identify with --joints."
        )
    return [names.index(name) for name in joint_order], []


def check_load(recording: Recording, load_bodies: Collection[str], accepts_load: bool) -> None:
    """Refuse a load that the robot's model cannot carry."""
    load, source = recording.load, recording.label
    for body in load.added_mass:
        if body not in load_bodies:
            raise ValueError(
                f"{source}: added_mass names the unknown body '{body}'{did_you_mean(body, load_bodies)} "
                f"Bodies that take a mass: {listed(load_bodies)}. Correct the name."
            )
    bench = [key for key in ("load_mass", "load_length", "arm_mass") if getattr(load, key) is not None]
    if bench and not accepts_load:
        raise ValueError(
            f"{source}: holds {listed(bench)}, which belong to the test bench; this robot has no such load. "
            "Use added_mass {body: kg}, or the task Pace-TestBench-v0."
        )


def check_motion(
    recording: Recording, limits: np.ndarray | None, limit_margin: float, joint_types: Sequence[JointType] = ()
) -> list[str]:
    """Refuse positions that the robot cannot have; return notes on what is odd but possible."""
    types = joint_types or all_hinges(recording.num_joints)
    turns = np.array([each == "hinge" for each in types])
    _check_wraps(recording, turns)
    notes: list[str] = []
    if limits is not None:
        notes += _check_limits(recording, np.asarray(limits, dtype=np.float64), limit_margin, types)
    names = recording.joint_names
    position, commanded = recording.dof_pos, recording.has_position_command
    target = np.where(commanded, position[:1] if recording.des_dof_pos is None else recording.des_dof_pos, position[:1])
    doubted = np.array([name not in recording.unit_stated for name in names])
    if turning := _those(names, turns & doubted & commanded & (np.abs(position).max(axis=0) > 8.0 * np.pi)):
        notes.append(f"{listed(turning)}: more than four turns from zero. {_DEGREES.replace('The values', 'If they')}")
    still = np.ptp(position, axis=0) < _STILL
    if any(still):
        least = units_for(f"{_STILL * 1e3:g} mrad", _those(types, still))
        notes.append(
            f"{listed(_those(names, still))}: moves less than {least}, so its parameters cannot be found from this "
            "recording."
        )
    if uncommanded := _those(names, commanded & _still_commanded(recording) & ~still):
        notes.append(f"{listed(uncommanded)}: moves although its command never changes.")
    far = np.abs(position[0] - target[0]) > _FAR
    if any(far):
        most = units_for(f"{_FAR:g} rad", _those(types, far))
        notes.append(
            f"{listed(_those(names, far))}: starts more than {most} from its target; the first instants are a "
            "transient."
        )
    if recording.torque_enable is not None and not recording.torque_enable.all():
        notes.append(f"The drive is off in {np.mean(~recording.torque_enable):.0%} of the samples.")
    return notes


def _check_wraps(recording: Recording, turns: np.ndarray) -> None:
    jump = np.where(turns, np.abs(np.diff(recording.dof_pos, axis=0)), 0.0)
    wraps = np.argwhere(np.abs(jump - 2.0 * np.pi) < 0.3)
    if len(wraps):
        sample, joint = wraps[0]
        raise ValueError(
            f"{recording.label}: dof_pos of {recording.joint_names[joint]} jumps by "
            f"{jump[sample, joint]:.3f} rad between samples {sample} and {sample + 1}; expected a steady "
            "position. The encoder wraps there: apply numpy.unwrap."
        )


def _check_limits(recording: Recording, limits: np.ndarray, margin: float, types: Sequence[JointType]) -> list[str]:
    names, source = recording.joint_names, recording.label
    if limits.shape != (len(names), 2) or np.any(np.isnan(limits)) or np.any(limits[:, 0] > limits[:, 1]):
        raise ValueError(
            f"joint_pos_limits has shape {limits.shape}; expected ({len(names)}, 2), lower and upper limit "
            "[rad] of each joint in joint_order, infinite without a limit. Correct the argument."
        )
    excess = {
        key: np.maximum(limits[:, 0] - values.min(axis=0), values.max(axis=0) - limits[:, 1])
        for key, values in (("dof_pos", recording.dof_pos), ("des_dof_pos", recording.des_dof_pos))
        if values is not None
    }
    for key, allowed in (("dof_pos", margin), ("des_dof_pos", 2.0 * np.pi)):
        if key in excess and np.any(excess[key] > allowed):
            joint = int(np.nanargmax(excess[key]))
            values = getattr(recording, key)[:, joint]
            unit = units_for("rad", [types[joint]])
            cure = "Check the column order, the signs and the zero, or the model's limits."
            stated = names[joint] in recording.unit_stated
            if types[joint] == "hinge" and np.abs(values).max() > 2.0 * np.pi and not stated:
                cure = _DEGREES
            raise ValueError(
                f"{source}: {key} of {names[joint]} goes from {values.min():.3f} to {values.max():.3f} {unit}; "
                f"expected {limits[joint, 0]:.3f} to {limits[joint, 1]:.3f} {unit}, the joint's limits (and at "
                f"most {allowed:.3g} beyond). {cure}"
            )
    if "des_dof_pos" in excess and (beyond := _those(names, excess["des_dof_pos"] > 0.0)):
        unit = units_for("rad", [each for each, name in zip(types, names, strict=True) if name in beyond])
        most = np.nanmax(excess["des_dof_pos"])
        return [f"{listed(beyond)}: commanded beyond the joint limits, by {most:.3f} {unit}."]
    return []


def _still_commanded(recording: Recording) -> np.ndarray:
    """Which joints get a constant command, (n,) bool."""
    still = np.ones(recording.num_joints, dtype=bool)
    for key in COMMAND_SERIES:
        if (values := getattr(recording, key)) is not None:
            still &= ~(np.ptp(values, axis=0) > 0.0)
    return still


def _those(names: Sequence[_T], where: np.ndarray) -> list[_T]:
    return [name for name, flag in zip(names, where, strict=True) if flag]
