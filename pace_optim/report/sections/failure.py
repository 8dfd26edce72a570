"""Where the model fails: in words, and in one joint's figures in one recording (time, places, frequencies, loops)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from markupsafe import Markup

from pace_actuators.joint_units import JointType, joint_label, units_for
from pace_actuators.text import in_short, percent, position_text, position_unit, short_duration, three_figures

from ..markup import Section, bullets, choice, html, json_script, log_step, table
from ..run_data import RunData


def failure(run: RunData) -> Section | None:
    """What ``compare.py`` found."""
    content = run.read_json("comparison.json")
    if not content:
        return None
    recordings = [recording["name"] for recording in content["recordings"]]
    page = {
        "joints": content["joint_names"],
        "figures": {name: {"traces": made.traces, "layout": made.layout} for name, made in FIGURES.items()},
        "cells": [
            [
                {
                    name: made.cell(content["joints"][joint], r, content["recordings"][r])
                    for name, made in FIGURES.items()
                }
                for joint in content["joint_names"]
            ]
            for r in range(len(recordings))
        ],
    }
    r, j = _worst_place(content)
    return Section(
        id="failure",
        title="Where the model fails",
        lead=content["summary"] + _basis(content),
        html=html(
            '{{ by_joint }}{{ notes }}<div class="chooser">{{ recording }}{{ joint }}'
            '{% for name, made in figures.items() %}<div data-figure="{{ name }}"><h3>{{ made.title }}</h3>'
            '<p class="said"></p><div class="canvas" style="height:{{ made.height }}px"></div></div>{% endfor %}'
            "{{ script }}</div>",
            by_joint=_by_joint(content),
            notes=bullets(content["notes"], "notes") if content["notes"] else "",
            recording=choice("recording", recordings, "failure-", r),
            joint=choice("joint", content["joint_names"], "failure-", j),
            figures=FIGURES,
            script=json_script(page),
        ),
    )


def _worst_place(content: dict[str, Any]) -> tuple[int, int]:
    """Recording and joint that the curves open on: of the worst place's joint, the recording with the largest error."""
    names = content["joint_names"]
    joint = content["worst_places"][0]["joint"] if content["worst_places"] else names[0]
    largest = [max(filter(None, one["rmse"].values()), default=0.0) for one in content["joints"][joint]["recordings"]]
    return largest.index(max(largest)), names.index(joint)


def _basis(content: dict[str, Any]) -> str:
    return f" On {', '.join(content['data'])}, which are not the run's own recordings." if content["data"] else ""


def _by_joint(content: dict[str, Any]) -> Markup:
    parts = [part for part in ("train", "validation") if part in content["rmse"]]
    joints = content["joints"]
    types = [own for joint in joints.values() for own in types_of(joint)]
    factor, unit = position_unit([joint["rmse"].get(part) for joint in joints.values() for part in parts], ["hinge"])
    rows = []
    short, pattern = in_short(list(joints))
    for (name, joint), shown, own in zip(joints.items(), short, types, strict=True):
        share = joint["share_above_floor"]
        label = joint_label(shown, own, types, unit)
        rows.append(
            [
                html('<a href="#failure" data-joint="{{ name }}"><b>{{ label }}</b></a>', name=name, label=label),
                *(three_figures(factor * joint["rmse"][part]) for part in parts),
                three_figures(factor * joint["noise_floor"]),
                html(
                    '<span class="share"><div><i style="width:{{ share }}%"></i></div>{{ text }}</span>',
                    share=f"{100 * share:.0f}",
                    text=percent(share),
                ),
                joint["sentence"].removeprefix(f"{name}: ").removeprefix(f"{name} "),
            ]
        )
    unit, words = units_for(unit, types), {"train": "training", "validation": "validation"}
    head = [
        f"joint {pattern}".strip(),
        *(f"{words[part]} [{unit}]" for part in parts),
        f"noise [{unit}]",
        "error² above noise",
        "where",
    ]
    return table(head, rows, "by-joint")


