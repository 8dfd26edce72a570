"""From the facts in a file to `Drive`, `Load` and joint names, each checked once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pace_actuators.text import listed

from .data import Drive, ImuPose, Load
from .keys import BENCH_FACTS, DRIVE_FACTS, did_you_mean

_MAY_BE_INFINITE = ("effort_limit", "saturation_effort", "velocity_limit")
_MAY_BE_ZERO = ("stiffness", "damping", "load_mass", "arm_mass")


def as_array(value: Any) -> np.ndarray:
    """A value of a file as an array; lists that make none give an array of ``None``, which no check takes."""
    try:
        return np.asarray(value)
    except ValueError:
        return np.asarray(None)


def check_one_line(label: str, text: str, source: str) -> None:
    """Refuse a name that holds line breaks or what steers a terminal."""
    if not text.isprintable():
        raise ValueError(f"{source}: {label} is {text!r}; expected one line of printable text. Correct it.")


def _texts(value: Any) -> Sequence[str] | None:
    """A list of text; ``None`` for anything else."""
    texts = value.tolist() if isinstance(value, np.ndarray) else value
    is_list = isinstance(texts, Sequence) and not isinstance(texts, str)
    return texts if is_list and all(isinstance(text, str) for text in texts) else None


def joint_names_of(value: Any, num_joints: int, source: str) -> tuple[str, ...]:
    """Return the file's joint names as a tuple, () when it has none.

    Args:
        value: The file's "joint_names", or None.
        num_joints: Number of columns that the names must cover.
    """
    if value is None:
        return ()
    if (names := _texts(value)) is None:
        raise ValueError(
            f"{source}: joint_names is {value!r}; expected a list of text, one name per column of dof_pos. "
            "Write joint_names as a list of names."
        )
    if len(names) != num_joints:
        raise ValueError(
            f"{source}: joint_names has {len(names)} names ({listed(names)}) but dof_pos has {num_joints} "
            "columns. Give one name per column."
        )
    for name in names:
        check_one_line("a joint's name", name, source)
    if repeated := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(f"{source}: joint_names repeats {listed(repeated)}. Give every joint its own name.")
    return tuple(names)


def drive_of(fields: Mapping[str, Any], joint_names: tuple[str, ...], commanded: np.ndarray, source: str) -> Drive:
    """Read the drive's facts: a number for all joints, one per joint in column order, or {joint: value}.

    Args:
        joint_names: Names of the columns, () without names.
        commanded: Which columns have commands, (n,) bool: the others may be left out of {joint: value}.
    """
    given = {key: fields[key] for key in DRIVE_FACTS if fields.get(key) is not None}
    return Drive(**{k: _per_joint(k, v, joint_names, commanded, source) for k, v in given.items()})


def load_of(fields: Mapping[str, Any], source: str) -> Load:
    """Read the load's facts."""
    bench = {key: _number(key, fields[key], source) for key in BENCH_FACTS if fields.get(key) is not None}
    masses = _added_mass(fields.get("added_mass"), source)
    places = _added_mass_at(fields.get("added_mass_at"), masses, source)
    return Load(added_mass=masses, added_mass_at=places, **bench)


def imu_of(value: Any, source: str) -> ImuPose:
    """Where the IMU is: a site's name, or ``{body, pos, quat}``."""
    if value is None:
        return ImuPose()
    if isinstance(value, str):
        check_one_line("imu", value, source)
        return ImuPose(site=value)
    if not isinstance(value, Mapping) or not {"body"} <= set(value) <= {"body", "pos", "quat"}:
        raise ValueError(
            f"{source}: imu is {value!r}; expected the name of a site, or {{body, pos, quat}} (in an .npz as JSON "
            'text). Write it as {"body": "base", "pos": [0.1, 0, 0.02], "quat": [1, 0, 0, 0]}.'
        )
    check_one_line("imu's body", str(value["body"]), source)
    pose: dict[str, Any] = {}
    for key, size in (("pos", 3), ("quat", 4)):
        if key in value:
            array = as_array(value[key])
            if array.dtype.kind not in "iuf" or array.shape != (size,) or not np.isfinite(array).all():
                raise ValueError(f"{source}: imu.{key} is {value[key]!r}; expected {size} numbers. Correct it.")
            pose[key] = tuple(float(each) for each in array)
    if "quat" in pose and abs(np.linalg.norm(pose["quat"]) - 1) > 1e-3:
        raise ValueError(f"{source}: imu.quat is {value['quat']!r}; expected (w, x, y, z) of length 1. Correct it.")
    return ImuPose(body=str(value["body"]), **pose)


def couplings_of(value: Any, source: str) -> dict[str, dict[str, float]]:
    """Motors that move several joints, {motor: {joint: ratio}}; none where none are stated."""
    rows = {} if value is None else value
    if not isinstance(rows, Mapping) or not all(isinstance(row, Mapping) and row for row in rows.values()):
        raise ValueError(
            f"{source}: couplings is {value!r}; expected {{motor: {{joint: ratio}}}} (in an .npz as JSON text). "
            'Write it as {"motor_a": {"pitch": 1.5, "roll": 1}, "motor_b": {"pitch": 1.5, "roll": -1}}.'
        )
    result: dict[str, dict[str, float]] = {}
    for motor, row in rows.items():
        check_one_line("a motor of couplings", str(motor), source)
        for joint, ratio in row.items():
            array = as_array(ratio)
            if array.dtype.kind not in "iuf" or array.shape != () or not np.isfinite(array):
                raise ValueError(
                    f"{source}: couplings of {motor} has the ratio {ratio!r} of {joint}; expected a number."
                )
            result.setdefault(str(motor), {})[str(joint)] = float(array)
    return result


