"""Torch's operations on single numbers, as C: one table for all kernels, and the functions that they call.

Names are those of ATen, without the underscore of those in place. ``{0}``, ``{1}``, ... are operands of one type.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

TYPES = {
    torch.float32: "float",
    torch.float64: "double",
    torch.bool: "bool",
    torch.int64: "long long",
    torch.int32: "int",
    torch.uint8: "unsigned char",
}
"""Torch's types in C."""

_FUNCTIONS = "sqrt exp exp2 expm1 log log2 log10 log1p sin cos tan asin acos atan sinh cosh tanh erf floor ceil trunc"

UNARY = {
    **{name: f"{name}({{0}})" for name in _FUNCTIONS.split()},
    "neg": "(-{0})",
    "abs": "fabs({0})",
    "square": "({0} * {0})",
    "rsqrt": "(1 / sqrt({0}))",
    "reciprocal": "(1 / {0})",
    "round": "rint({0})",
    "sign": "sign_of({0})",
    "sgn": "sign_of({0})",
    "sigmoid": "(1 / (1 + exp(-{0})))",
    "relu": "({0} < 0 ? 0 : {0})",
    "clone": "{0}",
    "_to_copy": "{0}",
}
"""Of one number."""

BINARY = {
    "mul": "({0} * {1})",
    "div": "({0} / {1})",
    "minimum": "smaller({0}, {1})",
    "maximum": "larger({0}, {1})",
    **{name: f"{name}({{0}}, {{1}})" for name in ("fmin", "fmax", "copysign", "atan2", "hypot", "fmod")},
    "remainder": "remainder_of({0}, {1})",
}
"""Of two numbers."""

COMPARED = {
    "eq": "({0} == {1})",
    "ne": "({0} != {1})",
    "lt": "({0} < {1})",
    "le": "({0} <= {1})",
    "gt": "({0} > {1})",
    "ge": "({0} >= {1})",
    "isinf": "({0} == INF || {0} == -INF)",
    "isnan": "({0} != {0})",
    "isfinite": "({0} - {0} == 0)",
    "logical_and": "({0} != 0 && {1} != 0)",
    "logical_or": "({0} != 0 || {1} != 0)",
    "logical_xor": "(({0} != 0) != ({1} != 0))",
    "logical_not": "({0} == 0)",
}
"""Whose operands are taken in their common type, and whose result is true or false."""

BITS = {
    "bitwise_and": "({0} & {1})",
    "bitwise_or": "({0} | {1})",
    "bitwise_xor": "({0} ^ {1})",
}
"""Of two whole numbers, or truths."""

TERNARY = {"where": "({0} ? {1} : {2})", "lerp": "between({0}, {1}, {2})"}
"""Of three; the first of a choice is true or false."""

_OF_WHOLE = {"abs": "({0} < 0 ? -{0} : {0})", "fmod": "({0} % {1})", "remainder": "(({0} % {1} + {1}) % {1})"}
"""What is another form with whole numbers."""
_OF_REAL = frozenset(("addcdiv", "addcmul", "ceil", "floor", "fmax", "fmin", "lerp", "nan_to_num", "round", "trunc"))
"""What is done with floating-point numbers alone: a GPU's functions take no others."""
_FORMS = {**UNARY, **BINARY, **BITS, **COMPARED, **TERNARY}
_OPERANDS = {name: 1 + max(i for i in range(3) if f"{{{i}}}" in form) for name, form in _FORMS.items()}
_MADE = {"zero": 0.0, "zeros_like": 0.0, "new_zeros": 0.0, "ones_like": 1.0}
KNOWN = frozenset(
    ("add", "sub", "rsub", "addcmul", "addcdiv", "clamp", "clamp_min", "clamp_max", "pow", "nan_to_num", "masked_fill")
    + ("bitwise_not", "fill", "full_like", "copy", *_MADE, *_FORMS)
)
"""Names of all operations on elements."""

Rule = tuple[Sequence[Any], str]
"""Operands, tensors and numbers, and what is made of them."""


def literal(value: float, kind: str) -> str:
    """A number of Python as one of C."""
    if kind == "bool":
        return str(bool(value)).lower()
    if isinstance(value, float) and not math.isfinite(value):
        number = "(INF - INF)" if math.isnan(value) else "INF" if value > 0 else "(-INF)"
    else:
        number = repr(float(value)) if isinstance(value, float) or kind == "double" else repr(int(value))
        number = f"({number})" if value < 0 else number
    return number if kind == "double" else f"(({kind}){number})"


