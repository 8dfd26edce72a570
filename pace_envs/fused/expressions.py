"""Operations on single elements, as C."""

from __future__ import annotations

import math
from typing import Any

import torch

from pace_envs.fused.writer import TYPES
from pace_envs.kernels.expressions import BINARY, BITS, COMPARED, LERP, UNARY, WHERE, power


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


SAME = {
    **UNARY,
    **BINARY,
    **BITS,
    "clone": "{0}",
    "copy": "{0}",
    "addcmul": "fused({1}, {2}, {0})",
    "lerp": LERP,
}
"""Of values of the result's type."""

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
        if name == "abs" and not kind.is_floating_point:
            return arguments[:1], lambda a: f"({a} < 0 ? -{a} : {a})", False
        return (arguments[1:2] if name == "copy" else arguments[: 1 + _most(SAME[name])]), SAME[name].format, False
    if name in COMPARED:
        return arguments[: 1 + _most(COMPARED[name])], COMPARED[name].format, True
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
    if name == "_to_copy":
        return arguments[:1], lambda a: a, False
    if name == "bitwise_not":
        return arguments[:1], (lambda a: f"(!{a})" if kind == torch.bool else f"(~{a})"), False
    if name == "pow" and isinstance(arguments[1], int | float):
        return arguments[:1], lambda a: power(a, arguments[1]), False
    if name == "where" and len(arguments) == 3:
        return arguments, WHERE.format, False
    if name == "masked_fill":
        return [arguments[1], arguments[2], arguments[0]], WHERE.format, False
    if name in ("clamp", "clamp_min", "clamp_max"):
        least, most = [*arguments[1:3], None, None][:2] if name != "clamp_max" else (None, arguments[1])
        least, most = options.get("min", least), options.get("max", most)
        bounds = [bound for bound in (least, most) if bound is not None]
        low = "{0}" if least is None else BINARY["maximum"].format("{0}", "{1}")
        form = low if most is None else BINARY["minimum"].format(low, f"{{{len(bounds)}}}")
        return [arguments[0], *bounds], form.format, False
    if name in ("zero", "zeros_like", "new_zeros"):
        return [0.0], lambda a: a, False
    if name == "ones_like":
        return [1.0], lambda a: a, False
    if name in ("fill", "full_like"):
        return [arguments[1]], lambda a: a, False
    return None


def _most(form: str) -> int:
    """The last operand of a form."""
    return max(i for i in range(3) if f"{{{i}}}" in form)
