"""Puts operations off while a function runs, and does those that belong together in one kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import _get_current_dispatch_mode_stack

from pace_envs.compiler.host import host_kernels
from pace_envs.compiler.nvrtc import Compiler, kernels_of
from pace_envs.compiler.row_operations import on_elements, plan
from pace_envs.compiler.row_source import SINGLE_WIDTH, Operation, kernels
from pace_envs.compiler.rows import Array, Mode, RowSpace, elements
from pace_envs.compiler.tape import Tracer, tensors_in

_ROW_WIDTH = 32
"""Threads of a block that has one for each row: few rows spread over the GPU."""
_SMALLEST = 2
"""Fewer rows than these: an axis of rows cannot be separated from a broadcast one."""


class Fusion(Tracer):
    """While it is entered, operations of torch on tensors of all environments are put off and done in few kernels.

    An operation that a kernel cannot do is done by torch, after all that were put off; so is what leaves the device.
    What is drawn comes from the same generator, in one piece where it is known how much is drawn: other numbers than
    without it, of the same distribution, that repeat with the seed.
    """

    def __init__(self, rows: int, device: torch.device, compiler: Compiler):
        """Prepare."""
        super().__init__()
        self._space, self._compiler = RowSpace(rows, device), compiler
        self._operations: list[Operation] = []
        self.launched = 0
        """Compiled kernels that have been launched."""
        self.left = list[str]()
        """Operations that were left to torch since it was entered last."""
        self._draws = 0
        self._block: torch.Tensor | None = None

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
            self._block, self._operations = None, []
            self._space.forget_all()
            super().__exit__(kind, value, trace)

    def launch(self) -> None:
        """Do now what was put off."""
        if not self._operations:
            return
        parts = kernels(self._operations)
        self._compiler.compile([source for _, source, _ in parts])
        for phase, source, arguments in parts:
            threads, width = (SINGLE_WIDTH, SINGLE_WIDTH) if phase % 2 else (self._space.rows, _ROW_WIDTH)
            self._compiler.launch(source, threads, width, [self._space.rows, *arguments])
        self.launched += len(parts)
        self._operations, self._space.memories = [], {}

    # ------------------------------------------------------------------ what torch asks

    def will_change(self, changed: Sequence[torch.Tensor]) -> None:
        """Indices of all rows that are written to are so no more, nor are numbers those that were put there."""
        for tensor in tensors_in(changed):
            self._space.forget(tensor)

    def knows(self, tensors: Sequence[torch.Tensor]) -> bool:
        """Whether all are on the device, or are numbers."""
        return all(each.device == self._space.device or each.ndim == 0 for each in tensors)

    def left_to_torch(self, func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        """After all that was put off."""
        self.left.append(str(func))
        self.launch()
        return func(*args, **kwargs)

    def made(self, func: Any, name: str, args: tuple, kwargs: dict[str, Any]) -> Any:
        """A tensor that depends on no other: nothing waits for it."""
        if name == "rand" and kwargs.get("device") == self._space.device and "generator" in kwargs:
            return self._drawn(func, args, kwargs)
        if name == "scalar_tensor" and kwargs.get("device") == self._space.device:
            dtype = kwargs.get("dtype") or torch.get_default_dtype()
            result = torch.empty((), dtype=dtype, device=self._space.device)
            self._space.array(result, is_own=True)
            filled = on_elements(self._space, "fill", [result, args[0]], {}, result)
            assert filled is not None
            self._add(filled[1])
            self._space.note_constant(result, args[0])
            return result
        result = func(*args, **kwargs)
        is_every_row = name == "arange" and len(args) < 3 and (len(args) == 1 or args[0] == 0)
        like = torch.int64, self._space.device, self._space.rows
        if is_every_row and (result.dtype, result.device, len(result)) == like:
            self._space.note_every_row(result)
        return result

    def noted(self, func: Any, name: str, args: tuple, kwargs: dict, target: Any, tensors: list[torch.Tensor]) -> Any:
        """The result of an operation that is done later; ``None`` where a kernel cannot do it."""
        planned = plan(self._space, func, name, args, kwargs, target)
        if planned is None:
            return None
        result, operation = planned
        return result if self._add(operation) else None

    # ------------------------------------------------------------------ inside

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

    def _add(self, operation: Operation) -> bool:
        """Defer an operation; false if it reads other rows than those that it writes."""
        if self._overlap(operation):
            self.launch()
            for array, _ in operation.touched:
                array.memory.forget()
                self._space.memories[array.memory.storage.data_ptr()] = array.memory
            if self._overlap(operation):
                return False
        operation.find_phase()
        self._operations.append(operation)
        return True

    def _overlap(self, operation: Operation) -> bool:
        return any([mode[0] == "rows" and self._overlaps(array, mode) for array, mode in operation.touched])

    def _overlaps(self, array: Array, mode: Mode) -> bool:
        """Whether a row's places in it are other rows' places of an operation before."""
        axis = self._space.axis(array)
        cells = (array.cell(index) for index in elements(array.shape, axis))
        return array.memory.overlaps(int(str(mode[1])), cells, self._space.rows)


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
    """Run the deferred operations now: code outside torch is about to read or write tensors."""
    for mode in _get_current_dispatch_mode_stack():
        if isinstance(mode, Fusion):
            mode.launch()
