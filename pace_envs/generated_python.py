"""Python pages with values in them: what is foreign, such as a joint's name, becomes a literal and nothing else.

A page is a template, which is Python itself, with names such as ``_JOINTS_`` where values go. Text is written through
``repr``. Then the page is parsed and compared with its parsed template, whose names are replaced by the values one by
one: everything else must be the template's own.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_WIDTH = 120
_HOLE = re.compile(r"\b_[A-Z][A-Z_]*_\b")


@dataclass(frozen=True, kw_only=True)
class Call:
    """A call as a value, such as the constructor of a configuration."""

    name: str
    """What is called; this project's own word, never a file's."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Its keyword arguments."""


@dataclass(frozen=True)
class Word:
    """An expression of this project's own as a value, such as ``math.inf``: names joined by dots."""

    text: str


def python_page(template: str, values: Mapping[str, Any]) -> str:
    """Put values into a template.

    Args:
        template: Python, with names in capitals between underscores where values go. A text whose name stands alone
            on a line becomes a docstring there.
        values: Of all these names: numbers, texts, lists, tuples and mappings of them, :class:`Call`, :class:`Word`.

    Returns:
        The page; lists, mappings and calls that are too long for a line have a line for each item.

    Raises:
        RuntimeError: If a value has become anything but a literal. Nothing may be written then.
    """

    def filled(found: re.Match) -> str:
        line = template[template.rfind("\n", 0, found.start()) + 1 : found.start()]
        value = values[found[0]]
        if isinstance(value, str) and not line and template[found.end() : found.end() + 1] == "\n":
            return _docstring(value)
        return "\n".join(_lines(value, len(line) - len(line.lstrip(" ")), len(line)))

    page = _HOLE.sub(filled, template)
    if ast.dump(ast.parse(page)) != ast.dump(_Filled(values).visit(ast.parse(template))):
        raise RuntimeError("A page holds more than its template and its values.")
    return page


class _Filled(ast.NodeTransformer):
    """Puts values into a parsed template, each by itself."""

    def __init__(self, values: Mapping[str, Any]):
        self._values = values

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return ast.parse(_flat(self._values[node.id]), mode="eval").body if node.id in self._values else node


def _docstring(text: str) -> str:
    lines = ("'".join(repr(part)[1:-1] for part in line.split("'")) for line in text.split("\n"))
    return '"""' + "\n".join(lines).replace('"', '\\"') + '"""'


def _lines(value: Any, indent: int, used: int) -> list[str]:
    """A value's source; the line where it begins is indented by ``indent``, and ``used`` wide before it."""
    flat = _flat(value)
    items, head, tail = _items(value)
    if not items or used + len(flat) < _WIDTH:
        return [flat]
    result = [head]
    for start, item in items:
        lines = _lines(item, indent + 4, indent + 4 + len(start))
        lines[0] = " " * (indent + 4) + start + lines[0]
        lines[-1] += ","
        result += lines
    return [*result, " " * indent + tail]


def _items(value: Any) -> tuple[list[tuple[str, Any]], str, str]:
    """The items of a value, each with what stands before it; what opens and what closes it."""
    if isinstance(value, Call):
        return [(f"{_dotted(name)}=", item) for name, item in value.values.items()], f"{_dotted(value.name)}(", ")"
    if isinstance(value, Mapping):
        return [(f"{_flat(key)}: ", item) for key, item in value.items()], "{", "}"
    if isinstance(value, list):
        return [("", item) for item in value], "[", "]"
    return [("", item) for item in value] if isinstance(value, tuple) else [], "(", ")"


def _flat(value: Any) -> str:
    if isinstance(value, Word):
        return _dotted(value.text)
    if isinstance(value, Call | Mapping | list | tuple):
        items, head, tail = _items(value)
        comma = "," if isinstance(value, tuple) and len(items) == 1 else ""
        return head + ", ".join(start + _flat(item) for start, item in items) + comma + tail
    if isinstance(value, float) and not math.isfinite(value):
        return f'float("{float(value)}")'
    if value is None or type(value) in (str, bool, int, float):
        return repr(value)
    raise TypeError(f"{type(value).__name__} is no value of a page.")


def _dotted(text: str) -> str:
    if not all(part.isidentifier() for part in text.split(".")):
        raise RuntimeError(f"{text!r} is no name.")
    return text
