"""From an operation of torch to what a kernel does for each row of its tensors, or once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from itertools import accumulate, count, product
from math import prod
from typing import Any

import torch

from pace_envs.compiler.operations import COMPARED, KNOWN, TYPES, rule
from pace_envs.compiler.row_source import Operation, Writer
from pace_envs.compiler.rows import Array, Index, RowSpace, elements
from pace_envs.compiler.tape import Node, Tape

Plan = tuple[Any, Operation] | None
"""A result and how a kernel makes it; ``None`` where that is left to torch."""
Load = Callable[[int, Index], Node]
"""An element of one of the sources."""
MOST_ELEMENTS = 512
"""Of a row that an operation may have; more are left to torch."""


def plan(space: RowSpace, func: Any, name: str, args: tuple, kwargs: dict[str, Any], target: Any) -> Plan:
    """The result of an operation and how a kernel makes it; ``None`` where it is left to torch.

    Args:
        name: Its name, without the underscore of those in place.
        kwargs: Options, without ``out``.
        target: What it writes; ``None`` for a new tensor.
    """
    own = _ENTRIES.get(name)
    if own is not None:
        return own(space, args, kwargs, target)
    if name not in KNOWN and name not in _WHOLE:
        return None
    result = target if target is not None else _result_for(space, func, args, kwargs)
    if result is None:
        return None
    return _WHOLE.get(name, on_elements)(space, name, args, kwargs, result)


def on_elements(space: RowSpace, name: str, args: Sequence[Any], kwargs: dict[str, Any], result: torch.Tensor) -> Plan:
    """Each element of a result from the elements at its place, spread as torch spreads them."""
    found = rule(name, args, kwargs, result.dtype) if result.dtype in TYPES else None
    if found is None:
        return None
    values, form = found
    compared = name in COMPARED
    dtype = torch.result_type(values[0], values[-1]) if compared else result.dtype
    operands = [each for each in (_operand(space, value) for value in values) if each is not None]
    if dtype not in TYPES or len(operands) < len(values):
        return None
    kinds = ["bool" if i == 0 and name in ("where", "masked_fill") else TYPES[dtype] for i in range(len(values))]
    tensors = [each for each in operands if isinstance(each, torch.Tensor)]
    numbers = [None if isinstance(each, torch.Tensor) else each for each in operands]  # what waits holds no tensor:
    made = "bool" if compared else TYPES[dtype]  # a result that is still referenced is written to memory

    def element(tape: Tape, load: Load, index: Index) -> Node:
        source = count()
        nodes = [
            tape.cast(load(next(source), index), kind) if number is None else tape.constant(number, kind)
            for number, kind in zip(numbers, kinds, strict=True)
        ]
        return tape.add(form, *nodes, kind=made)

    return _mapped(space, result, tensors, element)


def _mapped(
    space: RowSpace,
    result: torch.Tensor,
    sources: Sequence[torch.Tensor],
    element: Callable[[Tape, Load, Index], Node],
    aligned: bool = True,
) -> Plan:
    """Each element of a result from elements of sources.

    Args:
        sources: Tensors that it is made of.
        element: Makes the one at an index, 0 along the axis of rows.
        aligned: Whether sources are spread over the result as torch spreads them; else each has its own axis of rows.
    """
    axis = space.axis(result)
    if not _takes(space, result, *sources) or (axis is not None and result.stride(axis) == 0):
        return None
    to, arrays = space.array(result), [space.array(source) for source in sources]
    axes = [axis if aligned else space.axis(each) for each in arrays]
    if aligned and not all(_fits(each, axis, space.rows) for each in arrays):
        return None
    if not aligned and any((own is None) != (axis is None) for own in axes):
        return None

    def emit(writer: Writer) -> None:
        def load(source: int, index: Index) -> Node:
            return writer.load(arrays[source], index, axes[source])

        made = [(index, element(writer.tape, load, index)) for index in elements(to.shape, axis)]
        for index, node in made:
            writer.store(to, index, axis, writer.tape.cast(node, TYPES[to.dtype]))

    return result, _operation(emit, list(zip(arrays, axes, strict=True)), [(to, axis)], axis is None)


def _operation(
    emit: Callable[[Writer], None],
    reads: Iterable[tuple[Array, int | None]],
    writes: Iterable[tuple[Array, int | None]],
    is_single: bool,
) -> Operation:
    """For each row, or once; arrays with their axes of rows."""
    touched = [
        [(each, ("single", each.dtype) if is_single else each.mode(axis)) for each, axis in part]
        for part in (reads, writes)
    ]
    return Operation(is_single=is_single, emit=emit, reads=touched[0], writes=touched[1])


def _takes(space: RowSpace, result: torch.Tensor, *sources: torch.Tensor) -> bool:
    """Whether kernels take these."""
    return 0 < space.count(result) <= MOST_ELEMENTS and all(
        each.dtype in TYPES and each.layout == torch.strided and each.device == space.device
        for each in (result, *sources)
    )


def _fits(array: Array, axis: int | None, rows: int) -> bool:
    """Whether an operand has rows where the result has, or is spread over them."""
    return axis is None or -axis > len(array.shape) or array.shape[axis] in (1, rows)


def _operand(space: RowSpace, value: Any) -> torch.Tensor | float | None:
    """A tensor, or a number where it is known; ``None`` for anything else."""
    if not isinstance(value, torch.Tensor):
        return value if isinstance(value, bool | int | float) else None
    if value.device != space.device:
        return value.item() if value.ndim == 0 else None
    known = space.constant(value)
    return value if known is None else known


def _result_for(space: RowSpace, func: Any, args: tuple, kwargs: dict[str, Any]) -> torch.Tensor | None:
    """Memory for an operation's result; ``None`` where it is no tensor on this device."""
    if kwargs.get("device") not in (None, space.device):
        return None
    try:
        like = func(*_to_meta(args), **_to_meta({k: v for k, v in kwargs.items() if k != "device"}))
        result = torch.empty_strided(like.shape, like.stride(), dtype=like.dtype, device=space.device)
    except (NotImplementedError, RuntimeError):
        return None
    if result.numel():
        space.array(result, is_own=True)
    return result


