"""What stands for tensors of all rows and joints while a step is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch

from pace_actuators.delay_buffer import DelayBuffer, Jump
from pace_envs.compiled_drive.operations import Operations
from pace_envs.compiled_drive.tape import Node, NotTraceableError, Ring, Tape

_SAME_NUMBERS = frozenset({"view", "reshape", "expand", "expand_as", "view_as", "unsqueeze", "squeeze", "detach"})
"""They show the same memory."""
_COPIES = frozenset({"clone", "contiguous", "to", "type_as", "index_select", "float"})
"""They give memory of its own."""


class Cell:
    """Memory of one number of each joint; views share it."""

    def __init__(self, node: Node):
        """Hold a number."""
        self.node = node


class Symbol:
    """Stands for a tensor (rows, joints): operations on it are recorded."""

    is_cuda = False

    def __init__(self, operations: Operations, cell: Cell, shape: Sequence[int]):
        """A view of a cell."""
        self._operations = operations
        self.cell = cell
        self.shape = torch.Size(shape)

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return len(self.shape)

    @property
    def dtype(self) -> torch.dtype:
        """Of a float64 or a bool."""
        return torch.bool if self.cell.node.kind == "bool" else torch.float64

    @property
    def device(self) -> torch.device:
        """Where the tensors are that it stands for."""
        return torch.device("cpu")

    @classmethod
    def __torch_function__(
        cls, function: Any, types: Any, arguments: tuple = (), options: dict[str, Any] | None = None
    ) -> Any:
        """An operation of torch that a symbol was given to."""
        first = next(each for each in _flat([*arguments, *(options or {}).values()]) if isinstance(each, Symbol))
        return first._apply(function.__name__, arguments, options or {})

    def __getattr__(self, name: str) -> Any:
        """A tensor's method."""
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *arguments, **options: self._apply(name, (self, *arguments), options)

    def __len__(self) -> int:
        """Number of rows."""
        return self.shape[0]

    def __getitem__(self, index: Any) -> Symbol:
        """All rows and joints."""
        return self

    def __setitem__(self, index: Any, value: Any) -> None:
        """Write all rows and joints."""
        self._write(self._operations.node(_plain(value)))

    def __bool__(self) -> bool:
        """A traced value has no truth value.

        Raises:
            NotTraceableError: Always.
        """
        raise NotTraceableError("a branch in Python over a tensor's values")

    def _apply(self, name: str, arguments: tuple, options: dict[str, Any]) -> Any:
        name = name.strip("_") if name.startswith("__") else name
        out = options.pop("out", None)
        in_place = name.endswith("_")
        name = name.rstrip("_")
        if name in _SAME_NUMBERS:
            return arguments[0]
        if name == "bucketize" or any(isinstance(each, Whole) for each in arguments):
            return self._indexed(name, arguments)
        if name in _COPIES:
            node = arguments[0].cell.node
        elif name in ("copy", "fill", "zero"):
            node = self._operations.node(_plain(arguments[1]) if len(arguments) > 1 else 0.0)
        else:
            node = self._operations.of(name, *map(_plain, arguments), **{k: _plain(v) for k, v in options.items()})
        if in_place or out is not None:
            target = arguments[0] if out is None else out
            if not isinstance(target, Symbol):
                raise NotTraceableError(f"torch's {name} into a tensor that is no state")
            target._write(node)
            return target
        return Symbol(self._operations, Cell(node), self.shape)

    def _write(self, node: Node) -> None:
        """Keep the memory's type."""
        self.cell.node = self._operations.double(node) if self.cell.node.kind == "double" else node

    def _indexed(self, name: str, arguments: tuple) -> Whole:
        if name != "bucketize" or not isinstance(arguments[1], Knots):
            raise NotTraceableError(f"torch's {name} with indices")
        knots = arguments[1].values
        parts = [self._operations.of("gt", arguments[0].cell.node, knot) for knot in knots]
        tape = self._operations._tape
        count = tape.add("(" + " + ".join(f"{{{i}}}" for i in range(len(parts))) + ")", *parts, kind="int")
        return Whole(self._operations, count)


def _operator(name: str) -> Any:
    def method(self: Symbol, *arguments: Any) -> Any:
        return self._apply(name, (self, *arguments), {})

    return method


for _name in ("add", "sub", "mul", "truediv", "pow", "mod", "and", "or", "xor"):
    setattr(Symbol, f"__{_name}__", _operator(_name))
    setattr(Symbol, f"__i{_name}__", _operator(f"{_name}_"))
    reverse = {"add": "add", "mul": "mul", "and": "and", "or": "or", "xor": "xor"}.get(_name, f"r{_name}")
    setattr(Symbol, f"__r{_name}__", _operator(reverse))
for _name in ("lt", "le", "gt", "ge", "eq", "ne", "neg", "abs", "invert"):
    setattr(Symbol, f"__{_name}__", _operator(_name))
Symbol.__hash__ = object.__hash__  # type: ignore[method-assign]


