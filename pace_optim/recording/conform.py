"""Bring a recording onto a robot's joints and a simulation's control grid."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np

from pace_actuators.joint_units import JointType, all_hinges, radians, units_for
from pace_actuators.text import listed
from pace_envs.motor_coordinates import DrivenJoints

from .checks import MIN_SAMPLES, refuse_uncommanded
from .commands import GRID_COMMANDS, command_interval, commands_on_grid, timing_note
from .data import Drive, Recording
from .gaps import from_first_command
from .keys import COMMAND_SERIES, CONDITIONS, FEET_SERIES, JOINT_SERIES, did_you_mean
from .time_base import (
    TimeBase,
    fit_time_base,
    hold_on_grid,
    interpolate_linear,
    interpolate_nearest,
    interpolate_smooth,
)

_EARLY = 0.02
"""Part of a control step by which a torque that a loop gives may be stamped before it, as stamps jitter."""


def conform_recording(
    recording: Recording,
    *,
    joint_order: Sequence[str],
    control_dt: float,
    joint_pos_limits: np.ndarray | None = None,
    limit_margin: float = 0.2,
    joint_types: Sequence[JointType] = (),
    load_bodies: Collection[str] = (),
    accepts_load: bool = False,
    undriven: Collection[str] = (),
) -> Recording:
    """Return the recording with columns in `joint_order` and samples on the grid of the control.

    1. Check joints and load against the robot; put columns (and the drive's values) in `joint_order`.
    2. Check the motion: limits, units, wraps; note what is odd.
    3. Compare the time stamps with the grid of spacing `sample_stride * control_dt`: keep the samples bit for
       bit when they lie on it, or beside it where an even timer is slower than the control; else resample them.
    4. Fill `command`, `command_vel`, `command_effort` and `command_torque_enable` on the control grid. Commands with
       a separate clock are held at their true instants; samples before the first of them are left out.

    A recording that is already conformed to `control_dt` keeps its samples and commands.

    Args:
        recording: As `load_recording` gives it.
        joint_order: The robot's joints, in the order wanted.
        control_dt: Control step of the simulation [s].
        joint_pos_limits: Lower and upper limit per joint of `joint_order`, (n, 2) [rad]; infinite where none.
        limit_margin: How far a position may lie beyond its limit [rad] (encoder bias, soft stops); of a slide, a tenth
            of it [m].
        joint_types: Whether each joint of `joint_order` turns or slides; none: all turn.
        load_bodies: Bodies that `added_mass` may name.
        accepts_load: Whether the robot has the test bench's load (load_mass, load_length, arm_mass).
        undriven: Joints of the model that no drive moves.
    """
    if not (np.isfinite(control_dt) and control_dt > 0.0):
        raise ValueError(f"control_dt is {control_dt}; expected a time above zero [s]. Correct the argument.")
    if len(set(joint_order)) != len(joint_order):
        raise ValueError(f"joint_order names a joint twice: {listed(joint_order)}. Name each joint once.")
    check_load(recording, load_bodies, accepts_load)
    columns, notes = column_order(recording, joint_order, undriven)
    recording = with_columns(recording, columns, tuple(joint_order))
    if not recording.is_commanded.all():
        refuse_uncommanded(recording, joint_order)
    notes += check_motion(recording, joint_pos_limits, limit_margin, joint_types)
    if recording.command is not None:
        _check_conformed(recording, control_dt)
        return recording
    recording = from_first_command(recording)
    origin = recording.start_stamp
    # what a torque says of its drive is read from even samples
    base = fit_time_base(recording.time, control_dt, recording.label, may_place=recording.dof_effort is None)
    if base.num_samples < MIN_SAMPLES or base.num_steps < MIN_SAMPLES:
        raise ValueError(
            f"{recording.label}: lasts {recording.duration:.3g} s, {base.num_steps} control steps of "
            f"{1e3 * control_dt:.3g} ms; expected at least {MIN_SAMPLES}. Record for longer, or check that time is in "
            "seconds."
        )
    if base.sample_at is not None:
        on_grid = _placed(recording, base, control_dt)
    else:
        on_grid = _kept(recording, base) if base.exact else _resampled(recording, base, control_dt)
        on_grid["time"] = control_dt * base.sample_steps
    on_grid |= commands_on_grid(recording, base, control_dt)
    return replace(
        recording,
        **on_grid,
        time_origin=origin,
        sample_stride=base.sample_stride,
        command_dt=command_interval(recording),
        logged=None if base.exact and recording.des_time is None else recording,
        notes=(*recording.notes, *base.notes, *filter(None, [timing_note(recording)]), *notes),
    )


def with_columns(recording: Recording, columns: Sequence[int], joint_order: tuple[str, ...]) -> Recording:
    """The same with these columns, of joints of these names."""
    columns = list(columns)

    def take(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else array[..., columns]

    by_joint = (*JOINT_SERIES, *GRID_COMMANDS.values(), "free")
    series: dict[str, Any] = {key: take(getattr(recording, key)) for key in by_joint}
    drive = Drive(**{f.name: take(getattr(recording.drive, f.name)) for f in fields(Drive)})
    return replace(recording, joint_names=joint_order, drive=drive, **series)


def _check_conformed(recording: Recording, control_dt: float) -> None:
    if abs(recording.control_dt / control_dt - 1.0) > 1e-6:
        raise ValueError(
            f"{recording.label}: is already on a control step of {recording.control_dt:g} s; expected a recording as "
            f"loaded, or one on {control_dt:g} s. Conform the loaded recording."
        )


def _kept(recording: Recording, base: TimeBase) -> dict[str, Any]:
    """The samples as they are; whether the drive is on repeated over the control steps of a sample."""
    stride, count = base.sample_stride, base.num_steps
    enable = recording.torque_enable
    return {"command_torque_enable": None if enable is None else np.repeat(enable, stride)[:count]}


def _placed(recording: Recording, base: TimeBase, control_dt: float) -> dict[str, Any]:
    """The samples as they are, each beside the nearest step of the grid; whether the drive is on by its hold."""
    stamps = recording.time - recording.time[0]
    return {
        "time": stamps,
        "sample_at": base.sample_at,
        "sample_offset": stamps / control_dt - base.sample_steps,
        "command_torque_enable": _enabled(recording, base, control_dt),
    }


def _enabled(recording: Recording, base: TimeBase, control_dt: float) -> np.ndarray | None:
    """Whether the drive is on for most of each control step, (steps,) bool."""
    if recording.torque_enable is None:
        return None
    on = recording.torque_enable[:, None].astype(np.float64)
    return hold_on_grid(recording.time - recording.time[0], on, control_dt, base.num_steps)[:, 0] >= 0.5


def _resampled(recording: Recording, base: TimeBase, control_dt: float) -> dict[str, Any]:
    """The samples on the grid."""
    stride, stamps = base.sample_stride, recording.time - recording.time[0]
    at = np.minimum(stride * control_dt * np.arange(base.num_samples), stamps[-1])
    result: dict[str, Any] = {}
    for key, interpolate in (
        ("dof_pos", interpolate_smooth),
        ("dof_vel", interpolate_smooth),
        *((key, interpolate_linear) for key in CONDITIONS),
        ("real_ee_pose", interpolate_linear),
        ("base_ang_vel", interpolate_linear),
        ("base_lin_acc", interpolate_linear),
        *((key, interpolate_nearest) for key in ("base_quat", *FEET_SERIES)),
    ):
        if (values := getattr(recording, key)) is not None:
            result[key] = interpolate(stamps, values, at)
    if recording.dof_effort is not None:  # it may jump: its samples keep their instants
        following = np.searchsorted(stamps, at - _EARLY * control_dt).clip(max=len(stamps) - 1)
        result["dof_effort"] = recording.dof_effort[following]
        result["effort_offset"] = np.maximum(stamps[following] - at, 0.0) / control_dt
    if (on := _enabled(recording, base, control_dt)) is not None:
        result |= {"command_torque_enable": on, "torque_enable": on[::stride]}
    return result


_MOTION = ("dof_pos", "des_dof_pos", "dof_vel", "des_dof_vel")
_EFFORT = ("dof_effort", "des_dof_effort")


def of_motors(recording: Recording, driven: DrivenJoints) -> Recording:
    """The recording with the columns of motors in place of those of the joints that they move together.

    Positions and speeds are those of the motors, q_m = R q, and torques do the same work, τ_m = R⁻ᵀ τ. Values of the
    drives beside the recording (gains, limits) are taken as the motors', in the order of these columns.

    Args:
        recording: Of joints or of motors; the latter, and one without all the joints of a motor, stay as they are.
    """
    place = dict(zip(driven.joints, driven.names, strict=True))
    rows = {name: driven.row_of(name) for name in driven.names}
    motors = [name for name, joint in zip(driven.names, driven.joints, strict=True) if name != joint]
    moved = {joint for name in motors for joint in rows[name]}
    names = recording.joint_names
    if not motors or not moved <= set(names) or set(motors) & set(names):
        return recording
    back = {
        joint: {name: ratio for name, ratio in zip(driven.names, column, strict=True) if ratio}
        for joint, column in zip(driven.joints, driven.inverse.tolist(), strict=True)
    }
    series = {}
    for key in (*_MOTION, *_EFFORT):
        if (values := getattr(recording, key)) is not None:
            turned = values.astype(np.float64)
            for joint in moved:
                row = rows[place[joint]] if key in _MOTION else _efforts(place[joint], back)
                turned[..., names.index(joint)] = _sum(values, names, row)
            series[key] = turned
    order = sorted(moved, key=names.index)
    note = (
        f"{listed(order)}: turned into their motors {listed([place[joint] for joint in order])}, whose gains and "
        "limits the values beside the log are, in this order."
    )
    return replace(
        recording,
        **series,
        joint_names=tuple(place.get(name, name) if name in moved else name for name in names),
        unit_stated=tuple(place.get(name, name) if name in moved else name for name in recording.unit_stated),
        notes=(*recording.notes, note),
    )


def _efforts(motor: str, back: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """How a motor's torque follows from those of joints, τ_m = Σ (∂q_joint/∂q_m) τ_joint."""
    return {joint: row[motor] for joint, row in back.items() if motor in row}


def _sum(values: np.ndarray, names: tuple[str, ...], row: Mapping[str, float]) -> np.ndarray:
    """Σ ratio x_joint; NaN where one of these has none."""
    return sum((ratio * values[..., names.index(joint)] for joint, ratio in row.items()), start=np.zeros(()))


_STILL = 2e-3  # [rad, of slides m]
_FAR = 0.5  # [rad, of slides m]
_FURTHEST = 2.0 * np.pi
"""Positions and commands further beyond a limit are in another unit, or of another joint [rad, of slides m]."""
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
        found += [note for note in recording.notes if note.startswith("Not used:")]
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
    margins = margin * np.array(radians(types))
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
    over = (excess["dof_pos"] > margins) & (excess["dof_pos"] <= _FURTHEST)
    doubted = np.array([name not in recording.unit_stated for name in names])
    kept = over & (_swings_beyond(recording, limits, margins) | (~doubted & (2 * over.sum() < max(len(names), 3))))
    for key, allowed in (
        ("dof_pos", np.where(kept, _FURTHEST, margins)),
        ("des_dof_pos", np.full(len(names), _FURTHEST)),
    ):
        if key in excess and np.any(excess[key] > allowed):
            joint = int(np.nanargmax(np.where(excess[key] > allowed, excess[key], -np.inf)))
            values = getattr(recording, key)[:, joint]
            unit = units_for("rad", [types[joint]])
            cure = "Check the column order, the signs and the zero, or the model's limits."
            if types[joint] == "hinge" and np.abs(values).max() > 2.0 * np.pi and doubted[joint]:
                cure = _DEGREES
            raise ValueError(
                f"{source}: {key} of {names[joint]} goes from {values.min():.3f} to {values.max():.3f} {unit}; "
                f"expected {limits[joint, 0]:.3f} to {limits[joint, 1]:.3f} {unit}, the joint's limits (and at "
                f"most {allowed[joint]:.3g} beyond). {cure}"
            )
    notes = [_limit_passed(recording, joint, limits[joint], types[joint]) for joint in np.flatnonzero(kept).tolist()]
    if "des_dof_pos" in excess and (beyond := _those(names, excess["des_dof_pos"] > 0.0)):
        unit = units_for("rad", [each for each, name in zip(types, names, strict=True) if name in beyond])
        furthest = np.nanmax(excess["des_dof_pos"])
        notes.append(f"{listed(beyond)}: commanded beyond the joint limits, by {furthest:.3f} {unit}.")
    return notes


def _swings_beyond(recording: Recording, limits: np.ndarray, margins: np.ndarray) -> np.ndarray:
    """Which joints pass their limits by a swing about their commands, and not by a wrong zero, (n,) bool."""
    if (target := recording.des_dof_pos) is None:
        return np.zeros(recording.num_joints, dtype=bool)
    within = (target.min(axis=0) >= limits[:, 0] - margins) & (target.max(axis=0) <= limits[:, 1] + margins)
    if len(target) != recording.num_samples:
        clock = np.linspace(recording.time[0], recording.time[-1], len(target))
        clock = clock if recording.des_time is None else recording.des_time
        target = target[np.clip(np.searchsorted(clock, recording.time, side="right") - 1, 0, None)]
    centred = recording.dof_pos - np.median(recording.dof_pos - target, axis=0)
    beyond = np.maximum(limits[:, 0] - centred.min(axis=0), centred.max(axis=0) - limits[:, 1])
    return within & (beyond > margins)


def _limit_passed(recording: Recording, joint: int, limits: np.ndarray, joint_type: JointType) -> str:
    """That a joint passes the limit that the model states, and what to do."""
    low, high = recording.dof_pos[:, joint].min(), recording.dof_pos[:, joint].max()
    value, limit = (low, limits[0]) if limits[0] - low > high - limits[1] else (high, limits[1])
    return (
        f"{recording.joint_names[joint]} reaches {value:.3f}, beyond its limit of {limit:.3f} "
        f"{units_for('rad', [joint_type])} in the model. Correct the limit in the model file. [W2]"
    )


def _still_commanded(recording: Recording) -> np.ndarray:
    """Which joints get a constant command, (n,) bool."""
    still = np.ones(recording.num_joints, dtype=bool)
    for key in COMMAND_SERIES:
        if (values := getattr(recording, key)) is not None:
            still &= ~(np.ptp(values, axis=0) > 0.0)
    return still


def _those(names: Sequence[_T], where: np.ndarray) -> list[_T]:
    return [name for name, flag in zip(names, where, strict=True) if flag]
