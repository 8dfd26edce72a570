"""Several runs side by side: how the error falls from the base model to the last effect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pace_actuators.drive_result import ALL
from pace_actuators.joint_units import JointType
from pace_actuators.text import aligned, position_unit, three_figures
from pace_optim.run.tensors import rms

from .joint import noise_floors, rmse_by_part
from .tracks import RunTracks, Track

_PARTS = ("train", "validation")


def check_alike(runs: Sequence[RunTracks]) -> None:
    """Runs can be compared if they have the same task and joints, and the same recordings, split alike."""
    first = runs[0]
    for other in runs[1:]:
        differences = []
        for name in ("task", "joint_names"):
            a, b = getattr(first.result, name), getattr(other.result, name)
            if a != b:
                differences.append(f"the {name.replace('_', ' ')}: {a} against {b}")
        if not differences:
            differences = _recording_differences(first.tracks, other.tracks)
        if differences:
            raise ValueError(
                f"{first.folder} and {other.folder} cannot stand side by side; their result.json differ in "
                f"{'; '.join(differences)}."
                " Fit both to the same recordings, or simulate both on the same files with --data."
            )


def _recording_differences(ones: Sequence[Track], others: Sequence[Track]) -> list[str]:
    names = [[track.name for track in tracks] for tracks in (ones, others)]
    if names[0] != names[1]:
        return [f"the recordings: {', '.join(names[0])} against {', '.join(names[1])}"]
    result = []
    for one, other in zip(ones, others, strict=True):
        if one.measured.shape != other.measured.shape:
            result.append(f"the length of {one.name}: {len(one.time)} against {len(other.time)} samples")
        elif not (np.allclose(one.measured, other.measured) and np.allclose(one.target, other.target)):
            result.append(f"the content of {one.name}")
        elif not np.array_equal(one.train, other.train):
            shares = [f"{100 * track.train.mean():.0f} %" for track in (one, other)]
            result.append(f"what was trained on of {one.name}: {shares[0]} against {shares[1]}")
    return result


def make_ladder(runs: Sequence[RunTracks]) -> dict[str, Any]:
    """The steps of the ladder, in the order of the runs, and the noise floor beneath it."""
    joints, tracks = runs[-1].result.joint_names, runs[-1].tracks
    floors = {joint: _floor(j, tracks) for j, joint in enumerate(joints)}
    floors[ALL] = float(np.sqrt(np.mean(np.square(list(floors.values())))))
    steps: list[dict[str, Any]] = []
    for run, name in zip(runs, _names(runs), strict=True):
        rmse = {part: _rmse_by_joint(run, part) for part in _PARTS}
        before = steps[-1]["rmse"] if steps else {part: {} for part in _PARTS}
        steps.append(
            {
                "run": str(run.folder),
                "name": name,
                "effects": list(run.result.effects),
                "physics_dt": run.physics_dt,
                "rmse": rmse,
                "ratio_to_previous": {
                    part: before[part][ALL] / rmse[part][ALL] for part in _PARTS if before[part] and rmse[part].get(ALL)
                },
            }
        )
    return {"steps": steps, "noise_floor": floors}


def ladder_table(ladder: dict[str, Any], joint_types: Sequence[JointType]) -> list[str]:
    """The ladder as lines for a terminal; its errors are of joints of these types."""
    steps, floor = ladder["steps"], ladder["noise_floor"][ALL]
    factor, unit = position_unit([s["rmse"][part].get(ALL) for s in steps for part in _PARTS], joint_types)
    rows = [["", *(f"{part} [{unit}]" for part in _PARTS), "× better (train, validation)"]]
    for step in steps:
        values = [cell(step["rmse"][part].get(ALL), factor) for part in _PARTS]
        ratio = [f"{step['ratio_to_previous'][part]:.2f}" for part in _PARTS if part in step["ratio_to_previous"]]
        rows.append([step["name"], *values, ", ".join(ratio)])
    rows.append(["noise floor", *[cell(floor, factor)] * 2, ""])
    return [row.rstrip() for row in aligned(list(zip(*rows, strict=True)))]


def _floor(j: int, tracks: Sequence[Track]) -> float:
    floors = noise_floors(j, tracks)
    return rms(np.concatenate([np.full(len(t.time), f.sigma) for t, f in zip(tracks, floors, strict=True)])) or 0.0


def _names(runs: Sequence[RunTracks]) -> list[str]:
    """Each run's effects, and what else differs between the runs."""
    names = [" + ".join(run.result.effects) or "base model" for run in runs]
    for part in ([f"{run.result.delay_mode} delay" for run in runs], [f"{1e3 * run.physics_dt:g} ms" for run in runs]):
        if len(set(part)) > 1:
            names = [f"{name}, {own}" for name, own in zip(names, part, strict=True)]
    return names


def _rmse_by_joint(run: RunTracks, part: str) -> dict[str, float]:
    """Of every joint and of all; empty if no sample is of that part."""
    every = rmse_by_part(run.tracks)
    if part not in every:
        return {}
    return {j: rmse_by_part(run.tracks, i)[part] for i, j in enumerate(run.result.joint_names)} | {ALL: every[part]}


def cell(value: float | None, factor: float) -> str:
    """A number of a table in its unit; a dash for none."""
    return "–" if value is None else three_figures(factor * value)
