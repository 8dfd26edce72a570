"""Operations that make one number of several: of a row, or of all rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.fused.elementwise import MOST_ELEMENTS, Plan, loop_over, operation_of, result_for
from pace_envs.fused.expressions import cast
from pace_envs.fused.memory import Array, Index, Operation, count, elements, row_axis
from pace_envs.fused.writer import TYPES, Writer

if TYPE_CHECKING:
    from pace_envs.fused.fusion import Fusion


def reduction(name: str) -> Callable[..., Plan]:
    """The sum, mean, or any or all of a tensor along some axes."""

    def make(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
        source = args[0]
        result = target if target is not None else result_for(fusion, func, args, kwargs)
        if result is None or source.numel() == 0:
            return None
        dims = _dims(args, kwargs, source.ndim)
        keeps = bool(kwargs.get("keepdim", args[2] if len(args) > 2 else False))
        rows = row_axis(tuple(source.shape), fusion.rows)
        reduces_rows = rows is not None and rows + source.ndim in dims
        takes, axis = loop_over(fusion, result, source)
        from_, to = fusion.array(source), fusion.array(result)
        if not takes or (axis is None) != (reduces_rows or rows is None) or len(dims) * source.numel() == 0:
            return None
        if count(from_.shape, rows) > MOST_ELEMENTS:
            return None
        places = _places(from_.shape, dims, rows)
        kind = torch.bool if name in ("any", "all") else to.dtype
        c = TYPES[kind]
        if reduces_rows:
            if name == "all":
                return None
            return result, _over_rows(fusion, name, from_, to, places, c, rows, dims, keeps, source.shape)
        step = {"any": "({0} || {1})", "all": "({0} && {1})"}.get(name, "({0} + {1})")

        def emit(writer: Writer) -> None:
            for index, parts in places.items():
                value = ""
                for each in parts:
                    next_ = cast(writer.load(from_, each, rows), from_.dtype, kind)
                    value = writer.value(c, step.format(value, next_)) if value else next_
                if name == "mean":
                    value = f"({value} / {len(parts)})"
                value = cast(writer.value(c, value), kind, to.dtype)
                writer.store(to, _spread(index, dims, keeps), axis, value)

        operation = operation_of(emit, [], [to], axis)
        operation.reads.append((from_, from_.mode(rows) if axis is not None else ("single", from_.dtype)))
        return result, operation

    return make


def _over_rows(
    fusion: Fusion,
    name: str,
    from_: Array,
    to: Array,
    places: dict[Index, list[Index]],
    c: str,
    rows: int | None,
    dims: list[int],
    keeps: bool,
    shape: Any,
) -> Operation:
    total = 1
    for d in dims:
        total *= shape[d]
    step = "({0} || ({1} != 0))" if name == "any" else f"({{0}} + ({c}){{1}})"

    def emit(writer: Writer) -> None:
        for index, parts in places.items():
            cells = [from_.cell(each) for each in parts]
            value = writer.reduce(c, f"({c})0", from_, cells, from_.row_stride(rows), step)
            if name == "mean":
                value = f"({value} / {total})"
            value = cast(value, torch.bool, to.dtype) if c == "bool" else value
            writer.store(to, _spread(index, dims, keeps), None, value)

    return Operation(
        is_single=True,
        emit=emit,
        reads=[(from_, ("reduced", from_.dtype))],
        writes=[(to, ("single", to.dtype))],
    )


def _dims(args: tuple, kwargs: dict[str, Any], ndim: int) -> list[int]:
    given = args[1] if len(args) > 1 else kwargs.get("dim")
    if given is None or (isinstance(given, list | tuple) and not given):
        return list(range(ndim))
    return sorted(d % max(ndim, 1) for d in ([given] if isinstance(given, int) else given))


def _places(shape: tuple[int, ...], dims: list[int], axis: int | None) -> dict[Index, list[Index]]:
    """Of each element of the result, without the reduced axes: those that it is made of."""
    result: dict[Index, list[Index]] = {}
    for index in elements(shape, axis):
        result.setdefault(tuple(i for d, i in enumerate(index) if d not in dims), []).append(index)
    return result


def _spread(index: Index, dims: list[int], keeps: bool) -> Index:
    if not keeps:
        return index
    rest = iter(index)
    return tuple(0 if d in dims else next(rest) for d in range(len(index) + len(dims)))


def norm(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """The length of vectors."""
    source = args[0]
    power = args[1] if len(args) > 1 else kwargs.get("ord", 2)
    rows = row_axis(tuple(source.shape), fusion.rows)
    dims = _dims(args[1:], kwargs, source.ndim)
    result = target if target is not None else result_for(fusion, func, args, kwargs)
    if result is None or power != 2 or rows is None or rows + source.ndim in dims or not source.is_floating_point():
        return None
    takes, axis = loop_over(fusion, result, source)
    if not takes or axis is None or count(tuple(source.shape), rows) > MOST_ELEMENTS:
        return None
    from_, to = fusion.array(source), fusion.array(result)
    keeps = bool(args[3] if len(args) > 3 else kwargs.get("keepdim", False))
    places, c = _places(from_.shape, dims, rows), TYPES[to.dtype]

    def emit(writer: Writer) -> None:
        for index, parts in places.items():
            values = [writer.load(from_, each, rows) for each in parts]
            total = writer.value(c, "sqrt(" + " + ".join(f"{v} * {v}" for v in values) + ")")
            writer.store(to, _spread(index, dims, keeps), axis, total)

    operation = operation_of(emit, [], [to], axis)
    operation.reads.append((from_, from_.mode(rows)))
    return result, operation
