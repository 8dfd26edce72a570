"""Python pages with values in them: what is foreign, such as a joint's name, becomes a literal and nothing else.

A page is a template, which is Python itself, with names such as ``_JOINTS_`` where values go. Text is written through
``repr``. Then the page is parsed and compared with its template: where the template has a value's name it may hold a
literal, and everything else must be the template's own.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator, Mapping, Sequence
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
    own = {word for value in values.values() for word in _words(value)}
    _compare(ast.parse(template), ast.parse(page), set(values), own)
    return page


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


def _words(value: Any) -> Iterator[str]:
    """The parts of a value that are expressions or names of calls, not literals."""
    if isinstance(value, Word):
        yield value.text
    elif isinstance(value, Call):
        yield value.name
        yield from (word for item in value.values.values() for word in _words(item))
    elif isinstance(value, Mapping):
        yield from (word for item in value.values() for word in _words(item))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        yield from (word for item in value for word in _words(item))


def _compare(template: Any, page: Any, holes: set[str], own: set[str]) -> None:
    if isinstance(template, ast.Name) and template.id in holes:
        if not _is_literal(page, own):
            raise RuntimeError(f"{ast.unparse(page)[:80]!r} stands where a value of a page belongs.")
    elif type(template) is not type(page):
        raise RuntimeError("A page holds more than its template and its values.")
    elif isinstance(template, ast.AST):
        for name in template._fields:
            _compare(getattr(template, name, None), getattr(page, name, None), holes, own)
    elif isinstance(template, list):
        if len(template) != len(page):
            raise RuntimeError("A page holds more than its template and its values.")
        for one, other in zip(template, page, strict=True):
            _compare(one, other, holes, own)
    elif template != page:
        raise RuntimeError("A page is not its template with values.")


def _is_literal(node: ast.AST, own: set[str]) -> bool:
    match node:
        case ast.Constant():
            return True
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant()):
            return True
        case ast.List(elts=items) | ast.Tuple(elts=items):
            return all(_is_literal(item, own) for item in items)
        case ast.Dict(keys=keys, values=items):
            return all(key is not None and _is_literal(key, own) for key in keys) and all(
                _is_literal(i, own) for i in items
            )
        case ast.Call(func=ast.Name(id="float"), args=[ast.Constant()], keywords=[]):
            return True
        case ast.Call(func=name, args=[], keywords=words):
            return ast.unparse(name) in own and all(w.arg is not None and _is_literal(w.value, own) for w in words)
        case ast.Name() | ast.Attribute():
            return ast.unparse(node) in own
    return False
