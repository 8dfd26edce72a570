"""Copies of several tensors by one kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_envs.kernels.nvrtc import kernels_of

_ALIGNED, _WIDTH, _MOST_BLOCKS = 16, 256, 1024
"""Bytes that a thread copies at once, threads of a block, and blocks at most."""


class Copies:
    """Copies tensors that stay where they are, again and again, into memory of their own each time."""

    def __init__(self, tensors: Sequence[torch.Tensor]):
        """Write the kernel.

        Args:
            tensors: Contiguous ones on one GPU.
        """
        self._tensors = [tensor for tensor in tensors if tensor.numel()]
        self._every = list(tensors)
        sizes = [tensor.numel() * tensor.element_size() for tensor in self._tensors]
        self._begins, self._size = [], 0
        for size in sizes:
            self._begins.append(self._size)
            self._size += -(-size // _ALIGNED) * _ALIGNED
        lines = []
        for i, (tensor, size, begin) in enumerate(zip(self._tensors, sizes, self._begins, strict=True)):
            whole = size // _ALIGNED if tensor.data_ptr() % _ALIGNED == 0 else 0
            lines += [
                f"for (int i = first; i < {whole}; i += step) ((int4*)(to + {begin}))[i] = ((const int4*)p{i})[i];",
                f"for (int i = first + {whole * _ALIGNED}; i < {size}; i += step) to[{begin} + i] = p{i}[i];",
            ]
        pointers = "".join(f", const char* p{i}" for i in range(len(self._tensors)))
        first = "const int first = blockIdx.x * blockDim.x + threadIdx.x, step = gridDim.x * blockDim.x;"
        body = "\n  ".join([first, *lines])
        self._source = f'extern "C" __global__ void simulate(char* to{pointers}) {{\n  {body}\n}}\n'
        self._threads = min(_MOST_BLOCKS * _WIDTH, max(_WIDTH, self._size // _ALIGNED))

    def __call__(self) -> list[torch.Tensor]:
        """The copies."""
        if not self._tensors:
            return [tensor.clone() for tensor in self._every]
        device = self._tensors[0].device
        to = torch.empty(self._size, dtype=torch.uint8, device=device)
        kernels = kernels_of(device)
        kernels.compile([self._source])
        kernels.launch(self._source, self._threads, _WIDTH, [to, *self._tensors])
        parts = iter(
            to[begin : begin + tensor.numel() * tensor.element_size()].view(tensor.dtype).view(tensor.shape)
            for tensor, begin in zip(self._tensors, self._begins, strict=True)
        )
        return [next(parts) if tensor.numel() else tensor.clone() for tensor in self._every]
