"""Operations with indices: of all rows, of columns, or a mask of rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from pace_envs.fused.elementwise import Plan, elementwise, fits, loop_over, operation_of
from pace_envs.fused.expressions import cast
from pace_envs.fused.memory import Array, Index, Mode, elements, row_axis
from pace_envs.fused.writer import Writer

if TYPE_CHECKING:
    from pace_envs.fused.fusion import Fusion


def _columns(fusion: Fusion, source: torch.Tensor, index: list[Any]) -> tuple[bool, torch.Tensor | None]:
    """Whether indices are all rows and some columns; and the columns, ``None`` for all."""
    if len(index) == 1 or all(each is None for each in index[1:]):
        return fusion.is_every_row(index[0]) and index[0].ndim == 1, None
    rows, columns = index
    if columns is None or source.ndim != 2 or columns.dtype != torch.int64 or columns.device != fusion.device:
        return False, None
    all_rows = rows is None or (fusion.is_every_row(rows) and tuple(rows.shape) == (fusion.rows, 1))
    return all_rows and columns.numel() == max(columns.shape) and columns.ndim == (1 if rows is None else 2), columns


def _has_rows_first(fusion: Fusion, tensor: torch.Tensor) -> bool:
    return tensor.ndim > 0 and row_axis(tuple(tensor.shape), fusion.rows) == -tensor.ndim


def taken(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """``source[indices]`` of all rows, or of columns."""
    if target is not None or not _has_rows_first(fusion, args[0]):
        return None
    known, columns = _columns(fusion, args[0], list(args[1]))
    if not known:
        return None
    if columns is None:
        result = torch.empty(args[0].shape, dtype=args[0].dtype, device=fusion.device)
        return elementwise(fusion, "clone", [args[0]], lambda a: a, False, result)
    return _columns_taken(fusion, args[0], columns)


def selected(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """Columns by their numbers."""
    source, dim, index = args
    if not _has_rows_first(fusion, source) or source.ndim != 2 or dim % 2 != 1 or index.dtype != torch.int64:
        return None
    return _columns_taken(fusion, source, index, target)


def _columns_taken(fusion: Fusion, source: torch.Tensor, columns: torch.Tensor, target: Any = None) -> Plan:
    flat = columns.reshape(-1)
    result = target
    if result is None:
        result = torch.empty(fusion.rows, len(flat), dtype=source.dtype, device=fusion.device)
    takes, axis = loop_over(fusion, result, source, flat)
    if not takes or axis != -2 or result.dtype != source.dtype:
        return None
    from_, to, at = fusion.array(source), fusion.array(result), fusion.array(flat)

    def emit(writer: Writer) -> None:
        for i in range(len(flat)):
            value = writer.load_at(from_, _moving(writer, from_, at, i), from_.offset)
            writer.store(to, (0, i), axis, value)

    reads: list[tuple[Array, Mode]] = [(from_, from_.mode(axis)), (at, ("shared", at.dtype))]
    return result, operation_of(emit, [], [to], axis, more=reads)


def _moving(writer: Writer, array: Array, columns: Array, i: int) -> str:
    column = writer.load(columns, (i,), None)
    size = array.shape[1]
    return f"(long long)r * {array.strides[0]} + ({column} < 0 ? {column} + {size} : {column}) * {array.strides[1]}"


def put(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """``field[indices] = value`` for all rows, columns, or the rows of a mask."""
    field, index, value = args[0], list(args[1]), args[2]
    if (args[3] if len(args) > 3 else kwargs.get("accumulate", False)) or not _has_rows_first(fusion, field):
        return None
    first = index[0]
    is_mask = isinstance(first, torch.Tensor) and first.dtype == torch.bool
    if is_mask and len(index) == 1 and value.ndim == 0 and tuple(first.shape) == (fusion.rows,):
        mask = first.view(-1, *[1] * (field.ndim - 1))
        return elementwise(fusion, "where", [mask, value, field], lambda a, b, d: f"({a} ? {b} : {d})", False, field)
    if is_mask:
        return None
    known, columns = _columns(fusion, field, index)
    if not known:
        return None
    if columns is None:
        return elementwise(fusion, "copy", [value], lambda a: a, False, field)
    flat = columns.reshape(-1)
    takes, axis = loop_over(fusion, field, value, flat)
    to, from_, at = fusion.array(field), fusion.array(value), fusion.array(flat)
    wide = (fusion.rows, len(flat))
    spread = fits(from_, axis, fusion.rows) and (value.ndim == 0 or value.shape[-1] in (1, wide[1]))
    if not takes or axis != -2 or not spread:
        return None

    def emit(writer: Writer) -> None:
        values = [cast(writer.load(from_, (0, i), axis), from_.dtype, to.dtype) for i in range(wide[1])]
        for i, each in enumerate(values):
            writer.store_at(to, _moving(writer, to, at, i), to.offset, each)

    more: list[tuple[Array, Mode]] = [(at, ("shared", at.dtype))]
    return field, operation_of(emit, [from_], [to], axis, more=more)


def _entries(
    fusion: Fusion, table: torch.Tensor, dim: int, index: torch.Tensor
) -> tuple[int, list[tuple[Index, int]]] | None:
    """The axis of rows, and of an index's elements the cell where the table's place in other axes begins."""
    axis = row_axis(tuple(index.shape), fusion.rows)
    is_own = axis == row_axis(tuple(table.shape), fusion.rows) and table.ndim == index.ndim
    if axis is None or not is_own or dim % table.ndim == table.ndim + axis or index.dtype != torch.int64:
        return None
    strides = [0 if d in (dim % table.ndim, table.ndim + axis) else each for d, each in enumerate(table.stride())]
    begin = int(table.storage_offset())
    every = elements(tuple(index.shape), axis)
    return axis, [(each, begin + sum(i * stride for i, stride in zip(each, strides, strict=True))) for each in every]


def gathered(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """Each row's entries of a table by their numbers along another axis."""
    table, dim, index = args[:3]
    found = _entries(fusion, table, dim, index)
    if found is None or target is not None:
        return None
    axis, cells = found
    result = torch.empty(index.shape, dtype=table.dtype, device=fusion.device)
    from_, to, at = fusion.array(table), fusion.array(result, is_own=True), fusion.array(index)
    if not loop_over(fusion, result, table, index)[0]:
        return None

    def emit(writer: Writer) -> None:
        for each, cell in cells:
            place = f"(long long)r * {table.stride(axis)} + {writer.load(at, each, axis)} * {table.stride(dim)}"
            writer.store(to, each, axis, writer.load_at(from_, place, cell))

    return result, operation_of(emit, [at, from_], [to], axis)


def scattered(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """Write each row's entries of a table by their numbers along another axis."""
    table, dim, index, source = args[:4]
    found = None if kwargs or target is not table else _entries(fusion, table, dim, index)
    if found is None or not isinstance(source, torch.Tensor) or source.shape != index.shape:
        return None
    axis, cells = found
    to, from_, at = fusion.array(table), fusion.array(source), fusion.array(index)
    if not loop_over(fusion, table, source, index)[0] or source.dtype != table.dtype:
        return None

    def emit(writer: Writer) -> None:
        values = [(each, cell, writer.load(from_, each, axis)) for each, cell in cells]
        for each, cell, value in values:
            place = f"(long long)r * {table.stride(axis)} + {writer.load(at, each, axis)} * {table.stride(dim)}"
            writer.store_at(to, place, cell, value)

    return table, operation_of(emit, [at, from_], [to], axis)
