"""Whether the recordings agree: what each of them says alone."""

from __future__ import annotations

from markupsafe import Markup

from pace_actuators.drive_result import ALL
from pace_actuators.text import in_words, pretty_unit

from ..markup import Section, bullets, figure, html, joined
from ..run_data import RunData

_CONFIDENCE = 1.96
_COLORS = ("var(--measured)", "var(--simulated)", "var(--third)", "var(--fourth)", "var(--target)")


def consistency(run: RunData) -> Section | None:
    """Each parameter as each recording has it, when several were fitted."""
    content = run.read_json("consistency.json")
    if not content or len(content.get("recordings", [])) < 2:
        return None
    sentences = content.get("sentences", [])
    names = list(dict.fromkeys(label.split("/")[0] for label in content["values"]))
    said = (
        bullets([pretty_unit(text) for text in sentences])
        if sentences
        else html("<p>All recordings agree within their error bars.</p>")
    )
    return Section(
        id="consistency",
        title="Recordings compared",
        lead="Every recording was fitted alone, starting at the common result. Bars span 95 %.",
        html=said + joined(_plot(run, content, i, name) for i, name in enumerate(names)),
    )


def _plot(run: RunData, content: dict, number: int, name: str) -> Markup:
    labels = [label for label in content["values"] if label.split("/")[0] == name]
    keys = [label.split("/", 1)[1] for label in labels]
    data: list[dict] = []
    for r, recording in enumerate(content["recordings"]):
        std = [content["std"][label][r] for label in labels]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": recording,
                "x": [i + 0.5 * ((r + 0.5) / len(content["recordings"]) - 0.5) for i in range(len(keys))],
                "y": [content["values"][label][r] for label in labels],
                "error_y": {
                    "type": "data",
                    "array": [_CONFIDENCE * (s or 0.0) for s in std],
                    "thickness": 1.5,
                    "width": 0,
                },
                "marker": {
                    "size": 7,
                    "color": _COLORS[r % len(_COLORS)],
                    "symbol": ["circle-open" if s is None else "circle" for s in std],
                },
                "text": keys,
                "hovertemplate": "%{text} %{y:.4g}",
            }
        )
    ticks = {"tickvals": list(range(len(keys))), "ticktext": ["all joints" if key == ALL else key for key in keys]}
    layout = {"xaxis": {"range": [-0.5, len(keys) - 0.5], "zeroline": False} | ticks, "showlegend": True}
    unit = " or ".join(dict.fromkeys(pretty_unit(run.result.unit_of(name, key)) for key in keys))
    heading = html("<h3>{{ name }} <small>{{ unit }}</small></h3>", name=in_words(name), unit=unit)
    return heading + figure(f"consistency-{number}", data, layout, height=240)
