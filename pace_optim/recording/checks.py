"""Checks of a file's content on its own: keys, types, shapes, lengths, numbers, the time base's unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .data import Recording
from .facts import drive_of, joint_names_of, load_of
from .keys import FACTS, JOINT_SERIES, REQUIRED_SERIES, SERIES, closest, listed

MIN_SAMPLES = 20
"""Fewer samples than this are not a recording."""


def check_recording(
    fields: Mapping[str, Any], *, source: str, default_name: str = "", found: Sequence[str] = ()
) -> Recording:
    """Check a file's fields and return them as a `Recording`.

    Args:
        fields: The file's keys and values; array-likes, text, numbers, dicts.
        source: Path, for messages.
        default_name: The recording's name when the fields hold none.
        found: What the file calls its fields (a CSV's columns), for messages; default: the keys.
    """
    notes = _check_keys(fields, source, found or tuple(fields))
    time = _numeric("time", fields["time"], source)
    if time.ndim != 1:
        raise ValueError(f"{source}: time has shape {time.shape}; expected (T,). Store time as one column.")
    given = [key for key in JOINT_SERIES if fields.get(key) is not None]
    series: dict[str, Any] = {key: _joint_series(key, fields[key], len(time), source) for key in given}
    shape = series["dof_pos"].shape
    for key, array in series.items():
        if array.shape != shape:
            raise ValueError(
                f"{source}: {key} has {array.shape[1]} columns but dof_pos has {shape[1]}. "
                "Give every series one column per joint."
            )
    joint_names = joint_names_of(fields.get("joint_names"), shape[1], source)
    enable = fields.get("torque_enable")
    torque_enable = None if enable is None else _torque_enable(enable, len(time), source)
    for key, array in (("time", time), *series.items()):
        _check_finite(key, array, joint_names, source)
    if len(time) < MIN_SAMPLES:
        raise ValueError(
            f"{source}: found {len(time)} samples; expected at least {MIN_SAMPLES}. Record for longer (20 s is usual)."
        )
    _check_time(time, source)
    name = fields.get("name", default_name)
    if not isinstance(name, str) or not name:
        raise ValueError(f"{source}: name is {name!r}; expected text. Correct it or leave it out.")
    return Recording(
        name=name,
        joint_names=joint_names,
        time=time,
        **series,
        torque_enable=torque_enable,
        drive=drive_of(fields, joint_names, shape[1], source),
        load=load_of(fields, source),
        notes=tuple(notes),
        source=source,
    )


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
    if missing := [key for key in REQUIRED_SERIES if fields.get(key) is None]:
        raise ValueError(
            f"{source}: {listed(missing)} missing; expected time (T,) [s], dof_pos (T, n) and des_dof_pos "
            "(T, n) [rad]; in a CSV the columns are time, dof_pos/<joint>, des_dof_pos/<joint>. Found: "
            f"{listed(found)}. Rename or add what is missing."
        )
    return [f"Not used, because no recording has such a key: {listed(ignored)}."] if ignored else []


def _numeric(key: str, value: Any, source: str) -> np.ndarray:
    """Return `value` as float64; every float32 and every usual integer is kept exactly."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged lists
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"{source}: {key} holds {array.dtype}, not numbers; expected floats. Store {key} as an array of floats."
        )
    return array.astype(np.float64)


def _joint_series(key: str, value: Any, num_samples: int, source: str) -> np.ndarray:
    array = _numeric(key, value, source)
    if array.ndim == 1 and len(array) == num_samples:
        array = array[:, None]  # one joint
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"{source}: {key} has shape {array.shape}; expected (T, n) with T = {num_samples} samples (as in "
            "time) and one column per joint. Reshape it."
        )
    if len(array) != num_samples:
        cure = "Transpose it." if array.shape[1] == num_samples else "Cut the series to the same length."
        raise ValueError(
            f"{source}: {key} has shape {array.shape} but time has {num_samples} samples; "
            f"expected ({num_samples}, n). {cure}"
        )
    return array


def _torque_enable(value: Any, num_samples: int, source: str) -> np.ndarray:
    array = np.asarray(value)
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


def _check_finite(key: str, array: np.ndarray, joint_names: tuple[str, ...], source: str) -> None:
    faults = np.argwhere(~np.isfinite(array))
    if not len(faults):
        return
    where = f"at sample {faults[0][0]}"
    if array.ndim == 2:
        where += f", joint {joint_names[faults[0][1]] if joint_names else faults[0][1]}"
    raise ValueError(
        f"{source}: {key} has {len(faults)} values that are NaN or infinite, the first {where}; expected "
        "finite numbers. Remove those samples (from every series, with their time), or cut the file there."
    )


def _check_time(time: np.ndarray, source: str) -> None:
    step = np.diff(time)
    if np.any(step <= 0.0):
        first = int(np.argmax(step <= 0.0)) + 1
        precision = ""
        if abs(time[0]) > 1e5 and np.all(time == time.astype(np.float32)):
            precision = " Time stamps this large do not fit in float32: subtract the first before storing them."
        raise ValueError(
            f"{source}: time does not increase at sample {first} ({time[first - 1]:.9g} s, then "
            f"{time[first]:.9g} s); expected strictly increasing time. Sort the samples and drop repeated "
            f"ones.{precision}"
        )
    median = float(np.median(step))
    for threshold, unit, factor in (
        (5e5, "nanoseconds", 1e9),
        (500.0, "microseconds", 1e6),
        (0.5, "milliseconds", 1e3),
    ):
        if median >= threshold:
            raise ValueError(
                f"{source}: time steps by {median:g}, which looks like {unit}; expected seconds. "
                f"Divide time by {factor:g}."
            )
