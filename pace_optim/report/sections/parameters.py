"""The identified values, their error bars and where they are between their bounds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from pace_actuators.drive_result import ALL
from pace_actuators.text import in_short, in_words, pretty_unit, value_and_error

from ..markup import Section, bold, html, joined, table
from ..run_data import RunData

_CONFIDENCE = 1.96
"""Standard deviations on either side that hold the value with 95 % probability."""
_BARS = (
    "Bars span 1.96 standard deviations to either side (95 %). They include noise, the residuals' correlation in time, "
    "the physics step and an assumed loop rate. They do not include physics that the model lacks."
)
_FAR = (
    "The fit ended far above the noise, so the values have no error bars: physics that the model lacks counts for more."
)
_WIDTH, _HEIGHT, _INSET = 360, 20, 6


def parameters(run: RunData) -> Section:
    """A table per parameter; those of the whole robot share one."""
    result = run.result
    shared = [name for name, values in result.parameters.items() if set(values) == {ALL}]
    cards = [
        _card(run, name, unit)
        for name, values in result.parameters.items()
        for unit in (() if name in shared else dict.fromkeys(result.unit_of(name, key) for key in values))
    ]
    if shared:
        step = 1e3 * result.control_dt  # of the delay, which is shown in ms
        units = {name: ("ms", step) if name == "delay" else (result.unit_of(name, ALL), 1.0) for name in shared}
        rows = [_row(run, name, ALL, in_words(name), pretty_unit(u), None, f) for name, (u, f) in units.items()]
        note = html(
            "{% if delay %}<p>The delay is that of the <b>{{ mode }}</b>: {{ delay }} control steps of {{ step }} ms."
            "</p>{% endif %}",
            mode=result.delay_mode,
            delay=f"{1e3 * result.delay_s / step:.4g}" if "delay" in shared else "",
            step=f"{step:g}",
        )
        head = ["", "value", "± std", "unit", "between its bounds", ""]
        cards.append(_article("The whole robot", "", table(head, rows, "values") + note))
    cards += [
        _article(in_words(effect), "knots", knots_table(by_joint)) for effect, by_joint in run.result.curves.items()
    ]
    return Section(
        id="parameters",
        title="Parameters",
        lead=_FAR if result.std_means_nothing else _BARS,
        html=html('<div class="cards">{{ cards }}</div>', cards=joined(cards)),
    )


def knots_table(curves: Mapping[str, Mapping[str, Any]]) -> Markup:
    """The knots of curves and their values, two rows for each joint, so that a law can be written from them."""
    most = max(len(own["at"]) for own in curves.values())
    rows = []
    for joint, own in curves.items():
        blank = [""] * (most - len(own["at"]))
        rows.append([bold(f"{joint}, {pretty_unit(own['variable'])}"), *(f"{x:.3g}" for x in own["at"]), *blank])
        rows.append([pretty_unit(own["value"]), *(f"{y:.4g}" for y in own["torque"]), *blank])
    return table(["knot", *(str(i + 1) for i in range(most))], rows, "knots")


def _article(title: str, unit: str, content: Markup) -> Markup:
    small = html(" <small>{{ unit }}</small>", unit=unit) if unit else ""
    return html(
        "<article><h3>{{ title }}{{ small }}</h3>{{ content }}</article>", title=title, small=small, content=content
    )


def _card(run: RunData, name: str, unit: str) -> Markup:
    """One parameter of all joints with the same unit: a table whose rows are also a plot."""
    values = {key: v for key, v in run.result.parameters[name].items() if run.result.unit_of(name, key) == unit}
    std = run.result.std.get(name, {})
    ends = [v + side * _CONFIDENCE * (std.get(key) or 0.0) for key, v in values.items() for side in (-1, 1)]
    own = [run.bounds[f"{name}/{key}"] for key in values if f"{name}/{key}" in run.bounds]
    low, high = _padded(min(ends), max(ends), own)
    files = run.result.file_values.get(name, {})
    short, pattern = in_short(list(values))
    titles = {
        key: f"{own} (file {files[key]:.4g})" if key in files else own for key, own in zip(values, short, strict=True)
    }
    rows = [_row(run, name, key, titles[key], "", (low, high)) for key in values]
    rows.append(["", "", "", _axis(low, high), "", ""])
    what = "link" if name in run.result.link_parameters else "joint"
    head = [f"{what} {pattern}".strip(), "value", "± std", "value and 95 % interval", "between its bounds", ""]
    return _article(in_words(name), pretty_unit(unit), table(head, rows, "values"))


def _padded(low: float, high: float, bounds: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The plot's range; intervals much wider than the bounds are cut, and a single value gets some room."""
    if bounds:
        lower, upper = min(b[0] for b in bounds), max(b[1] for b in bounds)
        low, high = max(low, lower - (upper - lower) / 4), min(high, upper + (upper - lower) / 4)
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    if high - low < 1e-3 * abs(high):  # all alike to many digits: do not blow up nothing
        room = 0.05 * abs(high)
    return low - room, high + room


