"""Puts operations off while a function runs, and does those that belong together in one kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch.utils._python_dispatch import TorchDispatchMode, _get_current_dispatch_mode_stack

from pace_envs.fused import structured
from pace_envs.fused.elementwise import filled
from pace_envs.fused.memory import Array, Memory, Mode, Operation, elements, row_axis
from pace_envs.fused.writer import SINGLE_WIDTH, kernels
from pace_envs.kernels import host_kernels, kernels_of

_ROW_WIDTH = 32
"""Threads of a block that has one for each row: few rows spread over the GPU."""
_SMALLEST = 2
"""Rows below which an axis of rows is not told from one that is spread."""


class Compiler(Protocol):
    """Compiles and launches kernels: those of :mod:`pace_envs.kernels`."""

    def compile(self, sources: Sequence[str]) -> None:
        """Compile those that are new."""

    def launch(self, source: str, threads: int, width: int, arguments: Sequence[Any]) -> None:
        """Queue one."""


class Fusion(TorchDispatchMode):
    """While it is entered, operations of torch on tensors of all environments are put off and done in few kernels.

    An operation that a kernel cannot do is done by torch, after all that were put off; so is what leaves the device.
    What is drawn comes from the same generator, in one piece where it is known how much is drawn: other numbers than
    without it, of the same distribution, that repeat with the seed.
    """

    def __init__(self, rows: int, device: torch.device, compiler: Compiler):
        """Prepare.

        Args:
            rows: Number of environments.
            device: Of their tensors.
            compiler: Compiles kernels for it.
        """
        super().__init__()
        self.rows, self.device, self._compiler = rows, device, compiler
        self.launched = 0
        """Kernels of its own that have been launched."""
        self.left = list[str]()
        """Operations that were left to torch since it was entered last."""
        self._draws = 0
        self._block: torch.Tensor | None = None
        self._every_row: dict[int, torch.UntypedStorage] = {}
        self._constants: dict[int, tuple[torch.UntypedStorage, float]] = {}
        self._reset()

    def __enter__(self) -> Any:
        """Begin to put off."""
        self._most_draws, self._draws, self._block = self._draws, 0, None
        self.left = []
        return super().__enter__()

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        """Do what was put off."""
        try:
            if kind is None:
                self.launch()
        finally:
            self._block = None
            self._every_row, self._constants = {}, {}
            self._reset()
            super().__exit__(kind, value, trace)

    def launch(self) -> None:
        """Do now what was put off."""
        if not self._operations:
            return
        parts = kernels(self._operations)
        self._compiler.compile([source for _, source, _ in parts])
        for phase, source, arguments in parts:
            threads, width = (SINGLE_WIDTH, SINGLE_WIDTH) if phase % 2 else (self.rows, _ROW_WIDTH)
            self._compiler.launch(source, threads, width, [self.rows, *arguments])
        self.launched += len(parts)
        self._reset()

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: Any = None) -> Any:
        """An operation of torch."""
        kwargs = dict(kwargs or {})
        schema = func._schema
        name = schema.name.partition("::")[2]
        if name == "_unsafe_view" or any(_is_view(each) for each in schema.returns):
            return func(*args, **kwargs)  # the same memory
        if schema.is_mutable:
            self._forget_changed(schema, args, kwargs)
        tensors = [each for each in _flat([*args, *kwargs.values()]) if isinstance(each, torch.Tensor)]
        if not tensors or name.removeprefix("new_").startswith("empty"):
            return self._made(func, name, args, kwargs)
        if all(each.device == self.device or each.ndim == 0 for each in tensors):
            result = self._put_off(func, name, args, kwargs)
            if result is not None:
                return result
        self.left.append(str(func))
        self.launch()
        return func(*args, **kwargs)

    # ------------------------------------------------------------------ for the operations

    def array(self, tensor: torch.Tensor, is_own: bool = False) -> Array:
        """A tensor as kernels see it."""
        storage = tensor.untyped_storage()
        key = storage.data_ptr()  # the same memory may have been handed to torch more than once
        if key not in self._memories:
            self._memories[key] = Memory(storage, is_own)
        return Array(
            self._memories[key], tensor.dtype, tuple(tensor.shape), tensor.stride(), int(tensor.storage_offset())
        )

    def is_every_row(self, index: Any) -> bool:
        """Whether indices are those of all rows, in order."""
        return (
            isinstance(index, torch.Tensor)
            and index.numel() == self.rows
            and index.untyped_storage().data_ptr() in self._every_row
        )

    def constant(self, tensor: torch.Tensor) -> float | None:
        """The number that a tensor without dimensions was made of; ``None`` where that is not known."""
        known = self._constants.get(tensor.untyped_storage().data_ptr()) if tensor.ndim == 0 else None
        return None if known is None else known[1]

    def result_of(self, func: Any, args: tuple, kwargs: dict[str, Any]) -> torch.Tensor:
        """Memory for the result of an operation."""
        like = func(*_to_meta(args), **_to_meta({k: v for k, v in kwargs.items() if k != "device"}))
        result = torch.empty_strided(like.shape, like.stride(), dtype=like.dtype, device=self.device)
        if result.numel():
            self.array(result, is_own=True)
        return result

    # ------------------------------------------------------------------ inside

    def _reset(self) -> None:
        self._operations: list[Operation] = []
        self._memories: dict[int, Memory] = {}

    def _forget_changed(self, schema: Any, args: tuple, kwargs: dict[str, Any]) -> None:
        """Indices of all rows that are written to are so no more, nor are numbers those that were put there."""
        for argument, value in [*zip(schema.arguments, args, strict=False), *_named(schema, kwargs)]:
            if argument.alias_info is not None and isinstance(value, torch.Tensor):
                self._every_row.pop(value.untyped_storage().data_ptr(), None)
                self._constants.pop(value.untyped_storage().data_ptr(), None)

    def _made(self, func: Any, name: str, args: tuple, kwargs: dict[str, Any]) -> Any:
        """A tensor that depends on no other: nothing waits for it."""
        if name == "rand" and kwargs.get("device") == self.device and "generator" in kwargs:
            return self._drawn(func, args, kwargs)
        if name == "scalar_tensor" and kwargs.get("device") == self.device:
            result = torch.empty((), dtype=kwargs.get("dtype") or torch.get_default_dtype(), device=self.device)
            self.array(result, is_own=True)
            self._add(filled(self, result, args[0]))
            self._constants[result.data_ptr()] = result.untyped_storage(), args[0]
            return result
        result = func(*args, **kwargs)
        if name == "arange" and result.device == self.device and result.dtype == torch.int64:
            start, step = (args[0], 1) if len(args) > 1 else (0, 1)
            if len(args) < 3 and start == 0 and step == 1 and len(result) == self.rows:
                storage = result.untyped_storage()
                self._every_row[storage.data_ptr()] = storage
        return result

    def _drawn(self, func: Any, args: tuple, kwargs: dict[str, Any]) -> torch.Tensor:
        """A part of a block that was drawn at once, as long as the last time was drawn in all."""
        shape = tuple(args[0])
        wanted, block = math.prod(shape), self._block
        dtype = kwargs.get("dtype") or torch.get_default_dtype()
        if block is None or block.dtype != dtype or len(block) < wanted:
            block = func([max(wanted, self._most_draws - self._draws)], **kwargs)
        self._draws += wanted
        self._block = block[wanted:]
        return block[:wanted].view(shape)

    def _put_off(self, func: Any, name: str, args: tuple, kwargs: dict[str, Any]) -> Any:
        """The result of an operation that is done later; ``None`` where a kernel cannot do it."""
        out = kwargs.pop("out", None)
        target = args[0] if out is None and name.endswith("_") and isinstance(args[0], torch.Tensor) else out
        planned = structured.plan(self, func, name.rstrip("_"), args, kwargs, target)
        if out is not None:
            kwargs["out"] = out
        if planned is None:
            return None
        result, operation = planned
        return result if self._add(operation) else None

    def _add(self, operation: Operation) -> bool:
        """Put an operation off; false where its rows are other rows of its own."""
        if self._overlap(operation):
            self.launch()
            for array, _ in operation.touched:
                array.memory.forget()
                self._memories[array.memory.storage.data_ptr()] = array.memory
            if self._overlap(operation):
                return False
        operation.find_phase()
        self._operations.append(operation)
        return True

    def _overlap(self, operation: Operation) -> bool:
        return any([mode[0] == "rows" and self._overlaps(array, mode) for array, mode in operation.touched])

    def _overlaps(self, array: Array, mode: Mode) -> bool:
        """Whether a row's places in it are other rows' places of an operation before."""
        axis = row_axis(array.shape, self.rows)
        cells = (array.cell(index) for index in elements(array.shape, axis))
        return array.memory.overlaps(int(str(mode[1])), cells, self.rows)


def fusion_for(rows: int, device: torch.device) -> Fusion | None:
    """A fusion for tensors of so many environments; ``None`` where there is no compiler of kernels for the device."""
    if rows < _SMALLEST:
        return None
    if device.type == "cpu":
        host = host_kernels()
        return None if host is None else Fusion(rows, device, host)
    try:
        return Fusion(rows, device, kernels_of(device))
    except (OSError, ValueError):
        return None


def launch_pending() -> None:
    """Do now what is put off: somebody else than torch is about to read or write tensors."""
    for mode in _get_current_dispatch_mode_stack():
        if isinstance(mode, Fusion):
            mode.launch()


def _is_view(returned: Any) -> bool:
    """Whether a result shows an argument's memory, which was not written to."""
    return returned.alias_info is not None and not returned.alias_info.is_write


def _named(schema: Any, kwargs: dict[str, Any]) -> list[tuple[Any, Any]]:
    return [(each, kwargs[each.name]) for each in schema.arguments if each.name in kwargs]


def _flat(values: Any) -> list[Any]:
    result = []
    for value in values:
        result += _flat(value) if isinstance(value, list | tuple) else [value]
    return result


def _to_meta(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device="meta")
    if isinstance(value, dict):
        return {key: _to_meta(each) for key, each in value.items()}
    return type(value)(map(_to_meta, value)) if isinstance(value, list | tuple) else value
