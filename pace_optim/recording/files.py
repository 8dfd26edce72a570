"""Read and write recordings: `.pt`, `.npz` and `.csv`, facts in the file or in a JSON of the same stem."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pace_actuators.files import parsed_json, read_tensors, write_atomically, writing
from pace_actuators.text import listed
from pace_optim.terminal.arrays import read_arrays

from .checks import check_recording
from .csv_format import read_csv, write_csv
from .data import ImuPose, Recording
from .facts import as_array, couplings_of
from .keys import DRIVE_FACTS, FACTS, SERIES, did_you_mean

SUFFIXES = (".pt", ".npz", ".csv")


def load_recording(path: str | os.PathLike[str], rate: float = 0.0) -> Recording:
    """Read a recording and check that it is one; its samples stay as they are in the file.

    Args:
        path: A `.pt` (dict of tensors, numbers, text), `.npz` or `.csv` file. A JSON file of the same stem
            beside it may hold the facts (joint_names, stiffness, added_mass, ...).
        rate: Samples per second of a file without time [Hz]; 0: it has time.

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
    fields = add_json_facts(fields, path)
    if rate and "time" not in fields and "dof_pos" in fields:
        fields["time"] = np.arange(len(as_array(fields["dof_pos"]))) / rate
    return check_recording(fields, source=str(path), default_name=path.stem, found=found)


def stated_couplings(paths: Sequence[str | os.PathLike[str]]) -> dict[str, dict[str, float]]:
    """Motors that recordings and logs state, {motor: {joint: ratio}}: in themselves or in the JSON beside them."""
    found: dict[str, dict[str, float]] = {}
    first = ""
    for path in map(Path, paths):
        read = {".npz": _read_npz, ".pt": _read_pt}.get(path.suffix.lower()) if path.is_file() else None
        value = add_json_facts({}, path).get("couplings")
        if value is None and read is not None:
            value = read(path).get("couplings")
        own = couplings_of(value, str(path))
        if own and found and own != found:
            raise ValueError(
                f"{path}: couplings differ from those of {first}. One robot has one set: correct one of them."
            )
        found, first = (own, str(path)) if own else (found, first)
    return found


def without_fact_files(paths: Sequence[str | os.PathLike[str]]) -> list[str]:
    """Leave out JSON files of facts that lie beside a recording that is listed too, as ``folder/*`` lists them."""
    recordings = {Path(path).with_suffix("") for path in paths if Path(path).suffix.lower() in SUFFIXES}
    return [
        str(path)
        for path in paths
        if not (Path(path).suffix.lower() == ".json" and Path(path).with_suffix("") in recordings)
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
    return value


def _read_npz(path: Path) -> dict[str, Any]:
    cure = "Save arrays with numpy.savez, text as unicode arrays and dicts as JSON text."
    fields = read_arrays(path, cure)
    return {
        key: array.item() if array.dtype.kind == "U" and array.ndim == 0 else array for key, array in fields.items()
    }


def add_json_facts(fields: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the fields with those of the JSON file of the same stem, where there is one."""
    facts_path = path.with_suffix(".json")
    if not facts_path.is_file():
        return fields
    try:
        facts = parsed_json(facts_path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{facts_path}: is not JSON ({error}). Correct it, or move it away from {path.name}."
        ) from error
    if not isinstance(facts, dict):
        raise ValueError(f"{facts_path}: holds a {type(facts).__name__}; expected {{fact: value}}. Correct it.")
    for key, value in facts.items():
        if key not in FACTS:
            raise ValueError(
                f"{facts_path}: unknown fact '{key}'{did_you_mean(key, FACTS)} "
                f"Facts: {listed(FACTS)}. Rename it, or put free text under 'comment'."
            )
        if key in fields and not _same(fields[key], value):
            raise ValueError(
                f"{facts_path}: {key} differs from the one in {path.name}"
                f"{' (joint names of its columns)' if key == 'joint_names' else ''}. Keep it in one place."
            )
    return {**fields, **facts}


def _same(one: Any, other: Any) -> bool:
    """Whether a fact of the file and one of the JSON say the same."""
    if isinstance(one, str) and isinstance(other, dict):
        one = json.loads(one)
    if isinstance(one, dict) or isinstance(other, dict):
        return one == other
    return np.array_equal(as_array(one), as_array(other))