_LETTERS = 40
"""Of tick labels that a panel has room for."""
_PANELS = ("velocity", "since_reversal", "position", "load", "acceleration", "time")
_MEASURED, _MODEL, _NOISE = "var(--measured)", "var(--simulated)", "var(--muted)"


@dataclass(frozen=True, kw_only=True)
class FailureFigure:
    """A template of traces, and what fills it for one joint and recording."""

    title: str
    """One message, as a question."""
    height: int
    """[px]."""
    traces: list[dict[str, Any]]
    layout: dict[str, Any]
    cell: Callable[[dict[str, Any], int, dict[str, Any]], dict[str, Any]]
    """Of a joint's content, a recording's index and its facts: {"text", "traces", "layout"}."""


def _line(name: str, color: str, **more: Any) -> dict[str, Any]:
    line = {"color": color, "width": more.pop("width", 1.8)} | ({"dash": more.pop("dash")} if "dash" in more else {})
    return {"type": "scatter", "mode": "lines", "name": name, "line": line} | more


def types_of(joint: dict[str, Any]) -> list[JointType]:
    """Whether the joint of comparison.json turns or slides; files of earlier versions do not say it."""
    return [joint.get("type", "hinge")]


def _numbers(values: Sequence[float | None], factor: float = 1.0) -> list[float | None]:
    return [None if value is None else float(f"{factor * value:.4g}") for value in values]


def _title(text: str) -> dict[str, Any]:
    return {"title": {"text": text}}


# ------------------------------------------------------------------ when


def _over_time(joint: dict[str, Any], r: int, facts: dict[str, Any]) -> dict[str, Any]:
    one = joint["recordings"][r]
    curve, floor = one["over_time"], one["noise_floor"]
    factor, unit = position_unit([*curve["low"], *curve["high"]], types_of(joint))
    words = {"train": "training", "validation": "validation"}
    errors = ", ".join(
        f"{position_text(value, types_of(joint))} in {words[part]}" for part, value in one["rmse"].items()
    )
    source = {"repetitions": "from repetitions", "lattice": "the encoder's steps"}.get(one["noise_source"], "estimated")
    time = _numbers(curve["time"])
    band = {"type": "rect", "xref": "paper", "x0": 0, "x1": 1, "line": {"width": 0}, "layer": "below"}
    shapes = [band | {"y0": -2 * factor * floor, "y1": 2 * factor * floor, "fillcolor": "var(--line)"}]
    shapes += [
        band | {"xref": "x", "yref": "paper", "x0": a, "x1": b, "y0": 0, "y1": 1, "fillcolor": "var(--held)"}
        for a, b in facts["held_out"]
    ]
    return {
        "text": f"Error {errors}; noise {position_text(floor, types_of(joint))} ({source}), so "
        f"{percent(one['share_above_floor'])} of the squared error is above it. Grey: ±2 σ of the noise"
        + ("; shaded: kept for validation." if shapes[1:] else "."),
        "traces": [{"x": time, "y": _numbers(curve[key], factor)} for key in ("low", "high")],
        "layout": {"yaxis": _title(f"error [{unit}]"), "shapes": shapes},
    }


# ------------------------------------------------------------------ where


def _panel_axes() -> dict[str, Any]:
    layout: dict[str, Any] = {"bargap": 0.12, "showlegend": True}
    for i in range(len(_PANELS)):
        row, column = divmod(i, 3)
        key = "" if i == 0 else str(i + 1)
        across, top = column * 0.355, 1.0 - row * 0.58
        layout[f"xaxis{key}"] = {"domain": [across, across + 0.29], "anchor": f"y{key}", "showgrid": False}
        layout[f"xaxis{key}"] |= {"zeroline": False, "tickangle": 0, "ticks": "outside", "ticklen": 3}
        layout[f"xaxis{key}"] |= {"tickfont": {"size": 10.5}}
        layout[f"yaxis{key}"] = {"domain": [top - 0.4, top], "anchor": f"x{key}", "ticksuffix": " %", "nticks": 4}
        layout[f"yaxis{key}"] |= {"rangemode": "tozero", "tickfont": {"size": 10.5}}
    return layout


