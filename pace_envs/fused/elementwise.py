"""Operations that make each element of the elements at its place, and what all operations need."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.fused.expressions import cast, literal
from pace_envs.fused.memory import Array, Mode, Operation, count, elements, row_axis
from pace_envs.fused.writer import TYPES, Writer

if TYPE_CHECKING:
    from pace_envs.fused.fusion import Fusion

Plan = tuple[Any, Operation] | None
"""A result and how a kernel makes it; ``None`` where that is left to torch."""
MOST_ELEMENTS = 512
"""Of a row that an operation may have; more are left to torch."""


def filled(fusion: Fusion, result: torch.Tensor, value: float) -> Operation:
    """A number goes everywhere."""
    planned = elementwise(fusion, "fill", [value], lambda a: a, False, result)
    assert planned is not None
    return planned[1]


def result_for(fusion: Fusion, func: Any, args: tuple, kwargs: dict[str, Any]) -> torch.Tensor | None:
    """Memory for an operation's result; ``None`` where it is no tensor on this device."""
    if kwargs.get("device") not in (None, fusion.device):
        return None
    try:
        return fusion.result_of(func, args, kwargs)
    except (NotImplementedError, RuntimeError):
        return None


def loop_over(fusion: Fusion, *tensors: torch.Tensor) -> tuple[bool, int | None]:
    """Whether kernels take these, of which the first is the result, and along which axis its rows are."""
    axis = row_axis(tuple(tensors[0].shape), fusion.rows)
    takes = all(
        each.dtype in TYPES and each.layout == torch.strided and each.device == fusion.device for each in tensors
    )
    return takes and 0 < count(tuple(tensors[0].shape), axis) <= MOST_ELEMENTS, axis


def fits(array: Array, axis: int | None, rows: int) -> bool:
    """Whether an operand has rows where the result has, or is spread over them."""
    if axis is None or -axis > len(array.shape):
        return True
    return array.shape[axis] in (1, rows)


def operation_of(
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


def elementwise(
    fusion: Fusion, name: str, values: list[Any], expression: Any, is_compared: bool, result: torch.Tensor
) -> Plan:
    """Each element of a result from the elements at its place, spread as torch spreads them."""
    tensors = [value for value in values if isinstance(value, torch.Tensor) and value.device == fusion.device]
    takes, axis = loop_over(fusion, result, *tensors)
    operands = [_operand(fusion, value) for value in values]
    if not takes or any(each is None for each in operands):
        return None
    target = fusion.array(result)
    arrays = [each for each in operands if isinstance(each, Array)]
    if not all(fits(each, axis, fusion.rows) for each in arrays) or (axis is not None and not target.row_stride(axis)):
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

    return result, operation_of(emit, arrays, [target], axis)


def _kind(value: Any) -> torch.dtype:
    if isinstance(value, torch.Tensor):
        return value.dtype
    return torch.bool if isinstance(value, bool) else torch.int64 if isinstance(value, int) else torch.float32
