"""Read and write recordings: `.pt`, `.npz` and `.csv`, facts in the file or in a JSON of the same stem.

A CSV has columns `time`, `torque_enable`, `<series>/<joint>`, and `real_ee_pose/x` to `/qz`. Commands with a separate
clock have a column `des_time`; the clock with fewer rows leaves the last cells empty.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import os
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields as dataclass_fields
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from pace_actuators.files import file_at, parsed_json, read_tensors, write_atomically, writing
from pace_actuators.text import listed
from pace_optim.terminal.arrays import read_arrays

from .checks import check_recording
from .data import ImuPose, Recording
from .facts import as_array, couplings_of
from .keys import (
    BASE_COLUMNS,
    COMMAND_SERIES,
    DRIVE_FACTS,
    FACTS,
    FEET_SERIES,
    JOINT_SERIES,
    POSE_COLUMNS,
    SERIES,
    as_fact,
    did_you_mean,
)
from .text_table import Rows, are_numbers, column_of, read_rows

SUFFIXES = (".pt", ".npz", ".csv")


def load_recording(
    path: str | os.PathLike[str],
    rate: float = 0.0,
    facts: Mapping[str, Any] | None = None,
    joint_names: Collection[str] = (),
) -> Recording:
    """Read a recording and check that it is one; its samples stay as they are in the file.

    Args:
        path: A `.pt` (dict of tensors, numbers, text), `.npz` or `.csv` file. A JSON file of the same stem
            beside it may hold the facts (joint_names, stiffness, added_mass, ...).
        rate: Samples per second of a file without time [Hz]; 0: it has time.
        facts: Those that the file and its JSON file do not state.
        joint_names: The robot's joints, of which `facts` may name more than the file has.

    Raises:
        ValueError: If the file is missing, unreadable, or not a sound recording; the message says what to do.
    """
    path = Path(path)
    suffix = _suffix(path)
    if not path.is_file():
        folder = path.parent
        there = sorted(p.name for p in folder.iterdir() if p.suffix in SUFFIXES) if folder.is_dir() else []
        raise ValueError(f"{path}: no such file. Recordings in {folder}: {listed(there)}. Correct the path.")
    found: tuple[str, ...] = ()
    if suffix == ".csv":
        fields, found = read_csv(path)
    else:
        fields = _read_pt(path) if suffix == ".pt" else _read_npz(path)
    beside, notes = facts_beside(path)
    fields = with_shared_facts(with_facts(fields, beside, path), facts or {}, joint_names)
    if rate and "time" in fields:
        notes = [*notes, f"The rate of {rate:g} Hz is not used: the file has the time."]
    elif rate and "dof_pos" in fields:
        fields["time"] = np.arange(len(as_array(fields["dof_pos"]))) / rate
    recording = check_recording(fields, source=str(path), default_name=path.stem, found=found)
    return replace(recording, notes=(*recording.notes, *notes))


def stated_couplings(paths: Sequence[str | os.PathLike[str]]) -> dict[str, dict[str, float]]:
    """Motors that recordings and logs state, {motor: {joint: ratio}}: in themselves or in the JSON beside them."""
    found: dict[str, dict[str, float]] = {}
    first = ""
    for path in map(Path, paths):
        read = {".npz": _read_npz, ".pt": _read_pt}.get(path.suffix.lower()) if path.is_file() else None
        value = facts_beside(path)[0].get("couplings")
        if value is None and read is not None:
            value = read(path).get("couplings")
        own = couplings_of(value, str(path))
        if own and found and own != found:
            raise ValueError(
                f"{path}: couplings differ from those of {first}. One robot has one set: correct one of them."
            )
        found, first = (own, str(path)) if own else (found, first)
    return found


def without_fact_files(
    paths: Sequence[str | os.PathLike[str]], facts: str | os.PathLike[str] | None = None
) -> list[str]:
    """Leave out JSON files of facts, as ``folder/*`` lists them: those beside a recording, and `facts` of all."""
    recordings = {Path(path).with_suffix("") for path in paths if Path(path).suffix.lower() != ".json"}
    of_all = [] if facts is None else [Path(facts).resolve()]
    return [
        str(path)
        for path in paths
        if not (
            Path(path).suffix.lower() == ".json"
            and (Path(path).with_suffix("") in recordings or Path(path).resolve() in of_all)
        )
    ]


def written_files(path: Path) -> list[Path]:
    """The files that ``save_recording`` writes for a path."""
    return [path, path.with_suffix(".json")] if path.suffix.lower() == ".csv" else [path]


def save_recording(path: str | os.PathLike[str], recording: Recording) -> Path:
    """Write a recording in the format of the path's suffix; a CSV's facts go to a JSON file of the same stem.

    Series and facts are written without loss. What `conform_recording` derives from them (`command`,
    `sample_stride`, `notes`) is not written. The file appears whole or not at all.
    """
    path = Path(path)
    suffix = _suffix(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    series = {key: getattr(recording, key) for key in SERIES if getattr(recording, key) is not None}
    facts = _facts_of(recording)
    if suffix == ".csv":
        text = json.dumps(facts, indent=2).encode()
        table, facts_file = written_files(path)
        with writing(
            {
                facts_file: lambda file: file.write(text),
                table: lambda file: write_csv(file, series, recording.joint_names, recording.feet),
            }
        ):
            pass
    elif suffix == ".npz":
        facts = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in facts.items()}
        write_atomically(path, lambda file: np.savez_compressed(file, **series, **facts))
    else:
        tensors = {key: torch.from_numpy(np.ascontiguousarray(array)) for key, array in series.items()}
        write_atomically(path, lambda file: torch.save({**tensors, **facts}, file))
    return path


def _suffix(path: Path) -> str:
    if (suffix := path.suffix.lower()) not in SUFFIXES:
        raise ValueError(
            f"{path}: found the suffix '{path.suffix}'; expected one of {listed(SUFFIXES)}. "
            "Convert the recording (save_recording writes all three)."
        )
    return suffix


def _facts_of(recording: Recording) -> dict[str, Any]:
    """The facts as plain numbers, text, lists and dicts; what is unknown is left out."""
    facts: dict[str, Any] = {"name": recording.name}
    if recording.time_origin:
        facts["time_origin"] = recording.time_origin
    if recording.joint_names:
        facts["joint_names"] = list(recording.joint_names)
    for key in DRIVE_FACTS:
        if (value := getattr(recording.drive, key)) is not None:
            facts[key] = value.tolist()
    if recording.feet:
        facts["feet"] = list(recording.feet)
    if recording.couplings:
        facts["couplings"] = {motor: dict(row) for motor, row in recording.couplings.items()}
    if recording.imu != ImuPose():
        imu = recording.imu
        pose = {"body": imu.body, "pos": list(imu.pos), "quat": list(imu.quat)}
        facts["imu"] = pose if imu.body else imu.site
    for field in dataclass_fields(recording.load):
        value = getattr(recording.load, field.name)
        if value is not None and value != {}:
            facts[field.name] = dict(value) if field.name.startswith("added_mass") else value
    return facts


def _read_pt(path: Path) -> dict[str, Any]:
    cure = "Save a dict of tensors: torch.save({'time': t, 'dof_pos': q, 'des_dof_pos': q_des}, path)."
    content = read_tensors(path, cure)
    if not isinstance(content, dict):
        raise ValueError(
            f"{path}: holds a {type(content).__name__}; expected a dict with time, dof_pos and des_dof_pos. {cure}"
        )
    try:
        return {str(key): _without_tensor(value) for key, value in content.items()}
    except (NotImplementedError, RuntimeError, TypeError) as error:  # meta, sparse, quantised tensors
        text = " ".join(str(error).split())[:120]
        raise ValueError(f"{path}: holds a tensor that has no plain numbers ({text}). {cure}") from error


def _without_tensor(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        return (value.double() if value.is_floating_point() else value).numpy()
    if isinstance(value, dict):
        return {key: _without_tensor(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_tensor(item) for item in value]
    return _dict_of(value) if isinstance(value, str) else value


def _dict_of(text: str) -> Any:
    """A dict that a file holds as JSON text; other text as it is."""
    if text.lstrip().startswith("{"):
        with suppress(ValueError, RecursionError):  # the checks of facts show what is no JSON
            return parsed_json(text)
    return text


def _read_npz(path: Path) -> dict[str, Any]:
    cure = "Save arrays with numpy.savez, text as unicode arrays and dicts as JSON text."
    fields = read_arrays(path, cure)
    return {
        key: _dict_of(array.item()) if array.dtype.kind == "U" and array.ndim == 0 else array
        for key, array in fields.items()
    }


def facts_beside(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The JSON file of facts of the same stem, none where it is not there, and what is to be said of it."""
    beside = path.with_suffix(".json")
    if not beside.is_file():
        return {}, []
    facts, note = read_facts(beside, f", or move it away from {path.name}")
    return facts, [note] if note else []


def with_facts(fields: dict[str, Any], facts: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The fields with the facts of the JSON file beside them, which may not differ."""
    for key, value in facts.items():
        if key in fields and not _same(fields[key], value):
            raise ValueError(
                f"{path.with_suffix('.json')}: {key} differs from the one in {path.name}"
                f"{' (joint names of its columns)' if key == 'joint_names' else ''}. Keep it in one place."
            )
    return {**fields, **facts}


def read_facts(path: Path, or_else: str = "", known: Sequence[str] = FACTS) -> tuple[dict[str, Any], str]:
    """Read a JSON file of facts; its own names of gains are replaced, and a note says so ("" if it has none).

    Args:
        or_else: What to do if it is not one, beside correcting it.
        known: The facts that it may hold.
    """
    try:
        content = parsed_json(file_at(path, "Correct the path.").read_text(encoding="utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: is not JSON ({error}). Correct it{or_else}.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}; expected {{fact: value}}. Correct it.")
    named = {key: as_fact(key) for key in content}
    for key, fact in named.items():
        if twice := [other for other in named if named[other] == fact and other != key]:
            raise ValueError(f"{path}: {key} and {listed(twice)} are both {fact}. Keep one of them.")
        if fact not in known:
            raise ValueError(
                f"{path}: unknown fact '{key}'{did_you_mean(key, known)} "
                f"Facts: {listed(known)}. Rename it, or put free text under 'comment'."
            )
    other = [f"{key} as {fact} [{_UNITS_OF_GAINS[fact]}]" for key, fact in named.items() if key != fact]
    note = f"{path.name}: {listed(other)}." if other else ""
    return {named[key]: value for key, value in content.items()}, note.replace(": ", ": read ", 1)


_UNITS_OF_GAINS = {"stiffness": "N m/rad", "damping": "N m s/rad"}


def with_shared_facts(
    fields: dict[str, Any], facts: Mapping[str, Any], joint_names: Collection[str] = ()
) -> dict[str, Any]:
    """The fields with facts that several recordings share, where they state none themselves.

    Args:
        joint_names: The robot's joints: values of those that the recording lacks are left out.
    """
    own = as_array(fields.get("joint_names", joint_names)).tolist()  # columns without names are the robot's
    absent = set(joint_names).difference(own)
    shared = {
        key: {name: each for name, each in value.items() if name not in absent}
        if isinstance(value, Mapping) and key in DRIVE_FACTS
        else value
        for key, value in facts.items()
    }
    return {**shared, **fields}


def unused_facts(paths: Sequence[str | os.PathLike[str]], facts: str | os.PathLike[str] | None = None) -> str:
    """Which JSON file beside recordings states gains that are stated nowhere else, and what to do; "" if none does.

    Args:
        facts: The file that is given for all recordings.
    """
    used = {Path(path).with_suffix(".json").resolve() for path in paths} | ({Path(facts).resolve()} if facts else set())
    folders = dict.fromkeys(Path(path).parent for path in paths)
    shared = _drive_facts(Path(facts)) if facts else {}
    stated = [{**shared, **_drive_facts(Path(path).with_suffix(".json"))} for path in paths]
    for path in (each for folder in folders if folder.is_dir() for each in sorted(folder.glob("*.json"))):
        of_another = any(path.with_suffix(suffix).exists() for suffix in (*SUFFIXES, ""))
        if path.resolve() in used or of_another:
            continue
        content = _drive_facts(path)
        if content and not all(_state(own, content) for own in stated):
            return f"{path} is not used. If it holds the gains of these logs: --facts {shlex.quote(str(path))}"
    return ""


def _drive_facts(path: Path) -> dict[str, Any]:
    """Gains and effort limits that a JSON file states; none where it is missing, or another file."""
    try:
        content = parsed_json(path.read_text("utf-8-sig")) if path.stat().st_size <= _LARGEST_FACTS else None
    except (ValueError, OSError, RecursionError):
        return {}
    named = {as_fact(key): value for key, value in content.items()} if isinstance(content, dict) else {}
    return {key: named[key] for key in ("stiffness", "damping", "effort_limit") if key in named}


def _state(stated: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    """Whether facts hold all that other facts hold, of all their joints."""
    joints = [(stated.get(key), value) for key, value in others.items()]
    return all(
        own is not None if not isinstance(own, Mapping) else isinstance(value, Mapping) and value.keys() <= own.keys()
        for own, value in joints
    )


_LARGEST_FACTS = 1 << 20
"""Larger JSON files hold other things [bytes]."""


def _same(one: Any, other: Any) -> bool:
    """Whether a fact of the file and one of the JSON say the same."""
    if isinstance(one, dict) or isinstance(other, dict):
        return one == other
    return np.array_equal(as_array(one), as_array(other))


_DATE = re.compile(r"\d{4}-\d{2}-\d{2}")


def read_csv(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the fields of a CSV file, and its columns as they are called there."""
    head, rows = read_rows(path)
    header = list(head.names)
    if not header:
        raise ValueError(f"{path}: is empty; expected a line of column names, then one line per sample.")
    if len(header) == 1 or head.delimiter != ",":
        raise ValueError(
            f"{path}: has one column, '{head.delimiter.join(header)[:60]}'; expected time, dof_pos/<joint>, "
            "des_dof_pos/<joint>. Separate the columns by commas."
        )
    if repeated := sorted({c for c in header if header.count(c) > 1}):
        raise ValueError(f"{path}: the column(s) {listed(repeated)} appear twice. Keep one of each.")
    columns: dict[str, dict[str, int]] = {}
    for index, column in enumerate(header):
        series, _, joint = column.partition("/")
        columns.setdefault(series, {})[joint] = index
    joints = list(columns.get("dof_pos", {}))
    named = {**BASE_COLUMNS, "real_ee_pose": POSE_COLUMNS[: len(columns.get("real_ee_pose", {}))]}
    fields: dict[str, Any] = {}
    two_clocks = "des_time" in columns
    for series, index_of in columns.items():
        clock = "des_time" if two_clocks and series in ("des_time", *COMMAND_SERIES) else "time"
        own = rows[: _length(rows, list(columns.get(clock, {}).values()))] if two_clocks else rows
        if series in ("time", "des_time"):
            fields[series] = _numbers(path, series, own, next(iter(index_of.values())), may_be_dates=True)
        elif series == "torque_enable":
            indices = list(index_of.values())
            values = np.stack([_numbers(path, header[i], own, i) for i in indices], axis=1)
            fields[series] = values[:, 0] if len(indices) == 1 else values
        elif series in named and set(index_of) == set(named[series]):
            parts = [_numbers(path, f"{series}/{part}", own, index_of[part]) for part in named[series]]
            fields[series] = np.stack(parts, axis=1)
        elif series in FEET_SERIES and "" not in index_of:
            fields |= _of_feet(path, series, index_of, own, fields.get("feet"))
        elif series in JOINT_SERIES and joints:
            _check_joints(path, series, list(index_of), joints, header)
            none = np.full(len(own), np.nan)
            fields[series] = np.stack(
                [_numbers(path, f"{series}/{j}", own, index_of[j]) if j in index_of else none for j in joints], axis=1
            )
        else:
            fields[series] = ()  # the check of the keys says what becomes of it
    if joints:
        fields["joint_names"] = joints
    return fields, tuple(header)


def _of_feet(
    path: Path, series: str, index_of: Mapping[str, int], rows: Rows, feet: list[str] | None
) -> dict[str, Any]:
    """Contacts by foot, or forces with three columns ``<foot>/x`` to ``/z`` each, and the names of the feet."""
    parts = {name.rpartition("/")[2] for name in index_of}
    axes = ("x", "y", "z") if parts == {"x", "y", "z"} else ()
    found = list(dict.fromkeys(name.rpartition("/")[0] if axes else name for name in index_of))
    feet = feet or found
    wanted = [[f"{foot}/{axis}" for axis in axes] or [foot] for foot in feet]
    if set(found) != set(feet) or not {name for names in wanted for name in names} <= set(index_of):
        raise ValueError(
            f"{path}: {series} has the columns {listed(index_of)}; expected one for each of the feet {listed(feet)}, "
            "or three of them, /x, /y and /z. Correct them."
        )
    values = [[_numbers(path, f"{series}/{name}", rows, index_of[name]) for name in names] for names in wanted]
    array = np.stack([np.stack(each, axis=1) for each in values], axis=1)
    return {"feet": feet, series: array if axes else array[..., 0]}


def write_csv(
    file: IO[bytes], series: Mapping[str, np.ndarray], joint_names: tuple[str, ...], feet: tuple[str, ...] = ()
) -> None:
    """Write series as CSV; every number with as many digits as it takes to read back the same."""
    num_joints = series["dof_pos"].shape[1]
    joints = joint_names or tuple(f"joint_{i}" for i in range(num_joints))
    header: list[str] = []
    columns: list[list[Any]] = []
    for key, values in series.items():
        if values.ndim == 1:
            header.append(key)
            columns.append((values.astype(int) if values.dtype == bool else values).tolist())
            continue
        names: tuple[str, ...] = BASE_COLUMNS.get(key, joints)
        if key == "real_ee_pose":
            names = POSE_COLUMNS[: values.shape[1]]
        elif key in FEET_SERIES:
            names = feet if values.ndim == 2 else tuple(f"{foot}/{axis}" for foot in feet for axis in "xyz")
        for name, column in zip(names, values.reshape(len(values), -1).T, strict=True):
            if not np.isnan(column).all():
                header.append(f"{key}/{name}")
                columns.append((column.astype(int) if column.dtype == bool else column).tolist())
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(itertools.zip_longest(*columns, fillvalue=""))
    text.flush()
    text.detach()


def _check_joints(path: Path, series: str, found: list[str], joints: list[str], header: list[str]) -> None:
    if "" in found:
        raise ValueError(
            f"{path}: the column '{series}' names no joint; expected '{series}/<joint>'. Rename it. "
            f"Columns found: {listed(header)}."
        )
    if not set(found) <= set(joints):
        raise ValueError(
            f"{path}: {series} has the joints {listed(found)} but dof_pos has {listed(joints)}. "
            f"Give every series the same joints (or leave out those without). Columns found: {listed(header)}."
        )


def _length(rows: Rows, indices: list[int]) -> int:
    """Rows up to the last that has a value in one of the columns."""
    count = len(rows)
    if isinstance(rows, np.ndarray):
        return count
    while count and not any(rows[count - 1][i].strip() for i in indices):
        count -= 1
    return count


def _numbers(path: Path, column: str, rows: Rows, index: int, may_be_dates: bool = False) -> np.ndarray:
    """A column's numbers, whole ones exactly; a cell that holds none is refused with its place."""
    values = column_of(rows, index)
    if may_be_dates and values.dtype.kind == "U" and _DATE.match(values[0]):
        return values
    if values.dtype.kind == "U" or np.isnan(values).any():
        for line, row in enumerate(rows, start=2):
            if not are_numbers([str(row[index])]):
                raise ValueError(
                    f"{path}: row {line}, column '{column}' holds '{row[index]}'; expected a number. "
                    "Correct the cell, or delete the row."
                )
    return values