def _to_meta(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device="meta")
    if isinstance(value, dict):
        return {key: _to_meta(each) for key, each in value.items()}
    return type(value)(map(_to_meta, value)) if isinstance(value, list | tuple) else value


# ---------------------------------------------------------------------- of several elements


def _reduced(space: RowSpace, name: str, args: Sequence[Any], kwargs: dict[str, Any], result: torch.Tensor) -> Plan:
    """The sum, mean, any, all or length of a tensor along some axes, which may be all rows."""
    source, is_norm = args[0], name == "linalg_vector_norm"
    shape, rest = tuple(source.shape), args[1:]
    if is_norm:
        if not source.is_floating_point() or (rest[0] if rest else kwargs.get("ord", 2)) != 2:
            return None
        rest = rest[1:]
    if not 0 < space.count(source) <= MOST_ELEMENTS:
        return None
    given = rest[0] if rest else kwargs.get("dim")
    given = [given] if isinstance(given, int) else given or range(source.ndim)
    dims = sorted(d % max(source.ndim, 1) for d in given)
    keeps = bool(rest[1] if len(rest) > 1 else kwargs.get("keepdim", False))
    truths = name in ("any", "all")
    kind = "bool" if truths else TYPES.get(result.dtype, "")
    total, axis = prod(shape[d] for d in dims), space.axis(source)
    sizes = [1 if axis is not None and d == axis + len(shape) else size for d, size in enumerate(shape)]

    def parts(index: Index) -> list[Index]:
        kept = iter(i for d, i in enumerate(index) if not (keeps and d in dims))
        return list(product(*(range(size) if d in dims else (next(kept),) for d, size in enumerate(sizes))))

    def finished(tape: Tape, node: Node) -> Node:
        if is_norm:
            return tape.add("sqrt({0})", node, kind=kind)
        return tape.add(f"({{0}} / {total})", node, kind=kind) if name == "mean" else node

    step = {"any": "({0} || {1})", "all": "({0} && {1})"}.get(name, "({0} + {1})")

    def element(tape: Tape, load: Load, index: Index) -> Node:
        loaded = [tape.cast(load(0, each), kind) for each in parts(index)]
        if is_norm:
            loaded = [tape.add("({0} * {0})", each, kind=kind) for each in loaded]
        return finished(tape, reduce(lambda a, b: tape.add(step, a, b, kind=kind), loaded))

    if axis is None or axis + len(shape) not in dims:
        return _mapped(space, result, [source], element, aligned=False)
    if is_norm or name == "all" or not _takes(space, result, source) or space.axis(result):
        return None
    from_, to = space.array(source), space.array(result)
    over = "({0} || ({1} != 0))" if truths else f"({{0}} + ({kind}){{1}})"

    def emit(writer: Writer) -> None:
        for index in elements(to.shape, None):
            cells = [from_.cell(each) for each in parts(index)]
            node = finished(writer.tape, writer.reduce(kind, from_, cells, from_.row_stride(axis), over))
            writer.store(to, index, None, writer.tape.cast(node, TYPES[to.dtype]))

    operation = _operation(emit, [], [(to, None)], is_single=True)
    operation.reads.append((from_, ("reduced", from_.dtype)))
    return result, operation


