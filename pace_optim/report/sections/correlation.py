"""Which parameters could stand in for each other."""

from __future__ import annotations

from pace_actuators.drive_result import ALL
from pace_actuators.text import capitalised, in_words

from ..markup import Section, bullets, figure, html
from ..run_data import RunData

_STRONG = 0.9
_MOST_SENTENCES = 8
_MOST_LABELS = 30
"""With more parameters the axes name the groups alone."""


def correlation(run: RunData) -> Section | None:
    """The heat map of the estimates' correlation, and its strongest pairs in words."""
    labels: list[str] = run.result.correlation.get("labels", [])
    matrix: list[list[float | None]] = run.result.correlation.get("matrix", [])
    if not any(value is not None for row in matrix for value in row):
        return None
    words = _in_sentences(strong_pairs(labels, matrix), labels)
    if len(words) > _MOST_SENTENCES:
        words = [*words[:_MOST_SENTENCES], f"and {len(words) - _MOST_SENTENCES} more"]
    said = (
        html("<p>Beyond ±{{ strong }}, so the recording hardly separates them:</p>", strong=f"{_STRONG:g}")
        + bullets(words)
        if words
        else html("<p>No pair is beyond ±{{ strong }}.</p>", strong=f"{_STRONG:g}")
    )
    return Section(
        id="correlation",
        title="Correlation",
        lead="+1 or −1: if one parameter were off, the other would make up for it. Empty: at its bound, or without "
        "influence.",
        html=said + figure("correlation-map", [_heat_map(labels, matrix)], _layout(labels), height=620),
    )


def strong_pairs(labels: list[str], matrix: list[list[float | None]]) -> list[tuple[float, str, str]]:
    """Pairs of labels beyond ±0.9, the strongest first, as (correlation, label, label)."""
    pairs = [
        (value, labels[i], labels[j])
        for i in range(len(labels))
        for j in range(i)
        if (value := matrix[i][j]) is not None and abs(value) >= _STRONG
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[0]))


def _in_sentences(pairs: list[tuple[float, str, str]], labels: list[str]) -> list[str]:
    """Pairs in words; the same two parameters of one joint come once for all joints."""
    groups: dict[tuple[str, ...], list[tuple[float, str]]] = {}
    for value, a, b in pairs:
        (name_a, key_a), (name_b, key_b) = a.split("/", 1), b.split("/", 1)
        same = key_a == key_b != ALL
        groups.setdefault((name_a, name_b) if same else (a, b, "each its own"), []).append((value, key_a))
    sentences = []
    for names, found in groups.items():
        values = [f"{value:+.2f}".replace("-", "−") for value, _ in found]
        if len(names) == 3:
            sentences.append(f"{_say(names[0])} and {_say(names[1])}: {values[0]}")
            continue
        said = " and ".join(in_words(name).lower() for name in names)
        range_ = values[0] if values[0] == values[-1] else f"{values[0]} to {values[-1]}"
        sentences.append(f"{said} of {_listed(found, labels)}: {range_}")
    return [capitalised(sentence) for sentence in sentences]


def _listed(found: list[tuple[float, str]], labels: list[str]) -> str:
    """Joints in their order, or that it is all of them."""
    joints = [key for key in dict.fromkeys(label.split("/", 1)[1] for label in labels) if key != ALL]
    named = {key for _, key in found}
    return "every joint" if len(joints) == len(named) > 1 else ", ".join(key for key in joints if key in named)


def _say(label: str) -> str:
    name, key = label.split("/", 1)
    return in_words(name).lower() + ("" if key == ALL else f" of {key}")


def _heat_map(labels: list[str], matrix: list[list[float | None]]) -> dict:
    return {
        "type": "heatmap",
        "z": [[None if value is None else round(value, 3) for value in row] for row in matrix],
        "zmin": -1,
        "zmax": 1,
        "colorscale": [[0, "var(--measured)"], [0.5, "var(--paper)"], [1, "var(--simulated)"]],
        "colorbar": {"thickness": 12, "outlinewidth": 0, "tickvals": [-1, -0.5, 0, 0.5, 1]},
        "hovertemplate": "%{y}<br>%{x}<br><b>%{z:.3f}</b><extra></extra>",
        "x": labels,
        "y": labels,
        "xgap": 0.5,
        "ygap": 0.5,
    }


def _layout(labels: list[str]) -> dict:
    """Axes that name every parameter, or the groups where there are many."""
    axis: dict = {"type": "category", "showgrid": False, "zeroline": False, "constrain": "domain"}
    shapes = []
    groups: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        groups.setdefault(label.split("/")[0], []).append(i)
    if len(labels) > _MOST_LABELS:
        axis |= {
            "tickvals": [labels[(where[0] + where[-1]) // 2] for where in groups.values()],
            "ticktext": [in_words(name) for name in groups],
        }
    for where in list(groups.values())[1:]:
        edge = where[0] - 0.5
        line = {"type": "line", "line": {"color": "var(--muted)", "width": 1}}
        shapes.append(line | {"y0": -0.5, "y1": len(labels) - 0.5, "x0": edge, "x1": edge})
        shapes.append(line | {"x0": -0.5, "x1": len(labels) - 0.5, "y0": edge, "y1": edge})
    return {
        "xaxis": axis | {"tickangle": 0 if len(labels) > _MOST_LABELS else -45},
        "yaxis": axis | {"autorange": "reversed", "scaleanchor": "x"},
        "shapes": shapes,
        "plot_bgcolor": "var(--wash)",
        "margin": {"l": 110, "b": 60},
    }
