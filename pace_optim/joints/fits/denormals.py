"""Denormal numbers taken for zeros while something runs: states that decay to nothing make them, and they are slow."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Take denormal numbers for zeros meanwhile, in this thread and in processes forked from it.

    The processor's setting is put back at the end: it belongs to the whole program, NumPy's and Python's numbers too.
    """
    before = _flushes()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def _flushes() -> bool:
    """Whether denormal numbers are zeros now."""
    smallest_normal = sys.float_info.min
    return smallest_normal / 2 == 0.0