def _panel_traces() -> list[dict[str, Any]]:
    traces: list[dict[str, Any]] = []
    for i in range(len(_PANELS)):
        key = "" if i == 0 else str(i + 1)
        on = {"xaxis": f"x{key}", "yaxis": f"y{key}", "showlegend": i == 0}
        hover = "%{customdata}<br>%{y:.0f} % of the "
        traces.append(
            {"type": "bar", "name": "share of the error", "marker": {"color": _MODEL}, "legendgroup": "error"}
            | on
            | {"hovertemplate": hover + "error<extra></extra>"}
        )
        traces.append(
            {"type": "scatter", "mode": "markers", "name": "share of the time", "legendgroup": "time"}
            | {"marker": {"symbol": "line-ew", "size": 17, "line": {"width": 2.5, "color": "var(--ink)"}}}
            | on
            | {"hovertemplate": hover + "time<extra></extra>"}
        )
    return traces


def _where(joint: dict[str, Any], r: int, facts: dict[str, Any]) -> dict[str, Any]:
    where = joint["recordings"][r]["where"]
    traces: list[dict[str, Any]] = []
    layout: dict[str, dict[str, Any]] = {}
    for i, name in enumerate(_PANELS):
        panel = where.get("swing" if name == "time" and "swing" in where else name)
        key = "" if i == 0 else str(i + 1)
        if panel is None:
            traces += [{"x": [], "y": []}] * 2
            layout[f"xaxis{key}"] = {"visible": False}
            layout[f"yaxis{key}"] = {"visible": False}
            continue
        edges, unit = panel["edges"], panel["unit"]
        at = [b + 0.5 for b in range(len(panel["time"]))]
        spans = [_span(edges, b, unit) for b in range(len(at))]
        for share in ("error", "time"):
            traces.append({"x": at, "y": _numbers(panel[share], 100.0), "customdata": spans})
        inner = [b for b in range(len(edges)) if edges[b] is not None]
        texts = _apart([_tick(edges[b]) for b in inner], len(at))
        layout[f"xaxis{key}"] = {"tickvals": inner, "ticktext": texts, "range": [-0.05, len(at) + 0.05]}
        layout[f"xaxis{key}"] |= {
            "title": {"text": panel["title"] + f" [{unit}]" * bool(unit), "font": {"size": 12}, "standoff": 4}
        }
    return {"text": joint["sentence"] + " (Over all recordings.)" * (len(joint["recordings"]) > 1)} | {
        "traces": traces,
        "layout": layout,
    }


def _tick(value: float) -> str:
    return f"{value:.2g}".replace("-", "−")


def _apart(texts: Sequence[str], bars: int) -> list[str]:
    """Labels one bar apart, those left out that would overlap the one before."""
    shown, free = [], -1.0
    for place, text in enumerate(texts):
        half = 0.5 * len(text) * bars / _LETTERS
        fits = place - half > free
        shown.append(text if fits else "")
        free = place + half + bars / _LETTERS if fits else free
    return shown


def _span(edges: Sequence[float | None], b: int, unit: str) -> str:
    low, high = edges[b], edges[b + 1]
    if low is None:
        return f"below {_tick(high)} {unit}" if high is not None else "everywhere"
    return f"above {_tick(low)} {unit}" if high is None else f"{_tick(low)} to {_tick(high)} {unit}"


# ------------------------------------------------------------------ frequency


def _spectrum(joint: dict[str, Any], r: int, facts: dict[str, Any]) -> dict[str, Any]:
    bands = joint["recordings"][r]["where"]["frequency"]
    edges = bands["edges"]
    centre = _numbers([(low * high) ** 0.5 if low > 0 else high / 1.26 for low, high in pairwise(edges)])
    factor, unit = position_unit(bands["rms"], types_of(joint))
    text = "Nothing is above the noise."
    if bands["most"] is not None:
        text = f"{percent(bands['most_share'])} of what is above the noise lies {bands['most']}."
    rms, noise = (_numbers([value or None for value in bands[key]], factor) for key in ("rms", "noise_rms"))
    return {
        "text": text + " Each point is a third of an octave.",
        "traces": [{"x": centre, "y": rms}, {"x": centre, "y": noise}],
        "layout": {"xaxis": {"dtick": log_step(centre)}, "yaxis": _title(f"error [{unit}]")},
    }


