"""A comparison for a terminal."""

from __future__ import annotations

from typing import Any

from pace_actuators.joint_units import joint_label, units_for
from pace_optim.report.number_text import position_unit

from .ladder import ladder_table


def comparison_lines(content: dict[str, Any]) -> list[str]:
    """A row per joint, the worst places, the ladder, as lines.

    Args:
        content: Of comparison.json.
    """
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
    lines += ["", content["summary"]]
    lines += [f"  {place['sentence']}" for place in content["worst_places"]]
    if "ladder" in content:
        lines += ["", *ladder_table(content["ladder"], types)]
    return lines + [f"note: {note}" for note in content["notes"]]


def _cell(value: float | None, factor: float) -> str:
    return f"  {'–':>10}" if value is None else f"  {factor * value:#10.3g}"