def feet_of(value: Any, count: int, source: str) -> tuple[str, ...]:
    """Names of the feet that contacts are of, () where none are given."""
    if value is None:
        return ()
    if (names := _texts(value)) is None:
        raise ValueError(f"{source}: feet is {value!r}; expected a list of names, one per column of contact.")
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"{source}: feet has {listed(names)}; expected {count} different names, one per column.")
    for name in names:
        check_one_line("a foot's name", name, source)
    return tuple(names)


def _per_joint(key: str, value: Any, joint_names: tuple[str, ...], commanded: np.ndarray, source: str) -> np.ndarray:
    num_joints = len(commanded)
    if isinstance(value, Mapping):
        value = _in_column_order(key, value, joint_names, commanded, source)
    array = as_array(value)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"{source}: {key} is {value!r}; expected a number, a list of {num_joints} numbers in the order "
            f"of the recording's columns, or {{joint: number}}. Correct {key}."
        )
    if array.shape not in ((), (1,), (num_joints,)):
        raise ValueError(
            f"{source}: {key} has shape {array.shape}; expected one number, or {num_joints} (one per joint). "
            f"Correct {key} or leave it out."
        )
    array = np.broadcast_to(array.astype(np.float64), (num_joints,)).copy()
    for joint in range(num_joints):
        label = joint_names[joint] if joint_names else f"column {joint}"
        _check_range(f"{key} of {label}", key, array[joint], source)
    return array


def _in_column_order(
    key: str, value: Mapping, joint_names: tuple[str, ...], commanded: np.ndarray, source: str
) -> list:
    if not joint_names:
        raise ValueError(
            f"{source}: {key} is given by joint name, but the recording has no joint_names. "
            "Add joint_names, or give a list in the order of the columns."
        )
    for name in value:
        if name not in joint_names:
            raise ValueError(
                f"{source}: {key} names the unknown joint '{name}'{did_you_mean(str(name), joint_names)} "
                f"Joints of the recording: {listed(joint_names)}."
            )
    missing = [name for name, needed in zip(joint_names, commanded, strict=True) if needed and name not in value]
    if missing:
        raise ValueError(f"{source}: {key} has no value for {listed(missing)}. Give one for every joint.")
    of_undriven = np.inf if key in _MAY_BE_INFINITE else 0.0
    return [value.get(name, of_undriven) for name in joint_names]


def _added_mass(value: Any, source: str) -> dict[str, float]:
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(body, str) for body in value):
        raise ValueError(
            f"{source}: added_mass is {value!r}; expected {{body: kg}} (in an .npz as JSON text). "
            'Write it as {"body_name": 0.5}.'
        )
    for body in value:
        check_one_line("a body of added_mass", body, source)
    return {body: _number("added_mass", mass, source, f"added_mass of {body}") for body, mass in value.items()}


def _added_mass_at(value: Any, masses: Mapping[str, float], source: str) -> dict[str, tuple[float, float, float]]:
    """Where added masses are, {body: (x, y, z)} [m]."""
    if value is None:
        return {}
    places = {body: as_array(at) for body, at in (value if isinstance(value, Mapping) else {"": ""}).items()}
    for body, place in places.items():
        if place.dtype.kind not in "iuf" or place.shape != (3,) or not np.isfinite(place).all():
            raise ValueError(
                f"{source}: added_mass_at is {value!r}; expected {{body: [x, y, z]}} in m (in an .npz as JSON text). "
                'Write it as {"body_name": [0, 0, 0.08]}.'
            )
        if body not in masses:
            raise ValueError(
                f"{source}: added_mass_at names {body!r}, which has no added_mass (these have: "
                f"{listed(list(masses)) or 'none'}). State its mass, or correct the name."
            )
    return {body: (float(x), float(y), float(z)) for body, (x, y, z) in places.items()}


def _number(key: str, value: Any, source: str, label: str = "") -> float:
    array = as_array(value)
    if array.dtype.kind not in "iuf" or array.size != 1:
        raise ValueError(f"{source}: {label or key} is {value!r}; expected one number. Correct it.")
    _check_range(label or key, key, number := float(array.reshape(())), source)
    return number


def _check_range(label: str, key: str, value: float, source: str) -> None:
    fine = value >= 0.0 if key in (*_MAY_BE_ZERO, "added_mass") else value > 0.0
    if fine and (np.isfinite(value) or key in _MAY_BE_INFINITE):
        return
    expected = "zero or more" if key in (*_MAY_BE_ZERO, "added_mass") else "more than zero"
    finite = "" if key in _MAY_BE_INFINITE else ", and finite"
    raise ValueError(f"{source}: {label} is {value:g}; expected a number of {expected}{finite}. Correct it.")
