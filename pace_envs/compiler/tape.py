"""The form between torch and C: numbers, each the result of an operation on others; and the tracer that takes these."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from pace_envs.compiler.host import CannotCompileError
from pace_envs.compiler.operations import literal

_NO_TENSORS = frozenset((bool, int, float, str, type(None), torch.dtype, torch.device, torch.layout))
"""Types of other arguments: to ask whether one is a tensor takes longer than to note an operation."""


class Tracer(TorchDispatchMode):
    """While it is entered, operations on tensors that it knows are noted and not done; others are torch's.

    Views are torch's own: a tensor that shows the same memory is known by it.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing here is compiled by torch: its compiler, which takes seconds to import, need not be kept off."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: Any = None) -> Any:
        """An operation of torch."""
        kwargs = dict(kwargs or {})
        name, is_view, changes = _facts(func)
        if is_view:
            return func(*args, **kwargs)  # the same memory
        tensors = tensors_in((*args, *kwargs.values()))
        if changes:
            self.will_change([args[i] if i < len(args) else kwargs.get(key) for i, key in changes])
        if not tensors or "empty" in name:
            return self.made(func, name, args, kwargs)
        if self.knows(tensors):
            out = kwargs.pop("out", None)
            target = args[0] if out is None and changes else out
            result = self.noted(func, name.rstrip("_"), args, kwargs, target, tensors)
            if result is not None:
                return result
            if out is not None:
                kwargs["out"] = out
        return self.left_to_torch(func, args, kwargs)

    def will_change(self, changed: Sequence[torch.Tensor]) -> None:
        """Tensors are about to be changed in place."""

    def made(self, func: Any, name: str, args: tuple, kwargs: dict[str, Any]) -> Any:
        """A tensor that depends on no other."""
        return func(*args, **kwargs)

    def knows(self, tensors: Sequence[torch.Tensor]) -> bool:
        """Whether operations on these are noted."""
        raise NotImplementedError

    def noted(self, func: Any, name: str, args: tuple, kwargs: dict, target: Any, tensors: list[torch.Tensor]) -> Any:
        """The result of an operation that is noted; ``None`` where that cannot be.

        Args:
            name: Its name, without the underscore of those in place.
            kwargs: Options, without ``out``.
            target: What it writes; ``None`` for a new tensor.
            tensors: Those among the arguments and options.
        """
        raise NotImplementedError

    def left_to_torch(self, func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        """What torch does itself."""
        return func(*args, **kwargs)


@cache
def _facts(func: Any) -> tuple[str, bool, list[tuple[int, str]]]:
    """An operation's name, whether its result shows an argument's memory unchanged, and the arguments it changes."""
    schema = func._schema
    name = schema.name.partition("::")[2]
    is_view = any(each.alias_info is not None and not each.alias_info.is_write for each in schema.returns)
    infos = [(i, each.name, each.alias_info) for i, each in enumerate(schema.arguments)]
    changes = [(i, key) for i, key, info in infos if info is not None and info.is_write]
    return name, is_view or name == "_unsafe_view", changes


def tensors_in(values: Iterable[Any]) -> list[torch.Tensor]:
    """The tensors among values and lists of them."""
    found = []
    for value in values:
        kind = type(value)
        if kind in (list, tuple):
            found += tensors_in(value)
        elif kind is torch.Tensor or (kind not in _NO_TENSORS and isinstance(value, torch.Tensor)):
            found.append(value)
    return found


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
