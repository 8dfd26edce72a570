"""From an operation of torch to what a kernel does, by its name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pace_envs.fused.elementwise import Plan, elementwise, result_for
from pace_envs.fused.expressions import KNOWN, element
from pace_envs.fused.indexed import gathered, put, scattered, selected, taken
from pace_envs.fused.joined import cross, joined, repeat
from pace_envs.fused.sums import norm, reduction

if TYPE_CHECKING:
    from pace_envs.fused.fusion import Fusion


def plan(fusion: Fusion, func: Any, name: str, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """The result of an operation and how a kernel makes it; ``None`` where it is left to torch.

    Args:
        fusion: Who asks.
        func: Torch's operation.
        name: Its name, without the underscore of those in place.
        args: Arguments.
        kwargs: Options, without ``out``.
        target: What it writes; ``None`` for a result of its own.
    """
    own = _OWN.get(name)
    if own is not None:
        return own(fusion, func, args, kwargs, target)
    if name not in KNOWN:
        return None
    arguments = list(args)
    result = target if target is not None else result_for(fusion, func, args, kwargs)
    if result is None:
        return None
    found = element(name, arguments, kwargs, result.dtype)
    if found is None:
        return None
    values, expression, is_compared = found
    return elementwise(fusion, name, values, expression, is_compared, result)


_OWN: dict[str, Callable[..., Plan]] = {
    **{name: reduction(name) for name in ("sum", "mean", "any", "all")},
    "linalg_vector_norm": norm,
    "stack": joined(True),
    "cat": joined(False),
    "repeat": repeat,
    "linalg_cross": cross,
    "index": taken,
    "index_select": selected,
    "index_put": put,
    "gather": gathered,
    "scatter": scattered,
}
