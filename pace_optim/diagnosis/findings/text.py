"""A diagnosis as lines to print: the verdict, what was found and how large it is, its likes, what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pace_actuators.joint_units import units_for
from pace_actuators.text import SHOWN, conjoined, listed, shortened, sizes_by_joints, spoken, three_figures
from pace_optim.diagnosis.findings.result import Diagnosis

_EFFECTS = 8
"""Effects in the list of what was tried, at most."""


def first_line(diagnosis: Diagnosis) -> str:
    """What is printed of it before the whole robot is fitted with what was found."""
    found = [*(link["label"] for link in diagnosis.links), *diagnosis.paying]
    return f"each joint alone: {diagnosis.verdict}, {listed(found)}; the fit of the whole robot decides"


def lines_of(diagnosis: Diagnosis) -> list[str]:
    """What is printed of a diagnosis, the most important first."""
    lines = [f"verdict: {diagnosis.verdict}", diagnosis.summary, *diagnosis.evidence]
    lines += [f"{effect} cannot be separated from {conjoined(likes)}." for effect, likes in diagnosis.likes.items()]
    lines += [f"- {sentence}" for sentence in shortened(diagnosis.advice, "proposal")]
    if diagnosis.ranking:
        unit = units_for("mrad", diagnosis.joint_types(diagnosis.joints))
        lines.append(f"Effects tried, each joint alone, with its validation error before -> after [{unit}]:")
    for entry in diagnosis.ranking[:_EFFECTS]:
        own = [
            f"{joint} {' -> '.join(three_figures(1e3 * rmse) for rmse in both)}"
            for joint, both in entry.get("tried", {}).items()
        ]
        name = entry["effect"] + (f" (round {entry['round']})" if entry["round"] > 1 else "")
        lines.append(f"  {name:26s} {entry.get('status', ''):12s}  {listed(own, SHOWN)}")
    return lines + [f"- {sentence}" for sentence in shortened(diagnosis.data, "note")]


def size_lines(sizes: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each value: "  torque gain of servo: 0.45 ± 0.002 times what was stated"."""
    return [
        f"  {spoken(f'{effect}.{parameter}')} of {conjoined(joints)}: {text}"
        for (effect, parameter, text), joints in sizes_by_joints(sizes).items()
    ]