def _response(joint: dict[str, Any], r: int, facts: dict[str, Any]) -> dict[str, Any]:
    content = joint["recordings"][r]["response"]
    if content is None:
        return {"text": "The command does not move.", "traces": [{"x": [], "y": []}] * 6, "layout": {}}
    largest, said = content["largest"], []
    for key, name, unit in (("magnitude_db", "magnitude", " dB"), ("phase_deg", "phase", "°")):
        if key in largest:
            value = f"{largest[key]['difference']:+.2g}".replace("-", "−")
            said.append(f"{value}{unit} in {name} (at {largest[key]['frequency']:.2g} Hz)")
    text = "Nowhere is the response coherent enough to judge the model by it."
    if said:
        text = f"The model is off by at most {' and '.join(said)}, where command and position are coherent."
    frequency = _numbers(content["frequency"])
    if len(frequency) < 3:
        text += " The command holds hardly more than one frequency: record a chirp to see the response."
    traces = [
        {"x": frequency, "y": _numbers(content[of][key])}
        for key in ("magnitude_db", "phase_deg", "coherence")
        for of in ("measured", "model")
    ]
    return {"text": text, "traces": traces, "layout": {"xaxis": {"dtick": log_step(frequency)}}}


def _response_traces() -> list[dict[str, Any]]:
    traces = []
    for i, unit in enumerate((" dB", "°", "")):
        on = {
            "mode": "lines+markers",
            "marker": {"size": 5},
            "yaxis": f"y{i + 1 if i else ''}",
            "showlegend": i == 0,
            "hovertemplate": f"%{{y:.3g}}{unit}",
        }
        traces.append(_line("measured", _MEASURED, width=3.2, legendgroup="measured", **on))
        traces.append(_line("model", _MODEL, width=1.6, legendgroup="model", **on))
    return traces


# ------------------------------------------------------------------ loops


def _loops(joint: dict[str, Any], r: int, facts: dict[str, Any]) -> dict[str, Any]:
    content = joint["recordings"][r]["hysteresis"]
    if not content:
        return {"text": "The joint hardly moves.", "traces": [{"x": [], "y": []}] * 4, "layout": {}}
    position = _numbers(content["position"])
    offsets = [v for of in ("measured", "model") for way in ("up", "down") for v in content[of][way]]
    factor, unit = position_unit(offsets, types_of(joint))
    factor_e, unit_e = position_unit([*content["error"]["up"], *content["error"]["down"]], types_of(joint))
    traces = []
    for of in ("measured", "model"):
        loop = [*content[of]["up"], None, *reversed(content[of]["down"])]  # strokes end where the joint turns, not both
        traces.append({"x": [*position, None, *reversed(position)], "y": _numbers(loop, factor)})
    for way in ("up", "down"):
        traces.append({"x": position, "y": _numbers(content["error"][way], factor_e)})
    across = units_for("rad", types_of(joint))
    widths = [position_text(content[of]["half_width"], types_of(joint)) for of in ("measured", "model")]
    return {
        "text": f"Friction opens the loop: half its width is {widths[0]} measured and {widths[1]} in the model. What "
        "leans is gravity, a spring or a gain. Means over the recording, standstill left out.",
        "traces": traces,
        "layout": {
            "xaxis": _title(f"position [{across}]"),
            "xaxis2": _title(f"position [{across}]"),
            "yaxis": _title(f"target − position [{unit}]"),
            "yaxis2": _title(f"error [{unit_e}]"),
        },
    }


# ------------------------------------------------------------------ white or not


