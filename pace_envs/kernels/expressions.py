"""Torch's operations on single numbers, as C: one table for all kernels, and the functions that they call.

Names are torch's, without the underscore of those in place. ``{0}``, ``{1}``, ... are operands of one type.
"""

UNARY = {
    "neg": "(-{0})",
    "abs": "fabs({0})",
    "square": "({0} * {0})",
    "sqrt": "sqrt({0})",
    "rsqrt": "(1 / sqrt({0}))",
    "reciprocal": "(1 / {0})",
    "exp": "exp({0})",
    "exp2": "exp2({0})",
    "expm1": "expm1({0})",
    "log": "log({0})",
    "log2": "log2({0})",
    "log10": "log10({0})",
    "log1p": "log1p({0})",
    "sin": "sin({0})",
    "cos": "cos({0})",
    "tan": "tan({0})",
    "asin": "asin({0})",
    "acos": "acos({0})",
    "atan": "atan({0})",
    "sinh": "sinh({0})",
    "cosh": "cosh({0})",
    "tanh": "tanh({0})",
    "erf": "erf({0})",
    "floor": "floor({0})",
    "ceil": "ceil({0})",
    "trunc": "trunc({0})",
    "round": "rint({0})",
    "sign": "sign_of({0})",
    "sgn": "sign_of({0})",
    "sigmoid": "(1 / (1 + exp(-{0})))",
    "relu": "({0} < 0 ? 0 : {0})",
}
"""Of one number."""

BINARY = {
    "mul": "({0} * {1})",
    "div": "({0} / {1})",
    "minimum": "smaller({0}, {1})",
    "maximum": "larger({0}, {1})",
    "fmin": "fmin({0}, {1})",
    "fmax": "fmax({0}, {1})",
    "copysign": "copysign({0}, {1})",
    "atan2": "atan2({0}, {1})",
    "hypot": "hypot({0}, {1})",
    "fmod": "fmod({0}, {1})",
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
    "isinf": "isinf({0})",
    "isnan": "isnan({0})",
    "isfinite": "isfinite({0})",
    "logical_and": "({0} != 0 && {1} != 0)",
    "logical_or": "({0} != 0 || {1} != 0)",
    "logical_xor": "(({0} != 0) != ({1} != 0))",
    "logical_not": "({0} == 0)",
}
"""Whose result is true or false."""

BITS = {
    "bitwise_and": "({0} & {1})",
    "bitwise_or": "({0} | {1})",
    "bitwise_xor": "({0} ^ {1})",
}
"""Of two whole numbers, or truths."""

WHERE = "({0} ? {1} : {2})"
LERP = "between({0}, {1}, {2})"


def power(x: str, exponent: object) -> str:
    """A power, small ones as torch has them; the exponent is a number, or C."""
    if isinstance(exponent, int | float) and exponent in (1, 2, 3):
        return f"({' * '.join([x] * int(exponent))})"
    return f"sqrt({x})" if exponent == 0.5 else f"pow({x}, {exponent})"


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
