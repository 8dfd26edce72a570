"""From an operation of torch to what a kernel does: elements, sums, stacks, indices."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.fused.expressions import KNOWN, cast, element, literal
from pace_envs.fused.memory import Array, Index, Mode, Operation, count, elements, row_axis
from pace_envs.fused.writer import TYPES, Writer

if TYPE_CHECKING:
    from pace_envs.fused.fusion import Fusion

Plan = tuple[Any, Operation] | None
_MOST_ELEMENTS = 512
"""Of a row that an operation may have; more are left to torch."""
_REDUCED = {"sum": ("0", "({0} + {1})"), "any": ("0", "({0} || {1})")}


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
    result = target if target is not None else _result(fusion, func, args, kwargs)
    if result is None:
        return None
    found = element(name, arguments, kwargs, result.dtype)
    if found is None:
        return None
    values, expression, is_compared = found
    return _elementwise(fusion, name, values, expression, is_compared, result)


def filled(fusion: Fusion, result: torch.Tensor, value: float) -> Operation:
    """A number goes everywhere."""
    planned = _elementwise(fusion, "fill", [value], lambda a: a, False, result)
    assert planned is not None
    return planned[1]


def _result(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any]) -> torch.Tensor | None:
    if kwargs.get("device") not in (None, fusion.device):
        return None
    try:
        return fusion.result_of(func, args, kwargs)
    except (NotImplementedError, RuntimeError):
        return None


def _loop(fusion: Fusion, *tensors: torch.Tensor) -> tuple[bool, int | None]:
    """Whether kernels take these, of which the first is the result, and along which axis its rows are."""
    axis = row_axis(tuple(tensors[0].shape), fusion.rows)
    takes = all(
        each.dtype in TYPES and each.layout == torch.strided and each.device == fusion.device for each in tensors
    )
    return takes and 0 < count(tuple(tensors[0].shape), axis) <= _MOST_ELEMENTS, axis


def _fits(array: Array, axis: int | None, rows: int) -> bool:
    """Whether an operand has rows where the result has, or is spread over them."""
    if axis is None or -axis > len(array.shape):
        return True
    return array.shape[axis] in (1, rows)


def _operation(
    emit: Callable[[Writer], None], reads: list[Array], writes: list[Array], axis: int | None, *, more: Any = ()
) -> Operation:
    """For each row, or once where there is no axis of rows."""

    def mode(array: Array) -> Mode:
        return array.mode(axis) if axis is not None else ("single", array.dtype)

    return Operation(
        is_single=axis is None,
        emit=emit,
        reads=[(each, mode(each)) for each in reads] + list(more),
        writes=[(each, mode(each)) for each in writes],
    )


def _operand(fusion: Fusion, value: Any) -> Array | float | bool | int | None:
    """A tensor as an array, a number as it is; ``None`` for anything else."""
    if isinstance(value, torch.Tensor):
        if value.device != fusion.device:
            return value.item() if value.ndim == 0 else None
        known = fusion.constant(value)
        return fusion.array(value) if known is None else known
    return value if isinstance(value, bool | int | float) else None


def _elementwise(
    fusion: Fusion, name: str, values: list[Any], expression: Any, is_compared: bool, result: torch.Tensor
) -> Plan:
    tensors = [value for value in values if isinstance(value, torch.Tensor) and value.device == fusion.device]
    takes, axis = _loop(fusion, result, *tensors)
    operands = [_operand(fusion, value) for value in values]
    if not takes or any(each is None for each in operands):
        return None
    target = fusion.array(result)
    arrays = [each for each in operands if isinstance(each, Array)]
    if not all(_fits(each, axis, fusion.rows) for each in arrays) or (axis is not None and not target.row_stride(axis)):
        return None
    kind = reduce(torch.promote_types, [_kind(value) for value in values]) if is_compared else result.dtype
    if is_compared:
        kind = torch.result_type(*values) if len(values) == 2 else kind
    kinds = [torch.bool if i == 0 and name in ("where", "masked_fill") else kind for i in range(len(values))]
    made = torch.bool if is_compared else result.dtype

    def emit(writer: Writer) -> None:
        ready = []
        for index in elements(target.shape, axis):
            c = [
                cast(writer.load(each, index, axis), each.dtype, wanted)
                if isinstance(each, Array)
                else literal(each, TYPES[wanted])  # type: ignore[arg-type]
                for each, wanted in zip(operands, kinds, strict=True)
            ]
            value = writer.value(TYPES[made], expression(*c))
            ready.append((index, cast(value, made, target.dtype)))
        for index, value in ready:
            writer.store(target, index, axis, value)

    return result, _operation(emit, arrays, [target], axis)


def _kind(value: Any) -> torch.dtype:
    if isinstance(value, torch.Tensor):
        return value.dtype
    return torch.bool if isinstance(value, bool) else torch.int64 if isinstance(value, int) else torch.float32


# ---------------------------------------------------------------------- sums


def _reduction(name: str) -> Callable[..., Plan]:
    def make(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
        source = args[0]
        result = target if target is not None else _result(fusion, func, args, kwargs)
        if result is None or source.numel() == 0:
            return None
        dims = _dims(args, kwargs, source.ndim)
        keeps = bool(kwargs.get("keepdim", args[2] if len(args) > 2 else False))
        rows = row_axis(tuple(source.shape), fusion.rows)
        reduces_rows = rows is not None and rows + source.ndim in dims
        takes, axis = _loop(fusion, result, source)
        from_, to = fusion.array(source), fusion.array(result)
        if not takes or (axis is None) != (reduces_rows or rows is None) or len(dims) * source.numel() == 0:
            return None
        if count(from_.shape, rows) > _MOST_ELEMENTS:
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

        operation = _operation(emit, [], [to], axis)
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


def _norm(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    source = args[0]
    power = args[1] if len(args) > 1 else kwargs.get("ord", 2)
    rows = row_axis(tuple(source.shape), fusion.rows)
    dims = _dims(args[1:], kwargs, source.ndim)
    result = target if target is not None else _result(fusion, func, args, kwargs)
    if result is None or power != 2 or rows is None or rows + source.ndim in dims or not source.is_floating_point():
        return None
    takes, axis = _loop(fusion, result, source)
    if not takes or axis is None or count(tuple(source.shape), rows) > _MOST_ELEMENTS:
        return None
    from_, to = fusion.array(source), fusion.array(result)
    keeps = bool(args[3] if len(args) > 3 else kwargs.get("keepdim", False))
    places, c = _places(from_.shape, dims, rows), TYPES[to.dtype]

    def emit(writer: Writer) -> None:
        for index, parts in places.items():
            values = [writer.load(from_, each, rows) for each in parts]
            total = writer.value(c, "sqrt(" + " + ".join(f"{v} * {v}" for v in values) + ")")
            writer.store(to, _spread(index, dims, keeps), axis, total)

    operation = _operation(emit, [], [to], axis)
    operation.reads.append((from_, from_.mode(rows)))
    return result, operation


# ---------------------------------------------------------------------- put together


def _joined(is_stack: bool) -> Callable[..., Plan]:
    def make(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
        parts = list(args[0])
        result = target if target is not None else _result(fusion, func, args, kwargs)
        if result is None or any(part.dtype != result.dtype for part in parts):
            return None
        takes, axis = _loop(fusion, result, *parts)
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

        operation = _operation(emit, [], [to], axis)
        for array in arrays:
            own = row_axis(array.shape, fusion.rows)
            operation.reads.append((array, array.mode(own) if axis is not None else ("single", array.dtype)))
        return result, operation

    return make


def _repeat(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    result = _result(fusion, func, args, kwargs)
    if result is None:
        return None
    takes, axis = _loop(fusion, result, args[0])
    from_, to = fusion.array(args[0]), fusion.array(result)
    if not takes or axis is None or row_axis(from_.shape, fusion.rows) is not None:
        return None
    if not _fits(from_, axis, fusion.rows):
        return None

    def emit(writer: Writer) -> None:
        for index in elements(to.shape, axis):
            short = index[len(index) - len(from_.shape) :]
            place = tuple(i % size for i, size in zip(short, from_.shape, strict=True))
            writer.store(to, index, axis, writer.load(from_, place, axis))

    return result, _operation(emit, [from_], [to], axis)


def _cross(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    result = target if target is not None else _result(fusion, func, args, kwargs)
    if result is None or kwargs.get("dim", -1) not in (-1, 1) or result.ndim != 2 or result.shape[1] != 3:
        return None
    takes, axis = _loop(fusion, result, *args[:2])
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

    return result, _operation(emit, [a, b], [to], axis)


# ---------------------------------------------------------------------- indices


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


def _taken(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    if target is not None or not _has_rows_first(fusion, args[0]):
        return None
    fits, columns = _columns(fusion, args[0], list(args[1]))
    if not fits:
        return None
    if columns is None:
        result = torch.empty(args[0].shape, dtype=args[0].dtype, device=fusion.device)
        return _elementwise(fusion, "clone", [args[0]], lambda a: a, False, result)
    return _columns_taken(fusion, args[0], columns)


def _selected(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    source, dim, index = args
    if not _has_rows_first(fusion, source) or source.ndim != 2 or dim % 2 != 1 or index.dtype != torch.int64:
        return None
    return _columns_taken(fusion, source, index, target)


def _columns_taken(fusion: Fusion, source: torch.Tensor, columns: torch.Tensor, target: Any = None) -> Plan:
    flat = columns.reshape(-1)
    result = target
    if result is None:
        result = torch.empty(fusion.rows, len(flat), dtype=source.dtype, device=fusion.device)
    takes, axis = _loop(fusion, result, source, flat)
    if not takes or axis != -2 or result.dtype != source.dtype:
        return None
    from_, to, at = fusion.array(source), fusion.array(result), fusion.array(flat)

    def emit(writer: Writer) -> None:
        for i in range(len(flat)):
            value = writer.load_at(from_, _moving(writer, from_, at, i), from_.offset)
            writer.store(to, (0, i), axis, value)

    reads: list[tuple[Array, Mode]] = [(from_, from_.mode(axis)), (at, ("shared", at.dtype))]
    return result, _operation(emit, [], [to], axis, more=reads)


def _moving(writer: Writer, array: Array, columns: Array, i: int) -> str:
    column = writer.load(columns, (i,), None)
    size = array.shape[1]
    return f"(long long)r * {array.strides[0]} + ({column} < 0 ? {column} + {size} : {column}) * {array.strides[1]}"


def _put(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    field, index, value = args[0], list(args[1]), args[2]
    if (args[3] if len(args) > 3 else kwargs.get("accumulate", False)) or not _has_rows_first(fusion, field):
        return None
    first = index[0]
    is_mask = isinstance(first, torch.Tensor) and first.dtype == torch.bool
    if is_mask and len(index) == 1 and value.ndim == 0 and tuple(first.shape) == (fusion.rows,):
        mask = first.view(-1, *[1] * (field.ndim - 1))
        return _elementwise(fusion, "where", [mask, value, field], lambda a, b, d: f"({a} ? {b} : {d})", False, field)
    if is_mask:
        return None
    fits, columns = _columns(fusion, field, index)
    if not fits:
        return None
    if columns is None:
        return _elementwise(fusion, "copy", [value], lambda a: a, False, field)
    flat = columns.reshape(-1)
    takes, axis = _loop(fusion, field, value, flat)
    to, from_, at = fusion.array(field), fusion.array(value), fusion.array(flat)
    wide = (fusion.rows, len(flat))
    fits = _fits(from_, axis, fusion.rows) and (value.ndim == 0 or value.shape[-1] in (1, wide[1]))
    if not takes or axis != -2 or not fits:
        return None

    def emit(writer: Writer) -> None:
        values = [cast(writer.load(from_, (0, i), axis), from_.dtype, to.dtype) for i in range(wide[1])]
        for i, each in enumerate(values):
            writer.store_at(to, _moving(writer, to, at, i), to.offset, each)

    more: list[tuple[Array, Mode]] = [(at, ("shared", at.dtype))]
    return field, _operation(emit, [from_], [to], axis, more=more)


_OWN: dict[str, Callable[..., Plan]] = {
    **{name: _reduction(name) for name in ("sum", "mean", "any", "all")},
    "linalg_vector_norm": _norm,
    "stack": _joined(True),
    "cat": _joined(False),
    "repeat": _repeat,
    "linalg_cross": _cross,
    "index": _taken,
    "index_select": _selected,
    "index_put": _put,
}