class Whole:
    """A whole number of each joint: an index."""

    def __init__(self, operations: Operations, node: Node):
        """Hold it."""
        self._operations, self.node = operations, node

    def clamp_(self, least: int | None = None, most: int | None = None) -> Whole:
        """Within bounds."""
        self.node = self._operations.clamp(self.node, least, most)
        return self

    def clamp(self, min: int | None = None, max: int | None = None) -> Whole:
        """Within bounds."""
        return Whole(self._operations, self._operations.clamp(self.node, min, max))

    def __add__(self, other: int) -> Whole:
        """Plus a whole number."""
        return Whole(self._operations, self._operations.whole_sum(self.node, other, "+"))

    def __sub__(self, other: int) -> Whole:
        """Less a whole number."""
        return Whole(self._operations, self._operations.whole_sum(self.node, other, "-"))

    def __getitem__(self, index: Any) -> Whole:
        """With another shape."""
        return self


class Knots:
    """Numbers that are the same for all rows and joints: a tensor of one dimension."""

    def __init__(self, operations: Operations, values: tuple[float, ...]):
        """Hold them."""
        self._operations, self.values = operations, values

    @classmethod
    def __torch_function__(
        cls, function: Any, types: Any, arguments: tuple = (), options: dict[str, Any] | None = None
    ) -> Any:
        """Handled by the symbol beside it."""
        return Symbol.__torch_function__(function, types, arguments, options)

    def __getitem__(self, index: Any) -> Any:
        """One of them, for each joint."""
        if not isinstance(index, Whole):
            return self.values[index]
        tape = self._operations._tape
        node = tape.add("knot", index.node, index=tape.table_of(self.values))
        return Symbol(self._operations, Cell(node), ())


class Table:
    """Several numbers of each row and joint: a tensor (rows, joints, entries)."""

    def __init__(self, operations: Operations, index: int):
        """Where it begins among the leaves."""
        self._operations, self._index = operations, index

    def gather(self, dimension: int, index: Whole) -> Symbol:
        """The entry of an index."""
        if dimension != -1 or not isinstance(index, Whole):
            raise NotTraceableError("a gather along another dimension than the last")
        node = self._operations._tape.add("table", index.node, index=self._index)
        return Symbol(self._operations, Cell(node), ())


class SymbolicDelay:
    """A :class:`~pace_actuators.delay_buffer.DelayBuffer` whose samples are symbols; the lags are numbers as before."""

    def __init__(self, operations: Operations, lag: Node, like: Ring):
        """Stand for a buffer that has seen a sample."""
        self._operations, self._like = operations, like
        self.ring: int | None = None
        """Index of its memory, once it is used."""
        tape, of = operations._tape, operations.of
        self._tape = tape
        hold = like.interpolation == "hold"
        whole = of("ceil" if hold else "floor", lag)
        self._mean = whole, of("add", whole, 1.0), None if hold else of("sub", lag, whole)
        self._parts: list[tuple[Node, Node, Node]] = []
        for part in range(like.parts if like.parts > 1 and not hold else 0):
            left = of("sub", lag, part / like.parts)
            back = operations.clamp(of("ceil", left), min=0.0)
            share = of("sub", of("add", 1.0, left), back)
            weight = operations.clamp(of("mul", float(like.parts), share), max=1.0)
            self._parts.append((operations.clamp(of("sub", back, 1.0), min=0.0), back, weight))

    def compute(self, data: Symbol) -> Symbol:
        """As the buffer's."""
        if self.ring is None:
            self.ring = self._tape.ring(self._like)
        self._tape.push(self.ring, self._operations.double(data.cell.node))
        return self.part(0) if self._parts else self.mean()

    def changes(self, part: int) -> bool:
        """For some joints it may."""
        return bool(self._parts)

    def part(self, part: int) -> Symbol:
        """As the buffer's."""
        return self._between(*self._parts[part]) if self._parts else self.mean()

    def jump(self, part: int) -> Jump | None:
        """As the buffer's."""
        newer, older, share = self._parts[part] if self._parts else self._mean
        if share is None:
            return None
        if self.ring is None:
            raise NotTraceableError("a delay that is read before it has a sample")
        rise = self._operations.of("sub", self._tape.seen(self.ring, newer), self._tape.seen(self.ring, older))
        return Jump(*(cast(torch.Tensor, Symbol(self._operations, Cell(node), ())) for node in (rise, share)))

    def mean(self) -> Symbol:
        """As the buffer's."""
        return self._between(*self._mean)

    def _between(self, newer: Node, older: Node, weight: Node | None) -> Symbol:
        if self.ring is None:
            raise NotTraceableError("a delay that is read before it has a sample")
        node = self._tape.seen(self.ring, newer)
        if weight is not None:
            node = self._operations.lerp(node, self._tape.seen(self.ring, older), weight)
        return Symbol(self._operations, Cell(node), ())


def ring_like(buffer: DelayBuffer) -> Ring:
    """The memory that a buffer needs."""
    return Ring(length=buffer._length, interpolation=buffer.interpolation, parts=buffer.parts)


def new_operations() -> tuple[Tape, Operations]:
    """An empty tape, and what writes on it."""
    tape = Tape()
    return tape, Operations(tape)


def _plain(value: Any) -> Any:
    return value.cell.node if isinstance(value, Symbol) else value


def _flat(values: Sequence[Any]) -> list[Any]:
    return [item for each in values for item in (_flat(each) if isinstance(each, (list, tuple)) else [each])]
