"""The form between torch and C: numbers, each the result of an operation on others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pace_envs.compiler.host import CannotCompileError
from pace_envs.compiler.operations import literal

Kind = str
"""A number's type in C."""


class NotTraceableError(CannotCompileError):
    """Something was done to a drive that a kernel cannot do."""


@dataclass(eq=False, slots=True)
class Node:
    """A number: the result of an operation."""

    operation: str
    """``"leaf"``, ``"table"``, ``"series"``, ``"constant"``, ``"push"``, ``"ring"``, ``"knot"``, or a C expression."""
    arguments: tuple[Node, ...]
    kind: Kind
    """Its type in C; ``""`` of a statement."""
    number: int
    """Where it is on the tape."""
    index: int = -1
    """Of a leaf, a table, a series, a ring or knots."""
    text: str = ""
    """A constant in C."""


class Tape:
    """Records operations in their order; the same operation on the same numbers is recorded once."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.nodes: list[Node] = []
        self.rings: list[int] = []  # how many of the last samples of each joint a delay keeps
        self.knots: list[tuple[float, ...]] = []
        self.series: list[str] = []
        self._known: dict[tuple, Node] = {}

    def add(self, operation: str, *arguments: Node, kind: Kind = "double", index: int = -1, text: str = "") -> Node:
        """The result of an operation without side effects."""
        if operation == "{0}":
            return self.cast(arguments[0], kind)
        key = (operation, tuple([each.number for each in arguments]), kind, index, text)
        node = self._known.get(key)
        if node is None:
            node = self._known[key] = self.new(operation, *arguments, kind=kind, index=index, text=text)
        return node

    def new(self, operation: str, *arguments: Node, kind: Kind = "double", index: int = -1, text: str = "") -> Node:
        """The result of an operation that depends on when it is done, or does something."""
        node = Node(operation, arguments, kind, len(self.nodes), index, text)
        self.nodes.append(node)
        return node

    def constant(self, value: float, kind: Kind = "double") -> Node:
        """A number that is the same everywhere."""
        return self.add("constant", kind=kind, text=literal(value, kind))

    def cast(self, node: Node, kind: Kind) -> Node:
        """A number of another type."""
        if node.kind == kind:
            return node
        return self.add("({0} != 0)" if kind == "bool" else f"(({kind})({{0}}))", node, kind=kind)

    def leaf(self, index: int, kind: Kind) -> Node:
        """A number that is there when the step begins."""
        return self.add("leaf", kind=kind, index=index)

    def of_series(self, name: str) -> Node:
        """The value of a series of each recording and joint at the present control step."""
        if name not in self.series:
            self.series.append(name)
        return self.add("series", index=self.series.index(name))

    def ring(self, length: int) -> int:
        """A new ring's index."""
        self.rings.append(length)
        return len(self.rings) - 1

    def knot(self, values: tuple[float, ...], index: Node) -> Node:
        """One of some numbers that are the same for all joints."""
        if values not in self.knots:
            self.knots.append(values)
        return self.add("knot", index, index=self.knots.index(values))


class Names:
    """What nodes are called in C."""

    def __init__(self, nodes: Sequence[Node]):
        """Number them."""
        self.nodes = nodes
        self._numbers = {node.number: i for i, node in enumerate(nodes)}

    def of(self, node: Node) -> str:
        """A variable, or a constant itself."""
        return node.text if node.operation == "constant" else f"v{self._numbers[node.number]}"

    def expression(self, node: Node) -> str:
        """What it is the result of."""
        return node.operation.format(*[self.of(each) for each in node.arguments])

    def line(self, node: Node, expression: str | None = None) -> str:
        """What makes it."""
        value = self.expression(node) if expression is None else expression
        return f"const {node.kind} {self.of(node)} = {value};" if node.kind else f"{value};"
