"""Which physical effect is missing: the verdict, the evidence, and what to do next."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from markupsafe import Markup

from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import in_words, percent, three_figures

from ..markup import Section, bold, bullets, figure, html, joined, table
from ..run_data import RunData
from .parameters import knots_table

_SHOWN = 10
"""Effects in the chart, at most."""
_FACTOR = 1e3
"""Of all errors in the section, as its sentences have them: in mrad, of slides mm."""
_COMMAND = re.compile(r"(?=\b(?:python )?scripts/\w+\.py |\bpace [a-z]+(?:-[a-z]+)? --)")


def diagnosis(run: RunData) -> Section | None:
    """What ``diagnose.py`` found."""
    content = run.read_json("diagnosis.json")
    if not content:
        return None
    parts = [
        _ladder(content),
        _error_map(content),
        _ranking(content),
    ]
    parts += [_advice(content), _data(content)]
    return Section(id="diagnosis", title="Diagnosis", html=joined(parts))


def _floor(content: dict[str, Any]) -> float:
    """Of all joints [rad]."""
    floors = [joint["floor"] for joint in content["joints"].values()]
    return (sum(floor**2 for floor in floors) / max(1, len(floors))) ** 0.5


def _types(content: dict[str, Any], joints: Iterable[str]) -> list[JointType]:
    """Whether joints turn or slide; files of earlier versions do not say it."""
    return [content["joints"].get(joint, {}).get("type", "hinge") for joint in joints]


def _unit(content: dict[str, Any]) -> str:
    """Of the errors of all joints."""
    return units_for("mrad", _types(content, content["joints"]))


def _ladder(content: dict[str, Any]) -> Markup:
    steps = content.get("ladder", [])
    if not steps:
        return Markup("")
    floor = _floor(content)
    factor, unit = _FACTOR, _unit(content)
    rows, before = [], None
    for step in steps:
        error = step["validation_rmse"]
        gain = "" if before is None or error <= 0 else f"{before / error:.3g}"
        model = html("<b>{{ parts | join(bar) }}</b>", parts=step["model"].split("|"), bar=Markup("|<wbr>"))
        rows.append([model, three_figures(factor * error), gain])
        before = error
    rows.append(["floor of noise and numerics", three_figures(factor * floor), ""])
    head = [
        "whole robot" if "run" in steps[0] else "model, each joint simulated alone",
        f"validation [{unit}]",
        "× better than before",
    ]
    return _titled("The error with it", table(head, rows, "ladder"))


def _ranking(content: dict[str, Any]) -> Markup:
    entries = content["ranking"]
    tried = html(
        "{% if tried %}<p>{{ tried }} effects were tried.</p>{% endif %}", tried=len(content.get("tried") or ())
    )
    if not entries:
        return _titled("Effects", html("<p>No effect was worth a refit.</p>") + tried)
    factor, unit = _FACTOR, _unit(content)
    chart = _chart(entries[:_SHOWN], _floor(content), factor, unit)
    about = "each joint simulated alone, refitted one effect at a time, judged on recordings that were not fitted"
    return _titled("Effects", chart + _evidence(entries, factor, unit) + tried, about)


def _name(entry: dict[str, Any]) -> str:
    return entry["effect"] if entry.get("round", 1) == 1 else f"{entry['effect']} (round {entry['round']})"


def _chart(entries: list[dict[str, Any]], floor: float, factor: float, unit: str) -> Markup:
    names = [_name(entry) for entry in reversed(entries)]
    traces = []
    for key, word, color in (  # from the bottom up
        ("validation_rmse_after", "after", "var(--heldedge)"),
        ("validation_rmse_before", "before", "var(--target)"),
    ):
        traces.append(
            {
                "type": "bar",
                "orientation": "h",
                "name": word,
                "y": names,
                "x": [factor * entry[key] for entry in reversed(entries)],
                "marker": {"color": color},
                "hovertemplate": f"%{{y}}, {word}: %{{x:.3g}} {unit}<extra></extra>",
            }
        )
    floor_line = {
        "type": "scatter",
        "mode": "lines",
        "name": "floor",
        "x": [factor * floor] * len(names),
        "y": names,
        "line": {"width": 1.5, "dash": "dot", "color": "var(--muted)"},
        "hovertemplate": f"floor: %{{x:.3g}} {unit}<extra></extra>",
    }
    layout = {
        "barmode": "group",
        "bargap": 0.35,
        "xaxis": {"title": {"text": f"validation error [{unit}]"}, "rangemode": "tozero"},
        "yaxis": {"type": "category", "automargin": True, "showgrid": False},
        "hovermode": "closest",
        "legend": {"traceorder": "reversed", "orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
    }
    return figure("effect-ranking", [floor_line, *traces], layout, height=130 + 42 * len(names))


def _evidence(entries: list[dict[str, Any]], factor: float, unit: str) -> Markup:
    rows = []
    for entry in entries:
        tried = entry.get("tried", {}).items()
        errors = {joint: " → ".join(three_figures(factor * e) for e in own) for joint, own in tried}
        rows.append(
            [
                bold(_name(entry)),
                entry.get("status", ""),
                html("{% for joint, text in errors.items() %}{{ joint }}: {{ text }}<br>{% endfor %}", errors=errors),
                ", ".join(entry["confounded_with"]) or "–",
                entry["evidence"],
            ]
        )
    head = ["effect", "", f"validation of each joint [{unit}]", "cannot be separated from", "evidence"]
    return table(head, rows, "evidence")


def _error_map(content: dict[str, Any]) -> Markup:
    """Which variable carries what is missing, on joints that effects leave far from the floor."""
    joints = {name: each for name, each in content.get("error_map", {}).items() if "explained" in each}
    if not joints:
        return Markup("")
    parts = {name: joint["explained"] for name, joint in joints.items()}
    curves = sorted(next(iter(parts.values())), key=lambda curve: -max(own[curve] for own in parts.values()))
    rows = [[bold(in_words(curve)), *(percent(max(0.0, own[curve])) for own in parts.values())] for curve in curves]
    said = bullets([f"{name}: {joint['sentence']}" for name, joint in joints.items()], "notes")
    about = (
        "part of the squared error above the floor that a curve of any form explains by itself, "
        "on top of the base model; curves that explain as much are one cause over several variables"
    )
    shown = table(["curve", *joints], rows)
    return _titled("What carries the error", said + _curve(content, joints) + shown, about)


def _curve(content: dict[str, Any], joints: dict[str, dict[str, Any]]) -> Markup:
    """The curve of each joint: a figure of all over the same variable, and a table of their knots."""
    shown = {name: joint for name, joint in joints.items() if joint["curve"]}
    parts: list[Markup] = []
    for label in dict.fromkeys((joint["best_label"], joint["kind"]) for joint in shown.values()):
        own = {name: joint for name, joint in shown.items() if (joint["best_label"], joint["kind"]) == label}
        parts.append(_knots(own, units_for("N m", _types(content, own)), len(parts)))
    return joined(parts)


def _knots(joints: dict[str, dict[str, Any]], unit: str, count: int) -> Markup:
    """Curves over one variable."""
    variable, kind = next((joint["best_label"], joint["kind"]) for joint in joints.values())
    traces, units = [], {"variable": variable, "value": f"{kind} [{unit}]"}
    for name, joint in joints.items():
        at, values = joint["curve"]["at"], joint["curve"]["torque"]
        hover = f"%{{x:.3g}}: %{{y:.3g}} {unit}"
        trace = {"type": "scatter", "mode": "lines+markers", "name": name, "x": at, "y": values, "hovertemplate": hover}
        traces.append(trace)
    layout = {"xaxis": {"title": {"text": variable}}, "yaxis": {"title": {"text": units["value"]}}}
    knots = knots_table({name: units | joint["curve"] for name, joint in joints.items()})
    return figure(f"error-map{count or ''}", traces, layout, height=300) + knots


def _advice(content: dict[str, Any]) -> Markup:
    if not content["advice"]:
        return Markup("")
    entries = [_COMMAND.split(sentence) for sentence in content["advice"]]
    listed = html(
        "<ul>{% for entry in entries %}<li>{{ entry[0].strip() }}{% for command in entry[1:] %}<pre>"
        "{{ command.strip() }}</pre>{% endfor %}</li>{% endfor %}</ul>",
        entries=entries,
    )
    return _titled("What to do and to record next", listed)


def _data(content: dict[str, Any]) -> Markup:
    return _titled("The recordings", bullets(content["data"], "notes")) if content["data"] else Markup("")


def _titled(title: str, content: Markup, about: str = "") -> Markup:
    """A part under its heading."""
    text = "<h3>{{ title }}{% if about %}<small>{{ about }}</small>{% endif %}</h3>{{ content }}"
    return html(text, title=title, about=about, content=content)
