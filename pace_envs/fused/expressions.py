"""Operations on single elements, as C."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from pace_envs.fused.writer import TYPES


def literal(value: float | bool | int, kind: str) -> str:
    """A number of Python as one of C."""
    if isinstance(value, float) and not math.isfinite(value):
        number = "(INF - INF)" if math.isnan(value) else "INF" if value > 0 else "-INF"
    else:
        number = repr(int(value)) if isinstance(value, bool | int) else repr(float(value))
    return f"(({kind}){number})" if value >= 0 or value != value else f"(({kind})({number}))"


def cast(value: str, source: torch.dtype, target: torch.dtype) -> str:
    """A value of another type."""
    if source == target:
        return value
    return f"({value} != 0)" if target == torch.bool else f"(({TYPES[target]}){value})"


def _pow(x: str, exponent: Any) -> str:
    if exponent == 2:
        return f"{x} * {x}"
    if exponent == 3:
        return f"{x} * {x} * {x}"
    return f"sqrt({x})" if exponent == 0.5 else f"pow({x}, {exponent})"


def _clamp(x: str, least: str | None, most: str | None, kind: str) -> str:
    low = x if least is None else f"({x} < {least} ? {least} : {x})"
    return low if most is None else f"({low} > {most} ? {most} : {low})"


def _infix(sign: str) -> Callable[..., str]:
    return lambda a, b: f"({a} {sign} {b})"


SAME: dict[str, Callable[..., str]] = {
    "clone": lambda a: a,
    "copy": lambda a: a,
    "neg": lambda a: f"(-{a})",
    "exp": lambda a: f"exp({a})",
    "sin": lambda a: f"sin({a})",
    "cos": lambda a: f"cos({a})",
    "tanh": lambda a: f"tanh({a})",
    "sqrt": lambda a: f"sqrt({a})",
    "reciprocal": lambda a: f"(1 / {a})",
    "floor": lambda a: f"floor({a})",
    "ceil": lambda a: f"ceil({a})",
    "mul": _infix("*"),
    "div": _infix("/"),
    "minimum": lambda a, b: f"({a} != {a} || {a} < {b} ? {a} : {b})",
    "maximum": lambda a, b: f"({a} != {a} || {a} > {b} ? {a} : {b})",
    "bitwise_and": _infix("&"),
    "bitwise_or": _infix("|"),
    "bitwise_xor": _infix("^"),
    "addcmul": lambda a, b, c: f"fused({b}, {c}, {a})",
    "lerp": lambda a, b, w: (
        f"({w} < 0.5f && {w} > -0.5f ? fused({w}, {b} - {a}, {a}) : fused({a} - {b}, 1 - {w}, {b}))"
    ),
}
"""Of values of the result's type; ``fused(a, b, c)`` is a b + c, rounded once on a GPU, as torch's kernels there do."""

COMPARED: dict[str, Callable[..., str]] = {
    "gt": _infix(">"),
    "ge": _infix(">="),
    "lt": _infix("<"),
    "le": _infix("<="),
    "eq": _infix("=="),
    "ne": _infix("!="),
    "logical_and": lambda a, b: f"({a} != 0 && {b} != 0)",
    "logical_or": lambda a, b: f"({a} != 0 || {b} != 0)",
    "logical_not": lambda a: f"({a} == 0)",
}
"""Of values of the type that theirs have together; the result is a bool."""

KNOWN = frozenset(
    {"add", "sub", "rsub", "abs", "_to_copy", "bitwise_not", "pow", "where", "masked_fill", "clamp", "clamp_min"}
    | {"clamp_max", "zero", "zeros_like", "new_zeros", "ones_like", "fill", "full_like", *SAME, *COMPARED}
)
"""Names of all operations on elements."""


def element(name: str, arguments: list[Any], options: dict[str, Any], kind: torch.dtype) -> Any:
    """What an operation does to elements: its operands, how it goes into C, and whether it compares them.

    Args:
        name: Of the operation, without underscore.
        arguments: Its arguments, tensors and numbers.
        options: By name.
        kind: Type of the result.

    Returns:
        Operands, function of their C, whether they are compared in a common type; ``None`` for another operation.
    """
    c = TYPES[kind]
    if name in SAME:
        if name == "addcmul" and options.get("value", 1) != 1:
            return None
        if name == "div" and options.get("rounding_mode") is not None:
            return None
        if name == "copy":
            return arguments[1:2], SAME[name], False
        wanted = 3 if name in ("addcmul", "lerp") else 2 if _is_binary(name) else 1
        return arguments[:wanted], SAME[name], False
    if name in COMPARED:
        return arguments[: 1 if name == "logical_not" else 2], COMPARED[name], True
    if name in ("add", "sub", "rsub"):
        alpha = arguments[2] if len(arguments) > 2 else options.get("alpha", 1)
        signed = literal(alpha if name == "add" else -alpha, c)
        exact = alpha != 1 and kind.is_floating_point
        sign = "+" if name == "add" else "-"
        if name == "rsub":
            return (arguments[:2], lambda a, b: f"({b} - {a})", False) if alpha == 1 else None
        if exact:
            return arguments[:2], lambda a, b: f"fused({signed}, {b}, {a})", False
        return (arguments[:2], lambda a, b: f"({a} {sign} {b})", False) if alpha == 1 else None
    if name == "abs":
        return arguments[:1], (lambda a: f"fabs({a})" if kind.is_floating_point else f"({a} < 0 ? -{a} : {a})"), False
    if name == "_to_copy":
        return arguments[:1], lambda a: a, False
    if name == "bitwise_not":
        return arguments[:1], (lambda a: f"(!{a})" if kind == torch.bool else f"(~{a})"), False
    if name == "pow" and isinstance(arguments[1], int | float):
        return arguments[:1], lambda a: f"({_pow(a, arguments[1])})", False
    if name == "where" and len(arguments) == 3:
        return arguments, lambda a, b, d: f"({a} ? {b} : {d})", False
    if name == "masked_fill":
        return [arguments[1], arguments[2], arguments[0]], lambda a, b, d: f"({a} ? {b} : {d})", False
    if name in ("clamp", "clamp_min", "clamp_max"):
        least, most = [*arguments[1:3], None, None][:2] if name != "clamp_max" else (None, arguments[1])
        least, most = options.get("min", least), options.get("max", most)
        bounds = [bound for bound in (least, most) if bound is not None]
        if least is None:
            return [arguments[0], *bounds], lambda a, b: _clamp(a, None, b, c), False
        return [arguments[0], *bounds], lambda a, b, d=None: _clamp(a, b, d, c), False
    if name in ("zero", "zeros_like", "new_zeros"):
        return [0.0], lambda a: a, False
    if name == "ones_like":
        return [1.0], lambda a: a, False
    if name in ("fill", "full_like"):
        return [arguments[1]], lambda a: a, False
    return None


def _is_binary(name: str) -> bool:
    return name in ("mul", "div", "minimum", "maximum", "bitwise_and", "bitwise_or", "bitwise_xor")
