"""What a kernel is launched with."""

from __future__ import annotations

import ctypes

import torch

Argument = int | torch.Tensor | ctypes.c_void_p


def as_argument(value: Argument) -> ctypes.c_void_p | ctypes.c_int:
    """Tensors are handed over by address, whole numbers by value."""
    if isinstance(value, torch.Tensor):
        return ctypes.c_void_p(value.data_ptr())
    return ctypes.c_int(value) if isinstance(value, int) else value
