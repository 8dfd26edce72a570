"""Small pieces of HTML. Templates escape all that comes from a run, or it goes through :func:`json_script`."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from pace_actuators.text import in_short

ENVIRONMENT = Environment(
    autoescape=True,
    undefined=StrictUndefined,
    loader=PackageLoader("pace_optim.report", "."),
    keep_trailing_newline=True,
)


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page."""

    id: str
    """Its anchor."""
    title: str
    """Its heading, plain text."""
    html: Markup
    """Its content."""
    lead: str = ""
    """A sentence under the heading, plain text."""


def html(template: str, **values: Any) -> Markup:
    """HTML of a template of Jinja: what is put into it is escaped, unless it is HTML of this kind already."""
    return Markup(_template(template).render(values))


@cache
def _template(text: str) -> Template:
    return ENVIRONMENT.from_string(text)


def joined(parts: Iterable[Markup]) -> Markup:
    """Pieces of HTML one after another."""
    return Markup("").join(parts)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], css: str = "") -> Markup:
    """A table of cells that are text or HTML. A click on a head sorts it; on a narrow page each row is a list."""
    return html(
        '<div class="scroll"><table class="{{ css }}"><thead><tr>{% for cell in header %}<th>{{ cell }}</th>'
        "{% endfor %}</tr></thead><tbody>{% for row in rows %}<tr>{% for cell in row %}"
        '<td data-head="{{ header[loop.index0] }}">{{ cell }}</td>{% endfor %}</tr>{% endfor %}</tbody></table></div>',
        header=header,
        rows=rows,
        css=css,
    )


def bullets(entries: Sequence[str], css: str = "") -> Markup:
    """A list of texts."""
    return html(
        '<ul class="{{ css }}">{% for entry in entries %}<li>{{ entry }}</li>{% endfor %}</ul>',
        entries=entries,
        css=css,
    )


def folded(count: int, content: Markup) -> Markup:
    """So many entries more, which a click shows."""
    return html("<details><summary>{{ count }} more</summary>{{ content }}</details>", count=count, content=content)


def bold(text: str) -> Markup:
    """A text in bold."""
    return html("<b>{{ text }}</b>", text=text)


def figure(
    id: str,
    data: Sequence[dict[str, Any]],
    layout: dict[str, Any],
    *,
    height: int = 380,
    views: Sequence[dict[str, Any]] = (),
) -> Markup:
    """A plotly figure, which the page's script draws in the page's colours.

    Args:
        data: Traces. A colour may be one of the style sheet's, as ``"var(--simulated)"``.
        layout: What differs from the page's plain look.
        views: Ways to look at it, one button each: {"label": str, "trace": {...}, "layout": {...}} as
            ``Plotly.update`` takes them.
    """
    spec = {"data": list(data), "layout": layout, "views": list(views)}
    return html(
        '<figure class="plot" id="{{ id }}"><div class="views"></div>'
        '<div class="canvas" style="height:{{ height }}px"></div>{{ script }}</figure>',
        id=id,
        height=height,
        script=json_script(spec),
    )


def log_step(values: Iterable[float | None]) -> float | str:
    """Ticks of a logarithmic axis, as plotly's ``dtick``: one for each decade, or 1, 2, 5 where these would be few."""
    known = [value for value in values if value and value > 0 and math.isfinite(value)]
    return 1 if not known or max(known) > 30 * min(known) else "D2"


def choice(name: str, entries: Sequence[str], group: str = "", at: int = 0) -> Markup:
    """Radio buttons that look like pills: arrow keys go from one to the next. What all names share stands before them.

    Args:
        group: Sets them apart from another choice of the same on the page.
        at: Which one the page opens on.
    """
    shown, pattern = in_short(entries)
    return html(
        '<div class="pills" role="radiogroup" aria-label="{{ name }}" data-choice="{{ name }}"{{ hidden }}>'
        "<b>{{ name.capitalize() }}{% if pattern %}<br>{{ pattern }}{% endif %}</b><div>{% for entry in entries %}"
        '<label><input type="radio" name="{{ group + name }}" value="{{ loop.index0 }}"'
        '{{ " checked" if loop.index0 == at }}><span>{{ entry }}</span></label>{% endfor %}</div></div>',
        name=name,
        entries=shown,
        pattern=pattern,
        group=group,
        at=at,
        hidden=" hidden" if len(entries) == 1 and name == "recording" else "",
    )


def json_script(content: Any) -> Markup:
    """Data for the page's script; numbers that JSON does not have become ``null``."""
    return packed_script(json.dumps(_finite(content), separators=(",", ":"), allow_nan=False), "application/json")


def packed_script(text: str, kind: str) -> Markup:
    """A script that ``unpack.js`` unpacks, a third of its size; no text in it can close it."""
    packed = base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()
    return Markup(f'<script type="text/plain" data-packed="{kind}">{packed}</script>')


def curve(values: np.ndarray, step: float) -> dict[str, Any]:
    """A curve for the page's script: rounded to whole steps, each as the difference from the one before.

    Args:
        values: (K,); what is not finite becomes ``null``.
    """
    values = np.asarray(values, dtype=float)
    known = np.isfinite(values)
    by: list[int | None] = [None] * len(values)
    steps = np.rint(np.clip(values[known] / step, -_MOST_STEPS, _MOST_STEPS)).astype(np.int64)
    for place, difference in zip(np.flatnonzero(known).tolist(), np.diff(steps, prepend=0).tolist(), strict=True):
        by[place] = difference
    return {"step": step, "by": by}


_MOST_STEPS = 2.0**50
"""Whole numbers that JavaScript holds exactly; a simulation that diverged goes further."""


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