def rule(name: str, arguments: Sequence[Any], options: dict[str, Any], dtype: torch.dtype) -> Rule | None:
    """What an operation on elements makes of its operands; ``None`` for another operation."""
    form, is_real = _FORMS.get(name), dtype.is_floating_point
    if name in _OF_REAL and not is_real:
        return None
    if form is not None:
        if options.get("rounding_mode") is not None or len(arguments) < _OPERANDS[name]:
            return None
        return arguments[: _OPERANDS[name]], form if is_real else _OF_WHOLE.get(name, form)
    kind = TYPES[dtype]
    if name in _MADE:
        return [_MADE[name]], "{0}"
    if name in ("fill", "full_like", "copy"):
        return arguments[1:2], "{0}"
    if name in ("add", "sub", "rsub"):
        alpha = arguments[2] if len(arguments) > 2 else options.get("alpha", 1)
        if alpha == 1:
            return arguments[:2], {"add": "({0} + {1})", "sub": "({0} - {1})", "rsub": "({1} - {0})"}[name]
        scale = literal(alpha if name == "add" else -alpha, kind)
        return (arguments[:2], f"fused({scale}, {{1}}, {{0}})") if name != "rsub" and is_real else None
    if name in ("addcmul", "addcdiv"):
        value, sign = options.get("value", 1), "*" if name == "addcmul" else "/"
        if value == 1 and sign == "*":
            return arguments[:3], "fused({1}, {2}, {0})"
        return arguments[:3], f"({{0}} + {literal(value, kind)} * ({{1}} {sign} {{2}}))"
    if name in ("clamp", "clamp_min", "clamp_max"):
        least, most = [*arguments[1:3], None, None][:2] if name != "clamp_max" else (None, arguments[1])
        least, most = options.get("min", least), options.get("max", most)
        bounds = [bound for bound in (least, most) if bound is not None]
        low = "{0}" if least is None else BINARY["maximum"]
        form = low if most is None else BINARY["minimum"].format(low, f"{{{len(bounds)}}}")
        return [arguments[0], *bounds], form
    if name == "pow":
        exponent = math.nan if isinstance(arguments[1], torch.Tensor) else arguments[1]
        if exponent in (1, 2, 3):
            return arguments[:1], f"({' * '.join(['{0}'] * int(exponent))})"
        if not is_real:
            return None
        return (arguments[:1], "sqrt({0})") if exponent == 0.5 else (arguments[:2], "pow({0}, {1})")
    if name == "nan_to_num":
        nan, most, least = [*arguments[1:], None, None, None][:3]
        end = torch.finfo(dtype).max
        bounds = [nan or 0.0, end if most is None else most, -end if least is None else least]
        return [arguments[0], *bounds], "number_for({0}, {1}, {2}, {3})"
    if name == "masked_fill":
        return [arguments[1], arguments[2], arguments[0]], TERNARY["where"]
    if name == "bitwise_not":
        return arguments[:1], "(!{0})" if dtype == torch.bool else "(~{0})"
    return None


PRELUDE = """
#ifdef __CUDACC__
#define FUNCTION __device__ __forceinline__
FUNCTION float fused(float a, float b, float c) { return fmaf(a, b, c); }
FUNCTION double fused(double a, double b, double c) { return fma(a, b, c); }
#else
#include <math.h>
#define FUNCTION static inline
template <typename T> FUNCTION T fused(T a, T b, T c) { return a * b + c; }
#endif
#define INF (1e300 * 1e300)
template <typename T> FUNCTION T larger(T a, T b) { return a != a ? a : b != b ? b : a > b ? a : b; }
template <typename T> FUNCTION T smaller(T a, T b) { return a != a ? a : b != b ? b : a < b ? a : b; }
template <typename T> FUNCTION T sign_of(T a) { return (T)((a > 0) - (a < 0)); }
template <typename T> FUNCTION T between(T a, T b, T w) {
  return w < (T)0.5 && w > (T)-0.5 ? fused(w, b - a, a) : fused(a - b, 1 - w, b);
}
template <typename T> FUNCTION T number_for(T a, T nan, T most, T least) {
  return a != a ? nan : isinf(a) ? (a > 0 ? most : least) : a;
}
template <typename T> FUNCTION T remainder_of(T a, T b) {
  T r = fmod(a, b);
  return r != 0 && ((r < 0) != (b < 0)) ? r + b : r;
}
"""
"""``fused(a, b, c)`` is a b + c, rounded once on a GPU, as in torch's kernels there."""
