"""What operations on symbols record: the program of one joint in one control step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pace_envs.kernels import CannotCompileError

Kind = Literal["double", "bool", "int"]


class NotTraceableError(CannotCompileError):
    """Something was done to a symbol that a kernel cannot do."""


@dataclass(frozen=True, eq=False)
class Node:
    """A number of one joint: the result of an operation."""

    operation: str
    """``"leaf"``, ``"table"``, ``"series"``, ``"constant"``, ``"push"``, ``"ring"``, ``"knot"``, or a C expression."""
    arguments: tuple[Node, ...]
    kind: Kind
    number: int
    """Where it is on the tape."""
    index: int = -1
    """Of a leaf, a table, a series, a ring or knots."""
    text: str = ""
    """A constant in C."""


@dataclass(frozen=True)
class Ring:
    """The memory of a delay: so many of the last samples of each joint."""

    length: int
    interpolation: str
    parts: int


class Tape:
    """Records operations in their order; the same operation on the same numbers is recorded once."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.nodes: list[Node] = []
        self.rings: list[Ring] = []
        self.knots: list[tuple[float, ...]] = []
        self.series: list[str] = []
        self._known: dict[tuple, Node] = {}

    def add(self, operation: str, *arguments: Node, kind: Kind = "double", index: int = -1, text: str = "") -> Node:
        """The result of an operation without side effects."""
        key = (operation, tuple(each.number for each in arguments), kind, index, text)
        node = self._known.get(key)
        if node is None:
            node = self._known[key] = self._new(operation, arguments, kind, index, text)
        return node

    def leaf(self, index: int, kind: Kind) -> Node:
        """A number that is there when the step begins."""
        return self.add("leaf", kind=kind, index=index)

    def constant(self, value: float | bool) -> Node:
        """A number that is the same for all joints."""
        if isinstance(value, bool):
            return self.add("constant", kind="bool", text=str(value).lower())
        return self.add("constant", text=_text(float(value)))

    def count(self, value: int) -> Node:
        """A whole number that is the same for all joints."""
        return self.add("constant", kind="int", text=str(int(value)))

    def of_series(self, name: str) -> Node:
        """The value of a series of each recording and joint at the present control step."""
        if name not in self.series:
            self.series.append(name)
        return self.add("series", index=self.series.index(name))

    def ring(self, ring: Ring) -> int:
        """A new ring's index."""
        self.rings.append(ring)
        return len(self.rings) - 1

    def push(self, ring: int, sample: Node) -> None:
        """Put a sample into a ring."""
        self._new("push", (sample,), "double", ring)

    def seen(self, ring: int, back: Node) -> Node:
        """The sample of so many pushes ago, (whole) numbers in a double."""
        return self._new("ring", (back,), "double", ring)

    def table_of(self, values: tuple[float, ...]) -> int:
        """Index of knots that are the same for all joints."""
        if values not in self.knots:
            self.knots.append(values)
        return self.knots.index(values)

    def _new(self, operation: str, arguments: tuple[Node, ...], kind: Kind, index: int, text: str = "") -> Node:
        node = Node(operation, arguments, kind, len(self.nodes), index, text)
        self.nodes.append(node)
        return node


def _text(value: float) -> str:
    """A number in C, to its last digit."""
    if math.isnan(value):
        return "(INF - INF)"
    if math.isinf(value):
        return "INF" if value > 0 else "(-INF)"
    text = repr(value)
    return f"({text})" if value < 0 else text
