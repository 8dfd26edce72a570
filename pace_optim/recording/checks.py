"""Checks of a file's content on its own: keys, types, shapes, lengths, numbers, the time base's unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pace_actuators.text import listed

from .data import Recording
from .facts import as_array, check_one_line, couplings_of, drive_of, feet_of, imu_of, joint_names_of, load_of
from .keys import BASE_COLUMNS, COMMAND_SERIES, FACTS, JOINT_SERIES, POSE_COLUMNS, SERIES, closest
from .time_base import seconds_of, set_back, unrounded

_HUGE = 1e6
"""No joint turns so far or so fast [rad], [rad/s]."""
_FASTEST = 2e-5
"""Steps of the fastest current loops [s]."""
MIN_SAMPLES = 20
"""Fewer samples than this are not a recording."""


def check_recording(
    fields: Mapping[str, Any], *, source: str, default_name: str = "", found: Sequence[str] = ()
) -> Recording:
    """Check a file's fields and return them as a `Recording`.

    Args:
        fields: The file's keys and values; array-likes, text, numbers, dicts.
        default_name: The recording's name when the fields hold none.
        found: What the file calls its fields (a CSV's columns), for messages; default: the keys.
    """
    notes = _check_keys(fields, source, found or tuple(fields))
    time, origin, kind = _stamps("time", fields["time"], source)
    time, rounded = unrounded(time)
    notes += [rounded] if rounded else []
    notes += [f"time holds {kind}: counted from its first sample here."] if kind else []
    des_time = _command_time(fields.get("des_time"), time, origin, source)
    clocks = {} if des_time is None else dict.fromkeys(COMMAND_SERIES, ("des_time", des_time))
    series: dict[str, Any] = {
        key: _joint_series(key, fields[key], *clocks.get(key, ("time", time)), source)
        for key in JOINT_SERIES
        if fields.get(key) is not None
    }
    num_joints = series["dof_pos"].shape[1]
    for key, array in series.items():
        if array.shape[1] != num_joints:
            raise ValueError(
                f"{source}: {key} has {array.shape[1]} columns but dof_pos has {num_joints}. "
                "Give every series one column per joint."
            )
    joint_names = joint_names_of(fields.get("joint_names"), num_joints, source)
    pose = fields.get("real_ee_pose")
    enable = fields.get("torque_enable")
    torque_enable = None if enable is None else _torque_enable(enable, len(time), source)
    for key, array in series.items():
        _check_finite(key, array, joint_names, source)
    if len(time) < MIN_SAMPLES:
        raise ValueError(
            f"{source}: found {len(time)} samples; expected at least {MIN_SAMPLES}. Record for longer (20 s is usual)."
        )
    _check_time("time", time, source)
    name = fields.get("name", default_name)
    if not isinstance(name, str) or not name:
        raise ValueError(f"{source}: name is {name!r}; expected text. Correct it or leave it out.")
    check_one_line("name", name, source)
    recording = Recording(
        name=name,
        joint_names=joint_names,
        time=time,
        **series,
        des_time=des_time,
        torque_enable=torque_enable,
        real_ee_pose=None if pose is None else _pose(pose, len(time), source),
        **_base(fields, len(time), source),
        time_origin=_origin(fields.get("time_origin"), origin, source),
        load=load_of(fields, source),
        notes=tuple(notes),
        source=source,
    )
    recording = replace(recording, drive=drive_of(fields, joint_names, recording.is_commanded, source))
    _check_commands(recording)
    return recording


def _check_keys(fields: Mapping[str, Any], source: str, found: Sequence[str]) -> list[str]:
    """Refuse misspelt and missing keys; return a note on keys that are not ours."""
    known = (*SERIES, *FACTS)
    ignored = [key for key in fields if key not in known]
    for key in ignored:
        meant = closest(str(key), known)
        if meant and meant not in fields:
            raise ValueError(
                f"{source}: unknown key '{key}', did you mean '{meant}'? Rename it, or leave it out. "
                f"Found: {listed(found)}."
            )
    commands = [key for key in COMMAND_SERIES if fields.get(key) is not None]
    missing = [key for key in ("time", "dof_pos") if fields.get(key) is None] + ([] if commands else ["des_dof_pos"])
    if missing:
        raise ValueError(
            f"{source}: {listed(missing)} missing; expected time (T,) [s], dof_pos (T, n) and des_dof_pos "
            "(T, n) [rad] (or des_dof_vel [rad/s], des_dof_effort [N m]); in a CSV the columns are time, "
            f"dof_pos/<joint>, des_dof_pos/<joint>. Found: {listed(found)}. Rename or add what is missing."
        )
    if fields.get("des_time") is not None and not commands:
        raise ValueError(f"{source}: des_time has no commands to go with it. Add des_dof_pos, or leave it out.")
    return [f"Not used, because no recording has such a key: {listed(ignored)}."] if ignored else []


def _numeric(key: str, value: Any, source: str) -> np.ndarray:
    """Return `value` as float64; every float32 and every usual integer is kept exactly."""
    array = as_array(value)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"{source}: {key} holds {array.dtype}, not numbers; expected floats. Store {key} as an array of floats."
        )
    return array.astype(np.float64)


def _stamps(key: str, value: Any, source: str) -> tuple[np.ndarray, float, str]:
    """Stamps [s], the clock at zero [s], and what kind of stamps they were."""
    array = as_array(value)
    if array.dtype.kind not in "UMiuf":
        array = _numeric(key, value, source)
    if array.ndim != 1:
        raise ValueError(f"{source}: {key} has shape {array.shape}; expected (T,). Store {key} as one column.")
    if array.dtype.kind == "f":
        _check_finite(key, array, (), source)
        array = array.astype(np.float64)
        _check_precision(key, array, source)
    try:
        found = seconds_of(array)
    except ValueError as error:
        raise ValueError(
            f"{source}: {key} holds text such as '{array[0]}' ({error}); expected seconds, or dates as in "
            "2026-11-25T10:30:00.125. Correct it."
        ) from error
    _check_finite(key, found[0], (), source)
    return found


def _command_time(value: Any, time: np.ndarray, origin: float, source: str) -> np.ndarray | None:
    """The instants of commands on the clock of `time`, (T',) [s]."""
    if value is None:
        return None
    own, own_origin, _ = _stamps("des_time", value, source)
    if bool(origin) != bool(own_origin):
        raise ValueError(
            f"{source}: des_time is {'Unix time' if own_origin else 'not Unix time'} but time is "
            f"{'Unix time' if origin else 'not'}. Give both on one clock."
        )
    own = own + (own_origin - origin)
    if not len(own) or own[0] > time[-1] or own[-1] < time[0] - 3600.0:
        raise ValueError(f"{source}: commands (des_time) and samples (time) do not meet. Give both on one clock [s].")
    _check_time("des_time", own, source)
    return own


def _origin(value: Any, of_stamps: float, source: str) -> float:
    """What the clock shows at zero [s], of the fact `time_origin` and of the stamps."""
    if value is None:
        return of_stamps
    if of_stamps:
        raise ValueError(f"{source}: holds time_origin, but time is Unix time already. Leave time_origin out.")
    array = np.atleast_1d(as_array(value))
    if array.shape == (1,) and array.dtype.kind in "UM":
        return _stamps("time_origin", array, source)[1]
    if array.shape != (1,) or array.dtype.kind not in "iuf" or not np.isfinite(array[0]):
        raise ValueError(
            f"{source}: time_origin is {value!r}; expected what the log's clock shows where time is 0 [s], or a date. "
            "Correct it."
        )
    return float(array[0])


def _joint_series(key: str, value: Any, stamps: str, time: np.ndarray, source: str) -> np.ndarray:
    num_samples = len(time)
    array = _numeric(key, value, source)
    if array.ndim == 1 and len(array) == num_samples:
        array = array[:, None]  # one joint
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"{source}: {key} has shape {array.shape}; expected (T, n) with T = {num_samples} samples (as in "
            f"{stamps}) and one column per joint. Reshape it."
        )
    if len(array) != num_samples:
        cure = "Transpose it." if array.shape[1] == num_samples else "Cut the series to the same length."
        raise ValueError(
            f"{source}: {key} has shape {array.shape} but {stamps} has {num_samples} samples; "
            f"expected ({num_samples}, n). {cure}"
        )
    return array


def _torque_enable(value: Any, num_samples: int, source: str) -> np.ndarray:
    array = as_array(value)
    if array.dtype.kind not in "biuf" or not np.all((array == 0) | (array == 1)):
        raise ValueError(
            f"{source}: torque_enable holds values other than true and false (0 and 1). "
            "Store 1 where the drive gives torque and 0 where it gives none."
        )
    if array.ndim == 2 and array.shape[1] > 0 and np.all(array == array[:, :1]):
        array = array[:, 0]
    if array.shape != (num_samples,):
        raise ValueError(
            f"{source}: torque_enable has shape {array.shape}; expected ({num_samples},), one value per "
            "sample for all joints together. Cut the recording where only some joints are off."
        )
    return array.astype(bool)


def _pose(value: Any, num_samples: int, source: str) -> np.ndarray:
    array = _numeric("real_ee_pose", value, source)
    if array.ndim != 2 or len(array) != num_samples or array.shape[1] not in (3, len(POSE_COLUMNS)):
        raise ValueError(
            f"{source}: real_ee_pose has shape {array.shape}; expected ({num_samples}, 3), a position [m], or "
            f"({num_samples}, {len(POSE_COLUMNS)}), position and quaternion (w, x, y, z). Store one row per sample."
        )
    _check_finite("real_ee_pose", array, POSE_COLUMNS[: array.shape[1]], source)
    if array.shape[1] > 3 and np.any(np.abs(np.linalg.norm(array[:, 3:], axis=1) - 1.0) > 1e-2):
        raise ValueError(
            f"{source}: real_ee_pose has quaternions of a length other than 1 in its columns 3 to 6; expected "
            "(x, y, z, qw, qx, qy, qz). Put the columns in this order."
        )
    return array


def _base(fields: Mapping[str, Any], num_samples: int, source: str) -> dict[str, Any]:
    """What the recording says of a base that moves, and of its feet."""
    result: dict[str, Any] = {}
    for key, columns in BASE_COLUMNS.items():
        if (value := fields.get(key)) is None:
            continue
        array = _numeric(key, value, source)
        if array.shape != (num_samples, len(columns)):
            raise ValueError(
                f"{source}: {key} has shape {array.shape}; expected ({num_samples}, {len(columns)}), columns "
                f"{listed(columns)}, one row per sample."
            )
        _check_finite(key, array, columns, source)
        result[key] = array
    if ("base_ang_vel" in result) != ("base_lin_acc" in result):
        there, missing = sorted(("base_ang_vel", "base_lin_acc"), key=lambda key: key not in result)
        raise ValueError(f"{source}: {there} without {missing}; expected both of them. Add it, or leave both out.")
    contact, force = fields.get("contact"), fields.get("foot_force")
    if contact is not None:
        array = as_array(contact)
        if array.dtype.kind not in "biuf" or array.ndim != 2 or not np.isin(array, (0, 1)).all():
            raise ValueError(
                f"{source}: contact is {array.dtype} of shape {array.shape}; expected (T, feet) of 0 and 1. Store 1 "
                "where a foot touches the ground; forces belong to foot_force."
            )
        result["contact"] = array.astype(bool)
    if force is not None:
        array = _numeric("foot_force", force, source)
        if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
            raise ValueError(f"{source}: foot_force has shape {array.shape}; expected (T, feet) or (T, feet, 3) [N].")
        if not np.isfinite(array).all():
            raise ValueError(f"{source}: foot_force holds NaN or infinite values. Remove those samples.")
        result["foot_force"] = array
    of_feet = [result[key] for key in ("contact", "foot_force") if key in result]
    for key in ("contact", "foot_force"):
        if key in result and (len(result[key]) != num_samples or result[key].shape[1] != of_feet[0].shape[1]):
            raise ValueError(
                f"{source}: {key} has shape {result[key].shape}; expected ({num_samples}, {of_feet[0].shape[1]}), a "
                "row per sample and a column per foot."
            )
    if of_feet and not (feet := feet_of(fields.get("feet"), of_feet[0].shape[1], source)):
        raise ValueError(
            f"{source}: contact or foot_force without feet; expected the names of their {of_feet[0].shape[1]} columns. "
            'Add feet, such as ["LF_FOOT", "RF_FOOT"]: bodies, geoms, sites or legs of the model.'
        )
    if of_feet and "base_ang_vel" not in result:
        raise ValueError(
            f"{source}: contacts without base_ang_vel and base_lin_acc; expected what the IMU shows. Add both, or "
            "leave the contacts out where the base is fixed."
        )
    return {
        **result,
        **({"feet": feet} if of_feet else {}),
        "imu": imu_of(fields.get("imu"), source),
        "couplings": couplings_of(fields.get("couplings"), source),
    }


def _check_finite(key: str, array: np.ndarray, joint_names: tuple[str, ...], source: str) -> None:
    finite = np.isfinite(array)
    if key.endswith(("dof_pos", "dof_vel")) and np.any(huge := finite & (np.abs(array) > _HUGE)):
        sample, joint = np.argwhere(huge)[0]
        name = joint_names[joint] if joint_names else joint
        raise ValueError(
            f"{source}: {key} is {array[sample, joint]:.3g} at sample {sample}, joint {name}; expected rad (or rad/s, "
            f"of a slide m or m/s), below {_HUGE:g}. Correct the value, or cut the file there."
        )
    if finite.all():
        return
    if array.ndim == 2 and key != "dof_pos":
        finite |= np.isnan(array).all(axis=0)  # joints that have none of it
    faults = np.argwhere(~finite)
    if not len(faults):
        return
    where = f"at sample {faults[0][0]}"
    if array.ndim == 2:
        where += f", joint {joint_names[faults[0][1]] if joint_names else faults[0][1]}"
    raise ValueError(
        f"{source}: {key} has {len(faults)} values that are NaN or infinite, the first {where}; expected "
        "finite numbers. Remove those samples (from every series, with their time), or cut the file there."
    )


def _check_commands(recording: Recording) -> None:
    """Refuse columns without a name that nothing commands, and a position loop that has no target."""
    names = recording.joint_names or tuple(f"column {j}" for j in range(recording.num_joints))
    commanded = recording.is_commanded
    if not (commanded.any() if recording.joint_names else commanded.all()):
        refuse_uncommanded(recording, names)
    stiffness = recording.drive.stiffness
    if stiffness is not None and np.any(loop := commanded & ~recording.has_position_command & (stiffness > 0.0)):
        joint = int(np.argmax(loop))
        raise ValueError(
            f"{recording.source}: {names[joint]} has a stiffness of {stiffness[joint]:g} but no des_dof_pos. Add its "
            "position targets, or state a stiffness of 0."
        )


def refuse_uncommanded(recording: Recording, names: Sequence[str]) -> None:
    """Say which joints nothing commands."""
    idle = [name for name, flag in zip(names, recording.is_commanded, strict=True) if not flag]
    raise ValueError(
        f"{recording.label}: {listed(idle)}: no command (des_dof_pos, des_dof_vel and des_dof_effort are NaN or "
        "missing). Add one, or leave the joint out: --joints names those to identify, the others are held."
    )


def _check_precision(key: str, time: np.ndarray, source: str) -> None:
    step = np.diff(time)
    if np.any(step <= 0.0) and abs(time[0]) > 1e5 and np.all(time == time.astype(np.float32)):
        first = int(np.argmax(step <= 0.0)) + 1
        raise ValueError(
            f"{source}: {key} does not increase at sample {first} ({time[first - 1]:.9g} s, then {time[first]:.9g} s): "
            "time stamps this large do not fit in float32. Subtract the first before storing them."
        )


def _check_time(key: str, time: np.ndarray, source: str) -> None:
    step = np.diff(time)
    if np.any(step <= 0.0):
        first = int(np.argmax(step <= 0.0)) + 1
        cure = "Sort the samples and drop repeated ones."
        if len(back := set_back(time)):
            first, cure = int(back[0]), "The clock was set back there: cut the file into two recordings."
        raise ValueError(
            f"{source}: {key} does not increase at sample {first} ({time[first - 1]:.9g} s, then "
            f"{time[first]:.9g} s); expected strictly increasing time. {cure}"
        )
    if not len(step):
        return
    median = float(np.median(step))
    if median < _FASTEST and key == "time":
        raise ValueError(
            f"{source}: time steps by {median:.3g} s, which is {1 / median:.3g} Hz; expected at least {_FASTEST:g} s: "
            "no drive's loop is faster. Is time in another unit than seconds?"
        )
    if 0.5 <= median < 1.5 and key == "time":
        raise ValueError(
            f"{source}: time steps by {median:g}: that is {1 / median:.3g} Hz in seconds, too slow for joints (20 Hz "
            "at least), or 1 kHz in milliseconds. Record faster, or divide time by 1000 if it is in milliseconds."
        )
    for threshold, unit, factor in (
        (5e5, "nanoseconds", 1e9),
        (500.0, "microseconds", 1e6),
        (1.5, "milliseconds", 1e3),
    ):
        if median >= threshold and key == "time":
            raise ValueError(
                f"{source}: time steps by {median:g}, which looks like {unit}; expected seconds. "
                f"Divide time by {factor:g}."
            )