def _white(joint: dict[str, Any], r: int, facts: dict[str, Any]) -> dict[str, Any]:
    content = joint["recordings"][r]["whiteness"]
    lag, rho = content["lag"], content["autocorrelation"]
    share, time = content["predictable"], content["correlation_time"]
    if abs(content["lag_1"]) < 0.1:
        text = f"As good as white: the sample before explains {percent(share)} of the variance."
    else:
        text = (
            f"Not white: the sample before explains {percent(share)} of the variance, and errors stay alike for "
            f"{short_duration(time)}. Something that can be modelled is left."
        )
    return {
        "text": text,
        "traces": [{"x": _numbers(lag[1:], 1e3), "y": _numbers(rho[1:])}],
        "layout": {},
    }


_LOG_HZ = {"type": "log", "title": {"text": "frequency [Hz]"}, "dtick": 1}

FIGURES: dict[str, FailureFigure] = {
    "time": FailureFigure(
        title="When is it wrong?",
        height=250,
        traces=[
            _line("lowest", _MODEL, width=1, hovertemplate="%{y:.3g}"),
            _line("highest", _MODEL, width=1, hovertemplate="%{y:.3g}", fill="tonexty"),
        ],
        layout={"xaxis": _title("time [s]"), "hovermode": "x unified", "showlegend": False, "margin": {"t": 10}},
        cell=_over_time,
    ),
    "where": FailureFigure(
        title="In which motion does the error sit?",
        height=440,
        traces=_panel_traces(),
        layout=_panel_axes(),
        cell=_where,
    ),
    "loops": FailureFigure(
        title="Does it depend on the direction?",
        height=330,
        traces=[
            _line("measured", _MEASURED, width=3.2, hovertemplate="%{y:.3g}"),
            _line("model", _MODEL, width=1.6, hovertemplate="%{y:.3g}"),
            _line("error on the way up", "var(--third)", xaxis="x2", yaxis="y2", hovertemplate="%{y:.3g}"),
            _line("error on the way down", "var(--fourth)", xaxis="x2", yaxis="y2", hovertemplate="%{y:.3g}"),
        ],
        layout={
            "xaxis": {"domain": [0, 0.46]},
            "xaxis2": {"domain": [0.56, 1], "anchor": "y2"},
            "yaxis2": {"anchor": "x2", "zerolinecolor": "var(--muted)"},
        },
        cell=_loops,
    ),
    "spectrum": FailureFigure(
        title="At which frequencies?",
        height=290,
        traces=[
            _line("error", _MODEL, mode="lines+markers", connectgaps=True, hovertemplate="%{y:.3g}"),
            _line("noise floor", _NOISE, dash="dot", connectgaps=True, hovertemplate="%{y:.3g}"),
        ],
        layout={
            "xaxis": _LOG_HZ,
            "yaxis": {"type": "log", "exponentformat": "none", "dtick": 1},
            "hovermode": "x unified",
        },
        cell=_spectrum,
    ),
    "response": FailureFigure(
        title="Does the model respond to the command as the robot does?",
        height=520,
        traces=_response_traces(),
        layout={
            "xaxis": _LOG_HZ | {"anchor": "y3"},
            "yaxis": {"domain": [0.58, 1]} | _title("magnitude [dB]"),
            "yaxis2": {"domain": [0.2, 0.53]} | _title("phase [°]"),
            "yaxis3": {"domain": [0, 0.14], "range": [0, 1.05], "tickvals": [0, 1]} | _title("coherence"),
            "hovermode": "x unified",
            "hoversubplots": "axis",
        },
        cell=_response,
    ),
    "white": FailureFigure(
        title="Is what is left noise?",
        height=250,
        traces=[
            _line("autocorrelation", _MODEL, mode="lines+markers", hovertemplate="%{x:.3g} ms: %{y:.2f}<extra></extra>")
        ],
        layout={
            "xaxis": {"type": "log", "dtick": 1} | _title("lag [ms]"),
            "yaxis": {"range": [-1.05, 1.05], "zerolinecolor": "var(--muted)"} | _title("autocorrelation"),
            "margin": {"t": 10},
        },
        cell=_white,
    ),
}
"""By name, in their order on the page."""
