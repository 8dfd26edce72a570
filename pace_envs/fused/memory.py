"""What operations read and write, and in which order they may be done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from pace_envs.fused.writer import Writer

Mode = tuple[object, ...]
"""How an operation goes through memory: one place per row, with its stride, or the same for all rows."""
Index = tuple[int, ...]


class Memory:
    """A tensor's memory while operations on it are put off."""

    def __init__(self, storage: torch.UntypedStorage, is_own: bool):
        """Hold the memory, so that it is not reused meanwhile.

        Args:
            storage: The memory.
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


@dataclass
class Operation:
    """Something to do in a kernel."""

    is_single: bool
    """Whether it is done once, and not for each row."""
    emit: Callable[[Writer], None]
    """Writes it."""
    reads: list[tuple[Array, Mode]]
    writes: list[tuple[Array, Mode]]
    phase: int = field(default=0)

    @property
    def touched(self) -> list[tuple[Array, Mode]]:
        """What it reads and writes."""
        return [*self.reads, *self.writes]

    def find_phase(self) -> None:
        """The first phase after all that it depends on: even phases have a thread for each row, odd ones are single."""
        phase = 0
        for array, mode in self.reads:
            phase = max(phase, array.memory.earliest(mode, writes=False))
        for array, mode in self.writes:
            phase = max(phase, array.memory.earliest(mode, writes=True))
        self.phase = phase + (phase % 2 != self.is_single)
        for array, mode in self.reads:
            array.memory.note(mode, False, self.phase)
        for array, mode in self.writes:
            array.memory.note(mode, True, self.phase)


def row_axis(shape: tuple[int, ...], rows: int) -> int | None:
    """The axis that has a place for each row, counted from the right; ``None`` where there is none."""
    return next((i - len(shape) for i, size in enumerate(shape) if size == rows), None)


def elements(shape: tuple[int, ...], axis: int | None) -> Iterator[Index]:
    """All indices of a row (0 along its axis)."""
    skipped = None if axis is None else len(shape) + axis
    return product(*(range(1 if i == skipped else size) for i, size in enumerate(shape)))


def count(shape: tuple[int, ...], axis: int | None) -> int:
    """How many of them there are."""
    result = 1
    for i, size in enumerate(shape):
        result *= 1 if axis is not None and i == len(shape) + axis else size
    return result
