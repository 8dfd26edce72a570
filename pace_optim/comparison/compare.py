"""Comparing runs with their recordings: analyse, write comparison.json and report.html."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pace_actuators.files import write_together
from pace_actuators.joint_units import joint_label, units_for
from pace_actuators.text import aligned, in_short, listed, percent, position_unit, shortened
from pace_optim.recording.noise import noise_floor
from pace_optim.report import check_folder, report_text
from pace_optim.run.open import run_folder
from pace_optim.run.summary import carried_by
from pace_optim.run.tensors import held_out_spans

from .error_regions import AT_THE_FLOOR, NEGLIGIBLE, worst_places
from .joint import JointComparison, compare_joint, place_content, rmse_by_part
from .ladder import cell, check_alike, ladder_table, make_ladder
from .tracks import RunTracks, Track, load_tracks

VERSION = 1
FILE = "comparison.json"
_DIGITS = 8
"""Figures in the file: with fewer, three of them may be rounded to another number than the same error elsewhere."""
_UNREPEATABLE = 3.0
"""Repetitions that differ by this many times the noise that each shows by itself are not of the same robot."""


def compare(
    folders: Sequence[str | Path],
    data: Sequence[str] = (),
    physics_dt: float | None = None,
    task: str | None = None,
    columns: str | None = None,
    strict: bool = False,
    device: str = "cpu",
) -> dict[str, Any]:
    """Say where each run's model fails, and put several side by side.

    Every run's folder gets a comparison.json and its report anew; the last one's also hold the ladder of the error.

    Args:
        folders: Runs' folders; several must share task and recordings.
        data: Recordings to simulate in place of the runs' own.
        physics_dt: Simulate at this physics step in place of the runs' [s].
        task: Another environment in place of the runs' own.
        columns: Column map of logs among ``data``; ``None``: guessed.
        strict: Whether one of ``data`` that cannot be used refuses all, instead of being set aside.
        device: Where the runs are simulated; on a GPU they are simulated anew, in float32.

    Returns:
        The content of the last run's comparison.json.

    Raises:
        ValueError: If a run cannot be read, or several cannot be compared.
    """
    paths = [run_folder(folder) for folder in folders]
    if repeated := [str(path) for i, path in enumerate(paths) if path in paths[:i]]:
        raise ValueError(f"{repeated[0]} is named twice. Name each run once, the base model first.")
    for path in paths:
        check_folder(path, anew=FILE)
    runs = [load_tracks(path, data, physics_dt, task, columns, strict, device) for path in paths]
    check_alike(runs)
    contents = [compare_run(run) for run in runs]
    if len(runs) > 1:
        contents[-1]["ladder"] = make_ladder(runs)
    contents = [plain(content) for content in contents]
    files: dict[Path, bytes] = {}
    for run, content in zip(runs, contents, strict=True):
        files[run.folder / FILE] = _dump(content).encode()
        files[run.folder / "report.html"] = report_text(run.folder, {FILE: content})
    write_together(files)
    return contents[-1]


def compare_run(run: RunTracks) -> dict[str, Any]:
    """Everything about one run, for comparison.json."""
    joints = run.result.joint_names
    types = run.result.joint_types
    compared = [compare_joint(joint, j, run.tracks, types[j]) for j, joint in enumerate(joints)]
    worst = worst_places([joint.places for joint in compared])
    floors = [joint.content["noise_floor"] for joint in compared]
    return {
        "version": VERSION,
        "run": str(run.folder),
        "task": run.result.task,
        "robot_name": run.result.robot_name,
        "effects": list(run.result.effects),
        "physics_dt": run.physics_dt,
        "data": list(run.data),
        "joint_names": list(joints),
        "summary": " ".join(filter(None, [summary_of(compared), _carried(joints, compared)])),
        "worst_places": [place_content(place) for place in worst],
        "rmse": rmse_by_part(run.tracks),
        "noise_floor": float(np.sqrt(np.mean(np.square(floors)))),
        "recordings": [
            {
                "name": track.name,
                "samples": len(track.time),
                "duration": float(track.time[-1] - track.time[0]),
                "trained_share": float(track.train.mean()),
                "repetitions": [o.name for o in run.tracks if o.group == track.group and o is not track],
                "held_out": held_out_spans(track.time - track.time[0], ~track.held_out),
            }
            for track in run.tracks
        ],
        "joints": {joint: one.content for joint, one in zip(joints, compared, strict=True)},
        "notes": [*run.notes, *_unrepeatable(joints, compared, run.tracks)],
    }


def _unrepeatable(joints: Sequence[str], compared: Sequence[JointComparison], tracks: Sequence[Track]) -> list[str]:
    """Where recordings of the same commands differ by far more than their noise, which no one model explains."""
    worst: dict[int, tuple[float, str]] = {}
    for j, (name, one) in enumerate(zip(joints, compared, strict=True)):
        for track, own in zip(tracks, one.content["recordings"], strict=True):
            if own["noise_source"] != "repetitions":
                continue
            alone = noise_floor(track.measured[:, j], track.dt).sigma
            times = own["noise_floor"] / max(alone, NEGLIGIBLE)
            if times > _UNREPEATABLE and times > worst.get(track.group, (0.0, ""))[0]:
                factor, unit = position_unit([own["noise_floor"]], [one.content["type"]])
                apart = f"{factor * own['noise_floor']:.3g} {unit}, {times:.0f} times what is noise of each"
                worst[track.group] = times, f"{name} moved differently by {apart}"
    return [
        f"{listed([t.name for t in tracks if t.group == group])} have the same commands, and {said}. No one model "
        "explains them all, and the noise here is their difference: compare them one by one, or look for what changed."
        for group, (_, said) in sorted(worst.items())
    ]


def summary_of(compared: Sequence[JointComparison]) -> str:
    """How many joints are explained, in a sentence or two."""
    count = len(compared)
    done = sum(joint.is_explained for joint in compared)
    spread = sum(not joint.is_explained and not joint.places for joint in compared)
    if done == count:
        which, near = "The joint is" if count == 1 else f"All {count} joints are", 100 * (AT_THE_FLOOR - 1)
        return f"{which} within {near:.0f} % of the noise: a better model could explain little more of this data."
    rest = count - done
    if count == 1:
        text = "There is error above the noise floor that a better model could explain."
    else:
        text = f"{rest} of {count} joints have error above the noise floor that a better model could explain."
    if spread == rest:
        text += " It is spread evenly: no speed, position, load or frequency holds much more than its share."
    elif spread:
        text += f" In {spread} of them it is spread evenly."
    return text


def _carried(joints: Sequence[str], compared: Sequence[JointComparison]) -> str:
    """Which few joints hold nearly all of the squared error; "" where many do."""
    return carried_by({joint: max(own.content["rmse"].values()) for joint, own in zip(joints, compared, strict=True)})


def plain(content: Any) -> Any:
    """As JSON holds it: lists, numbers of five digits, ``null`` for what is not finite."""
    if isinstance(content, dict):
        return {key: plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple | np.ndarray):
        return [plain(value) for value in content]
    if isinstance(content, np.bool_):
        return bool(content)
    if isinstance(content, float | np.floating):
        return float(f"{float(content):.{_DIGITS}g}") if np.isfinite(content) else None
    return int(content) if isinstance(content, np.integer) else content


def _dump(content: Any) -> str:
    """JSON to read by eye: a list of numbers stays on one line."""
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    return re.sub(r"\[[^\[\]{}\"]*\]", lambda m: "[" + " ".join(m.group()[1:-1].split()) + "]", text) + "\n"


def comparison_lines(content: dict[str, Any]) -> list[str]:
    """A row per joint, the worst places, the ladder, as lines."""
    joints = content["joints"]
    parts = [part for part in ("train", "validation") if part in content["rmse"]]
    values = [joint["rmse"].get(part) for joint in joints.values() for part in parts]
    factor, unit = position_unit(values, ["hinge"])
    types = [joint["type"] for joint in joints.values()]
    labels = [joint_label(name, own, types, unit) for name, own in zip(joints, types, strict=True)]
    names, pattern = in_short(labels)
    columns = [[f"joint {pattern}".strip(), *names]]
    columns += [[part, *(cell(j["rmse"].get(part), factor) for j in joints.values())] for part in parts]
    columns += [["noise", *(cell(joint["noise_floor"], factor) for joint in joints.values())]]
    columns += [["above noise", *(percent(joint["share_above_floor"]) for joint in joints.values())]]
    head, *rows = aligned(columns)
    lines = [f"{head}   [{units_for(unit, types)}]"]
    for name, row in zip(joints, rows, strict=True):
        own = [
            place["sentence"].removeprefix(f"{name}: ") for place in content["worst_places"] if place["joint"] == name
        ]
        lines += [row, *(f"    {sentence}" for sentence in own)]
    lines += _split(content, factor, "recording", [each["name"] for each in content["recordings"]])
    lines += _split(content, factor, "drive", ["off", "on"])
    lines += ["", content["summary"]]
    if "ladder" in content:
        lines += ["", *ladder_table(content["ladder"], types)]
    return lines + [f"note: {note}" for note in shortened(content["notes"], "note")]


def _split(content: dict[str, Any], factor: float, name: str, labels: Sequence[str]) -> list[str]:
    """The error of all joints, and the largest joint's, in each part of a dimension; nothing where it has one part.

    Args:
        factor: From SI units to those of the table.
    """
    found = {joint: one["where"][name]["rms"] for joint, one in content["joints"].items() if name in one["where"]}
    if not found:
        return []
    rows = [[name, "all joints", "largest", ""]]
    for i, label in enumerate(labels):
        values = {joint: rms[i] for joint, rms in found.items()}
        worst = max(values, key=lambda joint: values[joint])
        whole = math.sqrt(sum(value**2 for value in values.values()) / len(values))
        rows.append([label, cell(whole, factor), cell(values[worst], factor), worst])
    *numbers, worst_joints = zip(*rows, strict=True)
    return ["", *(f"{row}  {joint}".rstrip() for row, joint in zip(aligned(numbers), worst_joints, strict=True))]