def _joined(space: RowSpace, name: str, args: Sequence[Any], kwargs: dict[str, Any], result: torch.Tensor) -> Plan:
    """Tensors side by side, along an existing axis or a new one."""
    sources = list(args[0])
    dim = (args[1] if len(args) > 1 else kwargs.get("dim", 0)) % result.ndim
    axis = space.axis(result)
    if any(each.dtype != result.dtype for each in sources) or (axis is not None and dim == result.ndim + axis):
        return None
    begins = list(accumulate((each.shape[dim] for each in sources), initial=0)) if name == "cat" else []

    def element(tape: Tape, load: Load, index: Index) -> Node:
        if name == "stack":
            return load(index[dim], index[:dim] + index[dim + 1 :])
        source = max(i for i, begin in enumerate(begins[:-1]) if begin <= index[dim])
        return load(source, (*index[:dim], index[dim] - begins[source], *index[dim + 1 :]))

    return _mapped(space, result, sources, element, aligned=False)


def _repeated(space: RowSpace, name: str, args: Sequence[Any], kwargs: dict[str, Any], result: torch.Tensor) -> Plan:
    """A row for each environment."""
    shape, axis = tuple(args[0].shape), space.axis(result)
    if axis is None or space.axis(args[0]) is not None:
        return None

    def element(tape: Tape, load: Load, index: Index) -> Node:
        short = index[len(index) - len(shape) :]
        return load(0, tuple(i % size for i, size in zip(short, shape, strict=True)))

    return _mapped(space, result, [args[0]], element)


def _crossed(space: RowSpace, name: str, args: Sequence[Any], kwargs: dict[str, Any], result: torch.Tensor) -> Plan:
    """Products of vectors in the last axis."""
    wanted = space.rows, 3
    if kwargs.get("dim", -1) not in (-1, 1) or any(tuple(each.shape) != wanted for each in (result, *args[:2])):
        return None

    kind = TYPES.get(result.dtype, "")

    def element(tape: Tape, load: Load, index: Index) -> Node:
        i, j = ((index[1] + k) % 3 for k in (1, 2))
        numbers = [load(0, (0, i)), load(1, (0, j)), load(0, (0, j)), load(1, (0, i))]
        return tape.add("({0} * {1} - {2} * {3})", *numbers, kind=kind)

    return _mapped(space, result, args[:2], element)


# ---------------------------------------------------------------------- with indices: all rows, columns, a mask of rows


def _columns(space: RowSpace, source: torch.Tensor, index: list[Any]) -> tuple[bool, torch.Tensor | None]:
    """Whether indices are all rows and some columns; and the columns, ``None`` for all."""
    if len(index) == 1 or all(each is None for each in index[1:]):
        return space.is_every_row(index[0]) and index[0].ndim == 1, None
    rows, columns = index
    if columns is None or source.ndim != 2 or columns.dtype != torch.int64 or columns.device != space.device:
        return False, None
    all_rows = rows is None or (space.is_every_row(rows) and tuple(rows.shape) == (space.rows, 1))
    return all_rows and columns.numel() == max(columns.shape) and columns.ndim == (1 if rows is None else 2), columns


def _has_rows_first(space: RowSpace, tensor: torch.Tensor) -> bool:
    return tensor.ndim > 0 and space.axis(tensor) == -tensor.ndim


def _taken(space: RowSpace, args: Sequence[Any], kwargs: dict[str, Any], target: Any) -> Plan:
    """``source[indices]`` of all rows, or of columns."""
    if target is not None or not _has_rows_first(space, args[0]):
        return None
    known, columns = _columns(space, args[0], list(args[1]))
    if not known:
        return None
    if columns is not None:
        return _entries_taken(space, args[0], 1, _for_rows(space, columns), None)
    result = torch.empty(args[0].shape, dtype=args[0].dtype, device=space.device)
    return on_elements(space, "clone", args[:1], {}, result)


def _selected(space: RowSpace, args: Sequence[Any], kwargs: dict[str, Any], target: Any) -> Plan:
    """Columns by their numbers."""
    source, dim, index = args
    if not _has_rows_first(space, source) or source.ndim != 2 or dim % 2 != 1 or index.dtype != torch.int64:
        return None
    return _entries_taken(space, source, 1, _for_rows(space, index), target)


def _for_rows(space: RowSpace, columns: torch.Tensor) -> torch.Tensor:
    """Columns, which all rows share, as an index of each row."""
    return columns.reshape(1, -1).expand(space.rows, -1)


