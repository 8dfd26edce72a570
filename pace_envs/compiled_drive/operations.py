"""Torch's operations on numbers of one joint, as C expressions; names and arguments are torch's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from pace_envs.compiled_drive.tape import Kind, Node, NotTraceableError, Tape
from pace_envs.kernels.expressions import BINARY, COMPARED, LERP, UNARY, WHERE, power

_SAME = {
    "negative": "neg",
    "absolute": "abs",
    "arctan": "atan",
    "multiply": "mul",
    "true_divide": "div",
    "truediv": "div",
    "mod": "remainder",
    "less": "lt",
    "greater": "gt",
    "and": "logical_and",
    "or": "logical_or",
    "xor": "logical_xor",
    "bitwise_and": "logical_and",
    "bitwise_or": "logical_or",
    "bitwise_xor": "logical_xor",
    "bitwise_not": "logical_not",
    "invert": "logical_not",
    "subtract": "sub",
    "clip": "clamp",
}
"""Other names of operations, and Python's; what is not a floating-point number is true or false."""


class Operations:
    """Applies operations, by their torch names, to nodes of a tape."""

    def __init__(self, tape: Tape):
        """Keep the tape, and what has a rule of its own."""
        self._tape = tape
        self._own: dict[str, Callable[..., Node]] = {
            "add": self.add,
            "sub": self.sub,
            "rsub": lambda a, b, alpha=1: self.sub(b, a, alpha),
            "clamp": self.clamp,
            "clamp_min": lambda a, min: self.clamp(a, min=min),
            "clamp_max": lambda a, max: self.clamp(a, max=max),
            "where": self.where,
            "lerp": self.lerp,
            "addcmul": lambda a, b, c, value=1: self.add(a, self.of("mul", b, c), value),
            "addcdiv": lambda a, b, c, value=1: self.add(a, self.of("div", b, c), value),
            "pow": self.pow,
            "rpow": lambda a, b: self.pow(b, a),
            "nan_to_num": self.nan_to_num,
            "rdiv": lambda a, b: self.of("div", b, a),
            "rtruediv": lambda a, b: self.of("div", b, a),
            "positive": self.double,
            "zeros_like": lambda a, **_: self._tape.constant(0.0),
            "ones_like": lambda a, **_: self._tape.constant(1.0),
            "full_like": lambda a, value, **_: self.node(value),
            "double": self.double,
        }

    def of(self, name: str, *arguments: Any, **options: Any) -> Node:
        """The result of an operation.

        Raises:
            NotTraceableError: If it is not known.
        """
        name = _SAME.get(name, name)
        if name in self._own:
            return self._own[name](*arguments, **options)
        nodes = [self.node(each) for each in arguments]
        if options:
            raise NotTraceableError(f"{name} with {', '.join(options)}")
        if name in UNARY or name in BINARY:
            return self._tape.add({**UNARY, **BINARY}[name], *map(self.double, nodes))
        if name.startswith("logical_"):
            return self._bool(COMPARED[name], *nodes)
        if name in COMPARED:
            return self._tape.add(COMPARED[name], *map(self.double, nodes), kind="bool")
        raise NotTraceableError(f"torch's {name}")

    def node(self, value: Any) -> Node:
        """A number, or a node itself.

        Raises:
            NotTraceableError: If it is a tensor that was not there when the step began.
        """
        if isinstance(value, Node):
            return value
        if isinstance(value, (bool, int, float)):
            return self._tape.constant(value)
        if isinstance(value, torch.Tensor) and value.numel() == 1:
            return self._tape.constant(value.item())
        raise NotTraceableError(f"a {type(value).__name__} among numbers")

    def double(self, value: Any) -> Node:
        """The same as a floating-point number."""
        node = self.node(value)
        return node if node.kind == "double" else self._tape.add("((double)({0}))", node)

    def add(self, a: Any, b: Any, alpha: float = 1) -> Node:
        """A + alpha b."""
        b = b if alpha == 1 else self.of("mul", alpha, b)
        return self._tape.add("({0} + {1})", self.double(a), self.double(b))

    def sub(self, a: Any, b: Any, alpha: float = 1) -> Node:
        """A - alpha b."""
        b = b if alpha == 1 else self.of("mul", alpha, b)
        return self._tape.add("({0} - {1})", self.double(a), self.double(b))

    def clamp(self, a: Any, min: Any = None, max: Any = None) -> Node:
        """Within bounds; what is not a number stays so."""
        node = self.node(a)
        if node.kind == "int":
            return self._whole_clamp(node, min, max)
        node = self.double(node)
        if min is not None:
            node = self._tape.add(BINARY["maximum"], node, self.double(min))
        if max is not None:
            node = self._tape.add(BINARY["minimum"], node, self.double(max))
        return node

    def where(self, condition: Any, a: Any, b: Any) -> Node:
        """One or the other."""
        one, other = self.node(a), self.node(b)
        kind: Kind = "bool" if one.kind == other.kind == "bool" else "double"
        if kind == "double":
            one, other = self.double(one), self.double(other)
        return self._tape.add(WHERE, self._as_bool(condition), one, other, kind=kind)

    def lerp(self, a: Any, b: Any, weight: Any) -> Node:
        """From a to b, as torch does it."""
        return self._tape.add(LERP, self.double(a), self.double(b), self.double(weight))

    def pow(self, a: Any, b: Any) -> Node:
        """Powers."""
        if isinstance(b, (int, float)):
            return self._tape.add(power("{0}", b), self.double(a))
        return self._tape.add(power("{0}", "{1}"), self.double(a), self.double(b))

    def nan_to_num(self, a: Any, nan: float = 0.0, posinf: float | None = None, neginf: float | None = None) -> Node:
        """Numbers for what are none."""
        most = torch.finfo(torch.float64).max
        bounds = (nan, most if posinf is None else posinf, -most if neginf is None else neginf)
        return self._tape.add("number_for({0}, {1}, {2}, {3})", self.double(a), *map(self.node, map(float, bounds)))

    def whole(self, value: Any) -> Node:
        """A whole number.

        Raises:
            NotTraceableError: If it is none.
        """
        if isinstance(value, int) and not isinstance(value, bool):
            return self._tape.count(value)
        if isinstance(value, Node) and value.kind == "int":
            return value
        raise NotTraceableError("an index that is not whole")

    def whole_sum(self, a: Any, b: Any, sign: str) -> Node:
        """A + b or a - b of whole numbers."""
        return self._tape.add(f"({{0}} {sign} {{1}})", self.whole(a), self.whole(b), kind="int")

    def _whole_clamp(self, node: Node, least: Any, most: Any) -> Node:
        if least is not None:
            node = self._tape.add("({0} > {1} ? {0} : {1})", node, self.whole(least), kind="int")
        if most is not None:
            node = self._tape.add("({0} < {1} ? {0} : {1})", node, self.whole(most), kind="int")
        return node

    def _as_bool(self, value: Any) -> Node:
        node = self.node(value)
        return node if node.kind == "bool" else self._tape.add("({0} != 0)", node, kind="bool")

    def _bool(self, text: str, *arguments: Any) -> Node:
        return self._tape.add(text, *map(self._as_bool, arguments), kind="bool")