def _row(
    run: RunData, name: str, key: str, title: str, unit: str, span: tuple[float, float] | None, factor: float = 1.0
) -> list[str]:
    """A value's cells; ``factor`` is what it is multiplied by where it is shown."""
    value, std = run.result.parameters[name][key], run.result.std.get(name, {}).get(key)
    label = f"{name}/{key}"
    text, error = value_and_error(factor * value, None if std is None else factor * std)
    if run.result.std_means_nothing and run.result.has_error_bar(name, key):
        error = "?"
    plot = unit if span is None else _interval(value, std, *span)
    return [bold(title), text, error, plot, _between(run, label, value, factor), _flags(run, label, value)]


def _x(value: float, low: float, high: float) -> float:
    share = min(max((value - low) / (high - low), 0.0), 1.0)
    return round(_INSET + share * (_WIDTH - 2 * _INSET), 1)


def _interval(value: float, std: float | None, low: float, high: float) -> Markup:
    """A dot with its whiskers, to the scale that the table's last row shows; hollow where there is no error bar."""
    middle, x = _HEIGHT / 2, _x(value, low, high)
    parts = [_line("base", 0, _WIDTH, middle, middle)]
    if low < 0 < high:
        parts.append(_line("zero", _x(0, low, high), _x(0, low, high), 0, _HEIGHT))
    if std is not None:
        a, b = (_x(value + side * _CONFIDENCE * std, low, high) for side in (-1, 1))
        parts.append(_line("whisker", a, b, middle, middle))
    css = "unknown" if std is None else "dot"
    circle = html('<circle class="{{ css }}" cx="{{ x }}" cy="{{ y }}" r="3.5"/>', css=css, x=x, y=middle)
    return _svg([*parts, circle])


def _axis(low: float, high: float) -> Markup:
    """The scale of a table's plots."""
    parts = []
    for tick in nice_ticks(low, high):
        x = _x(tick, low, high)
        anchor = "start" if x < 20 else "end" if x > _WIDTH - 20 else "middle"
        parts.append(_line("base", x, x, 0, 4))
        said = '<text x="{{ x }}" y="16" text-anchor="{{ anchor }}">{{ tick }}</text>'
        parts.append(html(said, x=x, anchor=anchor, tick=f"{tick:.4g}"))
    return _svg(parts)


def _line(css: str, x1: float, x2: float, y1: float, y2: float) -> Markup:
    text = '<line class="{{ css }}" x1="{{ x1 }}" x2="{{ x2 }}" y1="{{ y1 }}" y2="{{ y2 }}"/>'
    return html(text, css=css, x1=x1, x2=x2, y1=y1, y2=y2)


def _svg(parts: Iterable[Markup]) -> Markup:
    return html(
        '<svg viewBox="0 0 {{ w }} {{ h }}" width="{{ w }}" height="{{ h }}" aria-hidden="true">{{ content }}</svg>',
        w=_WIDTH,
        h=_HEIGHT,
        content=joined(parts),
    )


def nice_ticks(low: float, high: float, most: int = 4) -> list[float]:
    """Round numbers between two others, at most ``most`` and a few."""
    if not high > low:
        return [low]
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw)
    first = math.ceil(low / step)
    return [i * step for i in range(first, math.floor(high / step) + 1)]


def _between(run: RunData, label: str, value: float, factor: float) -> str:
    """A small bar from the lower to the upper bound."""
    if label not in run.bounds:
        return ""
    low, high = run.bounds[label]
    share = (value - low) / (high - low) if high > low else 0.5
    css = " hit" if label in run.result.at_bound else ""
    return html(
        '<span class="range{{ css }}"><small>{{ low }}</small><span class="track"><i style="left:{{ share }}%"></i>'
        "</span><small>{{ high }}</small></span>",
        css=css,
        low=f"{factor * low:.3g}",
        share=f"{100 * min(max(share, 0.0), 1.0):.1f}",
        high=f"{factor * high:.3g}",
    )


def _beside(other: str, label: str) -> str:
    """A parameter in words, with its joint where that is another than this one's."""
    (name, joint), (_, own) = other.split("/"), label.split("/")
    return in_words(name).lower() + (f" of {joint}" if joint not in (own, ALL) else "")


def _flags(run: RunData, label: str, value: float) -> Markup:
    result, flags = run.result, []
    if label in result.at_bound:
        low, high = run.bounds.get(label, (value, value))
        flags.append("at its lower bound" if value - low < high - value else "at its upper bound")
    if label in result.undetermined:
        flags.append("not determined: its prior")
    elif label in result.no_influence:
        flags.append("no influence")
    groups = () if result.std_means_nothing else [each for each in result.indistinguishable if label in each]
    for group in groups:
        if not any(set(group) < set(larger) for larger in groups):
            others = [_beside(other, label) for other in group if other != label]
            flags.append("cannot be separated from " + " and ".join(dict.fromkeys(others)))
    return html('{% for flag in flags %}<span class="flag">{{ flag }}</span>{% endfor %}', flags=flags)
