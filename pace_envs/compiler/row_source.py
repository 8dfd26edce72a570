"""Writes the operations of a phase as C, for a GPU or the processor."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from pace_envs.compiler.operations import PRELUDE, TYPES
from pace_envs.compiler.rows import Array, Index, Memory, Mode
from pace_envs.compiler.tape import Names, Node, Tape

SINGLE_WIDTH = 1024
"""Threads of the one block that goes over all rows."""

_HEAD = (
    PRELUDE
    + """
#ifdef __CUDACC__
template <typename T> __device__ T whole(T value, int is_any) {
  __shared__ T parts[32];
  for (int gap = 16; gap; gap /= 2) {
    T other = __shfl_down_sync(0xffffffffu, value, gap);
    value = is_any ? (T)(value || other) : (T)(value + other);
  }
  __syncthreads();
  if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32] = value;
  __syncthreads();
  value = parts[0];
  for (int i = 1; i < blockDim.x / 32; i++) value = is_any ? (T)(value || parts[i]) : (T)(value + parts[i]);
  return value;
}
#define KERNEL extern "C" __global__ void
#define EACH_ROW int r = blockIdx.x * blockDim.x + threadIdx.x; if (r < rows)
#define ALL_ROWS for (int r = threadIdx.x; r < rows; r += blockDim.x)
#define ONCE __syncthreads(); if (threadIdx.x == 0)
#else
template <typename T> static T whole(T value, int is_any) { return value; }
#define KERNEL extern "C" void
#define EACH_ROW for (int r = 0; r < rows; r++)
#define ALL_ROWS for (int r = 0; r < rows; r++)
#define ONCE
#endif
"""
)


class Writer:
    """The kernel of a phase."""

    def __init__(self) -> None:
        """Begin."""
        self.tape = Tape()
        self._totals: list[tuple[str, str, int]] = []  # declaration, name, whether it is one of truths
        self._over_rows: list[str] = []
        self._known: dict[tuple[Memory, int, int, torch.dtype], Node] = {}
        self._changed: dict[tuple[Memory, int, int, torch.dtype], Node] = {}
        self._pointers: dict[tuple[Memory, torch.dtype], tuple[int, int]] = {}

    # ------------------------------------------------------------------ for operations

    def load(self, array: Array, index: Index, axis: int | None) -> Node:
        """The value of an element."""
        stride, cell = array.row_stride(axis), array.cell(index)
        key = array.memory, stride, cell, array.dtype
        if key not in self._known:
            self._known[key] = self.tape.new(self._place(array, cell, stride), kind=TYPES[array.dtype])
        return self._known[key]

    def store(self, array: Array, index: Index, axis: int | None, value: Node) -> None:
        """Keep an element's value; it goes to memory at the end."""
        key = array.memory, array.row_stride(axis), array.cell(index), array.dtype
        self._known[key] = self._changed[key] = value

    def load_at(self, array: Array, cell: int, stride: int, number: Node, step: int) -> Node:
        """The value of an element that is so many steps from a row's cell."""
        self._spill(array.memory)
        return self.tape.new(self._place(array, cell, stride, step), number, kind=TYPES[array.dtype])

    def store_at(self, array: Array, cell: int, stride: int, number: Node, step: int, value: Node) -> None:
        """Write an element that is so many steps from a row's cell."""
        self._spill(array.memory)
        self.tape.new(f"{self._place(array, cell, stride, step)} = {{1}}", number, value, kind="")
        self._known = {key: node for key, node in self._known.items() if key[0] is not array.memory}

    def reduce(self, kind: str, array: Array, cells: Sequence[int], stride: int, step: str) -> Node:
        """A number that is made of all rows' elements; ``step`` takes ``{0}``, what there is, and ``{1}``, the next."""
        name = f"a{len(self._totals)}"
        self._totals.append((f"{kind} {name} = ({kind})0;", f"{name} = whole<{kind}>({name}", int("||" in step)))
        self._over_rows += [f"{name} = {step.format(name, self._place(array, cell, stride))};" for cell in cells]
        return self.tape.new(name, kind=kind)

    # ------------------------------------------------------------------ the whole

    def source(self, phase: int) -> str:
        """The kernel's text."""
        for memory in dict.fromkeys(key[0] for key in self._changed):
            if memory.is_wanted or memory.last_phase > phase:
                self._spill(memory)
        names = Names(self.tape.nodes)
        pointers = "".join(f", {TYPES[dtype]}* p{i}" for (_, dtype), (i, _) in self._pointers.items())
        body = "\n    ".join(names.line(node) for node in self.tape.nodes if node.operation != "constant")
        if phase % 2 == 0:
            inside = f"EACH_ROW {{\n    {body}\n  }}"
        else:
            rows = ["ALL_ROWS {\n    " + "\n    ".join(self._over_rows) + "\n  }"] if self._over_rows else []
            first, last = [each for each, *_ in self._totals], [f"{end}, {is_any});" for _, end, is_any in self._totals]
            inside = "\n  ".join([*first, *rows, *last, f"ONCE {{\n    {body}\n  }}"])
        return f"{_HEAD}KERNEL simulate(int rows{pointers}) {{\n  {inside}\n}}\n"

    def arguments(self) -> list[Any]:
        """Where the pointers go to."""
        return [
            ctypes.c_void_p(memory.storage.data_ptr() + first * dtype.itemsize)
            for (memory, dtype), (_, first) in self._pointers.items()
        ]

    # ------------------------------------------------------------------ inside

    def _place(self, array: Array, cell: int, stride: int, step: int | None = None) -> str:
        number, first = self._pointers.setdefault((array.memory, array.dtype), (len(self._pointers), cell))
        row = f" + (long long)r * {stride}" if stride else ""
        return f"p{number}[{cell - first}{row}{'' if step is None else f' + {{0}} * {step}'}]"

    def _spill(self, memory: Memory) -> None:
        """Write to memory what has changed."""
        for key in [key for key in self._changed if key[0] is memory]:
            _, stride, cell, dtype = key
            place = self._place(Array(memory, dtype, (), (), 0), cell, stride)
            self.tape.new(f"{place} = {{0}}", self._changed.pop(key), kind="")


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


def kernels(operations: Sequence[Operation]) -> list[tuple[int, str, list[Any]]]:
    """Phase, text and arguments of each kernel, in order."""
    result = []
    for phase in sorted({operation.phase for operation in operations}):
        writer = Writer()
        for operation in operations:
            if operation.phase == phase:
                operation.emit(writer)
        source = writer.source(phase)
        if arguments := writer.arguments():  # else nothing of it is wanted
            result.append((phase, source, arguments))
    return result
