"""Writes the operations of a phase as C, for a GPU or the processor."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch

from pace_envs.fused.memory import Array, Index, Memory, Operation
from pace_envs.kernels.expressions import PRELUDE

TYPES = {
    torch.float32: "float",
    torch.float64: "double",
    torch.bool: "bool",
    torch.int64: "long long",
    torch.int32: "int",
    torch.uint8: "unsigned char",
}
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
        self._lines: list[str] = []
        self._first: list[str] = []
        self._over_rows: list[str] = []
        self._after_rows: list[str] = []
        self._count = 0
        self._known: dict[tuple[Memory, int, int, torch.dtype], str] = {}
        self._changed: dict[tuple[Memory, int, int, torch.dtype], str] = {}
        self._pointers: dict[tuple[Memory, torch.dtype], tuple[int, int]] = {}

    # ------------------------------------------------------------------ for operations

    def value(self, kind: str, expression: str) -> str:
        """A name for a value."""
        name = self._name()
        self._lines.append(f"const {kind} {name} = {expression};")
        return name

    def load(self, array: Array, index: Index, axis: int | None) -> str:
        """The value of an element."""
        stride, cell = array.row_stride(axis), array.cell(index)
        key = array.memory, stride, cell, array.dtype
        if key not in self._known:
            self._known[key] = self.value(TYPES[array.dtype], self._place(array, cell, stride))
        return self._known[key]

    def store(self, array: Array, index: Index, axis: int | None, value: str) -> None:
        """Keep an element's value; it goes to memory at the end."""
        key = array.memory, array.row_stride(axis), array.cell(index), array.dtype
        self._known[key] = self._changed[key] = value

    def load_at(self, array: Array, place: str, cell: int) -> str:
        """The value of an element whose place is computed, beside a row's place."""
        self._spill(array.memory)
        return self.value(TYPES[array.dtype], self._place(array, cell, 0, place))

    def store_at(self, array: Array, place: str, cell: int, value: str) -> None:
        """Write an element whose place is computed."""
        self._spill(array.memory)
        self._lines.append(f"{self._place(array, cell, 0, place)} = {value};")
        self._known = {key: name for key, name in self._known.items() if key[0] is not array.memory}

    def reduce(self, kind: str, start: str, array: Array, cells: Sequence[int], stride: int, step: str) -> str:
        """A number that is made of all rows' elements; ``step`` takes ``{0}``, what there is, and ``{1}``, the next."""
        name = self._name()
        self._first.append(f"{kind} {name} = {start};")
        for cell in cells:
            self._over_rows.append(f"{name} = {step.format(name, self._place(array, cell, stride))};")
        self._after_rows.append(f"{name} = whole<{kind}>({name}, {int('||' in step)});")
        return name

    # ------------------------------------------------------------------ the whole

    def source(self, phase: int) -> str:
        """The kernel's text."""
        for memory in dict.fromkeys(key[0] for key in self._changed):
            if memory.is_wanted or memory.last_phase > phase:
                self._spill(memory)
        pointers = "".join(f", {TYPES[dtype]}* p{i}" for (_, dtype), (i, _) in self._pointers.items())
        body = "\n    ".join(self._lines)
        if phase % 2 == 0:
            inside = f"  EACH_ROW {{\n    {body}\n  }}"
        else:
            parts = [*self._first]
            if self._over_rows:
                parts.append("ALL_ROWS {\n    " + "\n    ".join(self._over_rows) + "\n  }")
            inside = "  " + "\n  ".join([*parts, *self._after_rows, f"ONCE {{\n    {body}\n  }}"])
        return f"{_HEAD}KERNEL simulate(int rows{pointers}) {{\n{inside}\n}}\n"

    def arguments(self) -> list[Any]:
        """Where the pointers go to."""
        return [
            ctypes.c_void_p(memory.storage.data_ptr() + first * dtype.itemsize)
            for (memory, dtype), (_, first) in self._pointers.items()
        ]

    # ------------------------------------------------------------------ inside

    def _name(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def _place(self, array: Array, cell: int, stride: int, more: str = "") -> str:
        number, first = self._pointers.setdefault((array.memory, array.dtype), (len(self._pointers), cell))
        row = f" + (long long)r * {stride}" if stride else ""
        return f"p{number}[{cell - first}{row}{more and f' + {more}'}]"

    def _spill(self, memory: Memory) -> None:
        """Write to memory what has changed."""
        for key in [key for key in self._changed if key[0] is memory]:
            _, stride, cell, dtype = key
            array = Array(memory, dtype, (), (), 0)
            self._lines.append(f"{self._place(array, cell, stride)} = {self._changed.pop(key)};")


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
