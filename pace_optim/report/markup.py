"""Small pieces of HTML. Whatever comes from a run goes through :func:`esc` or :func:`json_script`."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page."""

    id: str
    """Its anchor."""
    title: str
    """Its heading, plain text."""
    html: str
    """Its content."""
    lead: str = ""
    """A sentence under the heading, plain text."""


def esc(value: object) -> str:
    """Text that is safe in HTML and in its attributes."""
    return html.escape(str(value), quote=True)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], css: str = "") -> str:
    """A table of cells that are HTML already; it scrolls sideways where the page is narrow."""
    head = "".join(f"<th>{cell}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table class="{css}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def bullets(entries: Sequence[str], css: str = "") -> str:
    """A list of plain texts."""
    return f'<ul class="{css}">' + "".join(f"<li>{esc(entry)}</li>" for entry in entries) + "</ul>"


def figure(
    id: str,
    data: Sequence[dict[str, Any]],
    layout: dict[str, Any],
    *,
    height: int = 380,
    views: Sequence[dict[str, Any]] = (),
) -> str:
    """A plotly figure, which the page's script draws in the page's colours.

    Args:
        id: Its name in the page.
        data: Traces. A colour may be one of the style sheet's, as ``"var(--simulated)"``.
        layout: What differs from the page's plain look.
        height: In pixels.
        views: Ways to look at it, one button each: {"label": str, "trace": {...}, "layout": {...}} as
            ``Plotly.update`` takes them.
    """
    spec = {"data": list(data), "layout": layout, "views": list(views)}
    return (
        f'<figure class="plot" id="{esc(id)}"><div class="views"></div>'
        f'<div class="canvas" style="height:{height}px"></div>{json_script(spec)}</figure>'
    )


def choice(name: str, entries: Sequence[str], group: str = "", at: int = 0) -> str:
    """Radio buttons that look like pills: arrow keys go from one to the next.

    Args:
        name: What is chosen.
        entries: From what.
        group: Sets them apart from another choice of the same on the page.
        at: Which one the page opens on.
    """
    pills = "".join(
        f'<label><input type="radio" name="{esc(group + name)}" value="{i}"{" checked" if i == at else ""}>'
        f"<span>{esc(entry)}</span></label>"
        for i, entry in enumerate(entries)
    )
    hidden = " hidden" if len(entries) == 1 and name == "recording" else ""
    return (
        f'<div class="pills" role="radiogroup" aria-label="{esc(name)}" data-choice="{esc(name)}"{hidden}>'
        f"<b>{esc(name.capitalize())}</b><div>{pills}</div></div>"
    )


def json_script(content: Any) -> str:
    """Data for the page's script; numbers that JSON does not have become ``null``."""
    text = json.dumps(_finite(content), separators=(",", ":"), allow_nan=False)
    text = text.replace("<", "\\u003c")  # so that no text in it can close the script
    return f'<script type="application/json">{text}</script>'


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
