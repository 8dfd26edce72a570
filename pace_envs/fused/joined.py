"""Operations that put tensors together: stacks, copies side by side, products of vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pace_envs.fused.elementwise import Plan, fits, loop_over, operation_of, result_for
from pace_envs.fused.memory import elements, row_axis
from pace_envs.fused.writer import TYPES, Writer

if TYPE_CHECKING:
    from pace_envs.fused.fusion import Fusion


def joined(is_stack: bool) -> Callable[..., Plan]:
    """Tensors side by side, along an axis of their own or a new one."""

    def make(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
        parts = list(args[0])
        result = target if target is not None else result_for(fusion, func, args, kwargs)
        if result is None or any(part.dtype != result.dtype for part in parts):
            return None
        takes, axis = loop_over(fusion, result, *parts)
        dim = (args[1] if len(args) > 1 else kwargs.get("dim", 0)) % result.ndim
        if not takes or (axis is not None and dim == result.ndim + axis):
            return None
        to, arrays = fusion.array(result), [fusion.array(part) for part in parts]
        moves = []
        start = 0
        for array in arrays:
            own = row_axis(array.shape, fusion.rows)
            if (axis is None) != (own is None):
                return None
            for index in elements(array.shape, own):
                place = (*index[:dim], start, *index[dim:]) if is_stack else index
                if not is_stack:
                    place = (*index[:dim], index[dim] + start, *index[dim + 1 :])
                moves.append((array, index, own, place))
            start += 1 if is_stack else array.shape[dim]

        def emit(writer: Writer) -> None:
            values = [(place, writer.load(array, index, own)) for array, index, own, place in moves]
            for place, value in values:
                writer.store(to, place, axis, value)

        operation = operation_of(emit, [], [to], axis)
        for array in arrays:
            own = row_axis(array.shape, fusion.rows)
            operation.reads.append((array, array.mode(own) if axis is not None else ("single", array.dtype)))
        return result, operation

    return make


def repeat(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """A row for each environment."""
    result = result_for(fusion, func, args, kwargs)
    if result is None:
        return None
    takes, axis = loop_over(fusion, result, args[0])
    from_, to = fusion.array(args[0]), fusion.array(result)
    if not takes or axis is None or row_axis(from_.shape, fusion.rows) is not None:
        return None
    if not fits(from_, axis, fusion.rows):
        return None

    def emit(writer: Writer) -> None:
        for index in elements(to.shape, axis):
            short = index[len(index) - len(from_.shape) :]
            place = tuple(i % size for i, size in zip(short, from_.shape, strict=True))
            writer.store(to, index, axis, writer.load(from_, place, axis))

    return result, operation_of(emit, [from_], [to], axis)


def cross(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """Products of vectors in the last axis."""
    result = target if target is not None else result_for(fusion, func, args, kwargs)
    if result is None or kwargs.get("dim", -1) not in (-1, 1) or result.ndim != 2 or result.shape[1] != 3:
        return None
    takes, axis = loop_over(fusion, result, *args[:2])
    a, b, to = fusion.array(args[0]), fusion.array(args[1]), fusion.array(result)
    if not takes or axis != -2 or a.shape != to.shape or b.shape != to.shape:
        return None
    c = TYPES[to.dtype]

    def emit(writer: Writer) -> None:
        x, y = ([writer.load(each, (0, i), axis) for i in range(3)] for each in (a, b))
        pairs = [((i + 1) % 3, (i + 2) % 3) for i in range(3)]
        values = [writer.value(c, f"{x[i]} * {y[j]} - {x[j]} * {y[i]}") for i, j in pairs]
        for i, value in enumerate(values):
            writer.store(to, (0, i), axis, value)

    return result, operation_of(emit, [a, b], [to], axis)