def _put(space: RowSpace, args: Sequence[Any], kwargs: dict[str, Any], target: Any) -> Plan:
    """``field[indices] = value`` for all rows, columns, or the rows of a mask."""
    field, index, value = args[0], list(args[1]), args[2]
    if (args[3] if len(args) > 3 else kwargs.get("accumulate", False)) or not _has_rows_first(space, field):
        return None
    first = index[0]
    if isinstance(first, torch.Tensor) and first.dtype == torch.bool:
        if len(index) != 1 or value.ndim != 0 or tuple(first.shape) != (space.rows,):
            return None
        return on_elements(space, "where", [first.view(-1, *[1] * (field.ndim - 1)), value, field], {}, field)
    known, columns = _columns(space, field, index)
    if not known:
        return None
    if columns is None:
        return on_elements(space, "copy", [field, value], {}, field)
    place = _for_rows(space, columns)
    if value.ndim > 2 or any(size not in (1, n) for size, n in zip(value.shape[::-1], place.shape[::-1], strict=False)):
        return None
    return _entries_put(space, field, 1, place, value.expand(place.shape))


def _cells(
    space: RowSpace, table: torch.Tensor, dim: int, index: torch.Tensor
) -> tuple[int, list[tuple[Index, int]]] | None:
    """The axis of rows, and of an index's elements the cell where the table's place in other axes begins."""
    axis = space.axis(index)
    is_own = axis == space.axis(table) and table.ndim == index.ndim
    if axis is None or not is_own or dim % table.ndim == table.ndim + axis or index.dtype != torch.int64:
        return None
    strides = [0 if d in (dim % table.ndim, table.ndim + axis) else each for d, each in enumerate(table.stride())]
    begin = int(table.storage_offset())
    every = elements(tuple(index.shape), axis)
    return axis, [(each, begin + sum(i * stride for i, stride in zip(each, strides, strict=True))) for each in every]


def _entries_taken(space: RowSpace, table: torch.Tensor, dim: int, index: torch.Tensor, target: Any) -> Plan:
    """Each row's entries of a table by their numbers along another axis."""
    if (found := _cells(space, table, dim, index)) is None:
        return None
    axis, cells = found
    result = torch.empty(index.shape, dtype=table.dtype, device=space.device) if target is None else target
    if not _takes(space, result, table, index) or result.dtype != table.dtype or space.axis(result) != axis:
        return None
    from_, to, at = space.array(table), space.array(result, is_own=target is None), space.array(index)

    def emit(writer: Writer) -> None:
        for each, cell in cells:
            number = _from_zero(writer, writer.load(at, each, axis), table.shape[dim])
            writer.store(to, each, axis, writer.load_at(from_, cell, table.stride(axis), number, table.stride(dim)))

    return result, _operation(emit, [(at, axis), (from_, axis)], [(to, axis)], is_single=False)


def _entries_put(space: RowSpace, table: torch.Tensor, dim: int, index: torch.Tensor, source: torch.Tensor) -> Plan:
    """Write each row's entries of a table by their numbers along another axis."""
    if (found := _cells(space, table, dim, index)) is None or not _takes(space, table, source, index):
        return None
    axis, cells = found
    to, from_, at = space.array(table), space.array(source), space.array(index)

    def emit(writer: Writer) -> None:
        kind = TYPES[to.dtype]
        values = [(each, cell, writer.tape.cast(writer.load(from_, each, axis), kind)) for each, cell in cells]
        for each, cell, value in values:
            number = _from_zero(writer, writer.load(at, each, axis), table.shape[dim])
            writer.store_at(to, cell, table.stride(axis), number, table.stride(dim), value)

    return table, _operation(emit, [(at, axis), (from_, axis)], [(to, axis)], is_single=False)


def _from_zero(writer: Writer, number: Node, size: int) -> Node:
    return writer.tape.add(f"({{0}} < 0 ? {{0}} + {size} : {{0}})", number, kind=number.kind)


def _gathered(space: RowSpace, args: Sequence[Any], kwargs: dict[str, Any], target: Any) -> Plan:
    table, dim, index = args[:3]
    return None if target is not None else _entries_taken(space, table, dim, index, None)


def _scattered(space: RowSpace, args: Sequence[Any], kwargs: dict[str, Any], target: Any) -> Plan:
    table, dim, index, source = args[:4]
    if kwargs or target is not table or not isinstance(source, torch.Tensor) or source.shape != index.shape:
        return None
    return None if source.dtype != table.dtype else _entries_put(space, table, dim, index, source)


_WHOLE: dict[str, Callable[..., Plan]] = {
    **dict.fromkeys(("sum", "mean", "any", "all", "linalg_vector_norm"), _reduced),
    **dict.fromkeys(("stack", "cat"), _joined),
    "repeat": _repeated,
    "linalg_cross": _crossed,
}
"""Whose result is made of other elements than those at its place."""
_ENTRIES: dict[str, Callable[..., Plan]] = {
    "index": _taken,
    "index_select": _selected,
    "index_put": _put,
    "gather": _gathered,
    "scatter": _scattered,
}
"""Whose result is made of entries that indices name."""
