"""Several runs side by side: the error from the base model to the last effect."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from markupsafe import Markup

from pace_actuators.drive_result import ALL
from pace_actuators.joint_units import JointType
from pace_actuators.text import position_unit, three_figures

from ..markup import Section, bold, figure, table
from ..run_data import RunData

_PARTS = {"validation": ("validation", "var(--heldedge)"), "train": ("training", "var(--target)")}
_TICKS = [digit * 10.0**power for power in range(-6, 7) for digit in (1, 2, 5)]
"""Where plotly itself would write 5 for both 5 and 0.5."""


def ladder(run: RunData) -> Section | None:
    """The ladder that ``compare.py`` wrote for several runs."""
    content = (run.read_json("comparison.json") or {}).get("ladder")
    if not content:
        return None
    steps, floor = content["steps"], content["noise_floor"]
    types = run.result.joint_types
    parts = [part for part in _PARTS if all(step["rmse"].get(part) for step in steps)]
    if not parts:
        return None
    factor, unit = position_unit([step["rmse"][part][ALL] for step in steps for part in parts], types)
    return Section(
        id="ladder",
        title="Error ladder",
        lead=_sentence(steps, parts[0], floor[ALL], types),
        html=figure("error-ladder", _traces(steps, parts, floor, factor, unit), _layout(unit), height=360)
        + _table(steps, parts, floor, factor, unit),
    )


def _sentence(steps: list[dict[str, Any]], part: str, floor: float, types: Sequence[JointType]) -> str:
    first, last = (step["rmse"][part][ALL] for step in (steps[0], steps[-1]))
    factor, unit = position_unit([first], types)
    change = first / last if last > 0 else 1.0
    size = (
        f"{change:.3g} times less" if change >= 1.005 else "no less" if change > 0.995 else f"{1 / change:.3g} × more"
    )
    fall = f"{factor * first:.3g} to {factor * last:.3g} {unit}"
    return (
        f"From “{steps[0]['name']}” to “{steps[-1]['name']}” the {_PARTS[part][0]} error goes from {fall}, {size}. "
        f"The measurement's noise is {factor * floor:.3g} {unit}: no model can go below."
    )


def _traces(
    steps: list[dict[str, Any]], parts: list[str], floor: dict[str, float], factor: float, unit: str
) -> list[dict[str, Any]]:
    names = [f"{i + 1}. {step['name']}" for i, step in enumerate(steps)]
    joints = [joint for joint in steps[-1]["rmse"][parts[0]] if joint != ALL]
    traces: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": joint,
            "x": names,
            "y": [factor * step["rmse"][parts[0]][joint] for step in steps],
            "line": {"width": 1, "color": "var(--target)"},
            "opacity": 0.45,
            "showlegend": False,
            "hovertemplate": f"{escape(joint)}: %{{y:.3g}} {unit}<extra></extra>",
        }
        for joint in (joints if len(joints) > 1 else [])
    ]
    for part in reversed(parts):
        word, color = _PARTS[part]
        traces.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": f"{word}, all joints" if len(joints) > 1 else word,
                "x": names,
                "y": [factor * step["rmse"][part][ALL] for step in steps],
                "line": {"width": 2.5, "color": color},
                "marker": {"size": 8},
                "hovertemplate": f"{word}: %{{y:.3g}} {unit}<extra></extra>",
            }
        )
    traces.append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": "noise floor",
            "x": names,
            "y": [factor * floor[ALL]] * len(names),
            "line": {"width": 1.5, "dash": "dot", "color": "var(--muted)"},
            "hovertemplate": f"noise floor: %{{y:.3g}} {unit}<extra></extra>",
        }
    )
    return traces


def _layout(unit: str) -> dict[str, Any]:
    axis = {
        "type": "log",
        "title": {"text": f"error [{unit}]"},
        "tickvals": _TICKS,
        "ticktext": [f"{tick:g}" for tick in _TICKS],
    }
    return {"yaxis": axis, "xaxis": {"type": "category", "showgrid": False}, "hovermode": "closest"}


def _table(steps: list[dict[str, Any]], parts: list[str], floor: dict[str, float], factor: float, unit: str) -> Markup:
    rows = []
    for step in steps:
        cells: list[str] = [bold(step["name"])]
        for part in parts:
            ratio = step["ratio_to_previous"].get(part)
            cells += [three_figures(factor * step["rmse"][part][ALL]), "" if ratio is None else f"{ratio:.3g}"]
        rows.append(cells)
    rows.append(["noise floor", *[three_figures(factor * floor[ALL]), ""] * len(parts)])
    head = ["model"]
    for part in parts:
        head += [f"{_PARTS[part][0]} [{unit}]", "× better than before"]
    return table(head, rows)
