"""A comparison for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pace_actuators.joint_units import joint_label, units_for
from pace_actuators.text import position_unit, shortened, three_figures

from .ladder import ladder_table


def comparison_lines(content: dict[str, Any]) -> list[str]:
    """A row per joint, the worst places, the ladder, as lines."""
    joints = content["joints"]
    parts = [part for part in ("train", "validation") if part in content["rmse"]]
    values = [joint["rmse"].get(part) for joint in joints.values() for part in parts]
    factor, unit = position_unit(values, ["hinge"])
    types = [joint["type"] for joint in joints.values()]
    labels = [joint_label(name, own, types, unit) for name, own in zip(joints, types, strict=True)]
    width = max(5, *(len(label) for label in labels))
    head = f"{'joint':{width}}" + "".join(f"  {part:>10}" for part in parts) + f"  {'noise':>10}  above noise"
    lines = [f"{head}   [{units_for(unit, types)}]"]
    for label, joint in zip(labels, joints.values(), strict=True):
        cells = "".join(_cell(joint["rmse"].get(part), factor) for part in parts)
        share = f"{100 * joint['share_above_floor']:.0f} %"
        lines.append(f"{label:{width}}{cells}{_cell(joint['noise_floor'], factor)}  {share:>11}")
    lines += _split(content, factor, "recording", [each["name"] for each in content["recordings"]])
    lines += _split(content, factor, "drive", ["off", "on"])
    lines += ["", content["summary"]]
    lines += [f"  {place['sentence']}" for place in content["worst_places"]]
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
    width = max(len(name), *(len(label) for label in labels))
    lines = ["", f"{name:{width}}  {'all joints':>10}  {'largest':>10}"]
    for i, label in enumerate(labels):
        values = {joint: rms[i] for joint, rms in found.items()}
        worst = max(values, key=lambda joint: values[joint])
        whole = math.sqrt(sum(value**2 for value in values.values()) / len(values))
        lines.append(f"{label:{width}}{_cell(whole, factor)}{_cell(values[worst], factor)}  {worst}")
    return lines


def _cell(value: float | None, factor: float) -> str:
    return f"  {'–' if value is None else three_figures(factor * value):>10}"
