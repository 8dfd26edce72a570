"""A diagnosis as lines to print: the verdict, what was found and how large it is, its likes, what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pace_actuators.joint_units import units_for
from pace_actuators.text import SHOWN, conjoined, listed, shortened, sizes_by_joints
from pace_optim.diagnosis.findings.result import Diagnosis

_EFFECTS = 8
"""Effects in the list of what was tried, at most."""


def lines_of(diagnosis: Diagnosis) -> list[str]:
    """What is printed as soon as the verdict is known, the most important first; sizes come with the refit."""
    lines = [f"verdict: {diagnosis.verdict}", diagnosis.summary]
    lines += [f"{effect} cannot be separated from {conjoined(likes)}." for effect, likes in diagnosis.likes.items()]
    lines += [f"- {sentence}" for sentence in shortened(diagnosis.advice, "proposal")]
    names = list(diagnosis.joints)
    if diagnosis.ranking:
        lines.append("Effects tried, with the validation error of their joints before and after (each joint alone):")
    for entry in diagnosis.ranking[:_EFFECTS]:
        before, after = 1e3 * entry["validation_rmse_before"], 1e3 * entry["validation_rmse_after"]
        mark = "added" if entry["added"] else ("would pay" if entry["significant"] else "does not pay")
        unit = units_for("mrad", diagnosis.joint_types(entry["joints"]))
        joints = entry["joints"]
        where = f"on {listed(joints) if len(joints) <= SHOWN else f'{len(joints)} of {len(names)} joints'}"
        where = where if len(names) > 1 else ""
        lines.append(f"  {entry['effect']:26s} {before:8.3f} -> {after:8.3f} {unit}  {mark:13s}  {where}".rstrip())
    return lines + [f"- {sentence}" for sentence in shortened(diagnosis.data, "note")]


def size_lines(sizes: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each value: "  torque_gain.gain of servo: 0.45 ± 0.002 times what was stated"."""
    return [
        f"  {effect}.{parameter} of {conjoined(joints)}: {text}"
        for (effect, parameter, text), joints in sizes_by_joints(sizes).items()
    ]
