"""What operations read and write, and in which order they may be done."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch

Mode = tuple[object, ...]
"""How an operation goes through memory: one place per row, with its stride, or the same for all rows."""
Index = tuple[int, ...]


class Memory:
    """A tensor's memory while operations on it are put off."""

    def __init__(self, storage: torch.UntypedStorage, is_own: bool):
        """Hold the memory, so that it is not reused meanwhile.

        Args:
            is_own: Whether it belongs to a deferred result, which no other tensor shares.
        """
        self.storage, self.is_own = storage, is_own
        self.written: tuple[int, Mode] | None
        self.read: dict[Mode, int]
        self._cells: dict[tuple[int, int], int]
        self.forget()

    def forget(self) -> None:
        """All that touched it is done."""
        self.written, self.read, self._cells = None, {}, {}

    @property
    def is_wanted(self) -> bool:
        """Whether a tensor still shows it."""
        return not self.is_own or torch._C._storage_Use_Count(self.storage._cdata) > 1  # type: ignore[attr-defined]

    @property
    def last_phase(self) -> int:
        """The last phase that touches it."""
        return max([*self.read.values(), -1 if self.written is None else self.written[0]])

    def earliest(self, mode: Mode, writes: bool) -> int:
        """The first phase in which it may be touched."""
        first = 0
        others = [] if self.written is None else [self.written]
        if writes:
            others += [(phase, other) for other, phase in self.read.items()]
        for phase, other in others:
            first = max(first, phase if other == mode else phase + 1)
        return first

    def note(self, mode: Mode, writes: bool, phase: int) -> None:
        """Remember that an operation of a phase touches it."""
        if writes:
            self.written = phase, mode
        else:
            self.read[mode] = max(phase, self.read.get(mode, 0))

    def overlaps(self, stride: int, cells: Iterator[int], rows: int) -> bool:
        """Whether a row's places are another row's places of an operation before."""
        for cell in cells:
            other = self._cells.setdefault((stride, cell % stride), cell)
            if other != cell and abs(other - cell) // stride < rows:
                return True
        return False


@dataclass(frozen=True)
class Array:
    """A tensor as operations see it; strides and offset in elements."""

    memory: Memory
    dtype: torch.dtype
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: int

    def cell(self, index: Index) -> int:
        """Place of an element; ``index`` is aligned at the right, and an axis of length 1 is spread."""
        pairs = zip(reversed(index), reversed(self.shape), reversed(self.strides), strict=False)
        return self.offset + sum(i * stride for i, size, stride in pairs if size != 1)

    def row_stride(self, axis: int | None) -> int:
        """From row to row along an axis counted from the right; 0 where all rows have the same."""
        if axis is None or -axis > len(self.shape) or self.shape[axis] == 1:
            return 0
        return self.strides[axis]

    def mode(self, axis: int | None) -> Mode:
        """How it is gone through."""
        stride = self.row_stride(axis)
        return ("rows", stride, self.dtype) if stride else ("shared", self.dtype)


class RowSpace:
    """The tensors of all rows on a device, while operations on them are put off."""

    def __init__(self, rows: int, device: torch.device):
        """Know none."""
        self.rows, self.device = rows, device
        self.memories: dict[int, Memory] = {}
        self._every_row: dict[int, torch.UntypedStorage] = {}
        self._constants: dict[int, tuple[torch.UntypedStorage, float]] = {}

    def array(self, tensor: torch.Tensor, is_own: bool = False) -> Array:
        """A tensor as kernels see it."""
        storage = tensor.untyped_storage()
        key = storage.data_ptr()  # the same memory may have been handed to torch more than once
        if key not in self.memories:
            self.memories[key] = Memory(storage, is_own)
        return Array(
            self.memories[key], tensor.dtype, tuple(tensor.shape), tensor.stride(), int(tensor.storage_offset())
        )

    def count(self, tensor: torch.Tensor) -> int:
        """Elements of a row."""
        return tensor.numel() if self.axis(tensor) is None else tensor.numel() // self.rows

    def axis(self, tensor: torch.Tensor | Array) -> int | None:
        """The axis with one entry per row, counted from the right; ``None`` without such an axis."""
        shape = tensor.shape
        return next((i - len(shape) for i, size in enumerate(shape) if size == self.rows), None)

    def note_every_row(self, index: torch.Tensor) -> None:
        """These are the indices of all rows, in order."""
        storage = index.untyped_storage()
        self._every_row[storage.data_ptr()] = storage

    def is_every_row(self, index: Any) -> bool:
        """Whether indices are those of all rows, in order."""
        return (
            isinstance(index, torch.Tensor)
            and index.numel() == self.rows
            and index.untyped_storage().data_ptr() in self._every_row
        )

    def note_constant(self, tensor: torch.Tensor, value: float) -> None:
        """A tensor without dimensions is made of a number."""
        self._constants[tensor.data_ptr()] = tensor.untyped_storage(), value

    def constant(self, tensor: torch.Tensor) -> float | None:
        """The number that a tensor without dimensions was made of; ``None`` where that is not known."""
        known = self._constants.get(tensor.untyped_storage().data_ptr()) if tensor.ndim == 0 else None
        return None if known is None else known[1]

    def forget(self, tensor: torch.Tensor) -> None:
        """It is written to: it is no more what it was."""
        self._every_row.pop(tensor.untyped_storage().data_ptr(), None)
        self._constants.pop(tensor.untyped_storage().data_ptr(), None)

    def forget_all(self) -> None:
        """All is done."""
        self.memories, self._every_row, self._constants = {}, {}, {}


def elements(shape: tuple[int, ...], axis: int | None) -> Iterator[Index]:
    """All indices of a row (0 along its axis)."""
    skipped = None if axis is None else len(shape) + axis
    return product(*(range(1 if i == skipped else size) for i, size in enumerate(shape)))
