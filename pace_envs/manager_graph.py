"""What follows the physics in a step, replayed from one CUDA graph."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager
from typing import Any

import torch

from pace_envs.fused import Fusion

_RUNS_BEFORE = 2
"""Runs before a capture: constants are copied to the GPU, every tensor has found its place, kernels are compiled."""


class ManagerGraph:
    """Replays a function that returns tensors, and keeps all else that it changes in place.

    A CUDA graph repeats kernels on fixed addresses. What the function reads of Python is handed over as a key: another
    key, another capture.
    """

    def __init__(
        self, function: Callable[[], dict[str, torch.Tensor]], generator: torch.Generator, fusion: Fusion | None
    ):
        """Keep the function.

        Args:
            function: Queues kernels on torch's current stream, and never waits for them.
            generator: Where it draws random numbers from.
            fusion: Makes few kernels of it; ``None`` leaves it as it is.
        """
        self._function = function
        self._fused: AbstractContextManager[Any] = contextlib.nullcontext() if fusion is None else fusion
        self._generator = generator
        self._results: dict[str, torch.Tensor] = {}
        self.clear()

    def clear(self) -> None:
        """Forget the graph: the function was called by somebody else."""
        self._key: Hashable = None
        self._runs = 0
        self._graph: torch.cuda.CUDAGraph | None = None

    @property
    def is_captured(self) -> bool:
        """Whether the next call with the same key is replayed."""
        return self._graph is not None

    @torch.inference_mode(False)
    @torch.no_grad()
    def __call__(self, key: Hashable) -> dict[str, torch.Tensor]:
        """Do what the function does; returns tensors of the caller's own.

        Args:
            key: All that the function reads and that is no tensor's content: numbers, flags, places of tensors.
        """
        if key != self._key:
            self._key, self._runs, self._graph = key, 0, None
        if self._graph is None and self._runs < _RUNS_BEFORE:
            self._runs += 1
            with self._fused:
                return self._function()
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            self._graph.register_generator_state(self._generator)
            with torch.cuda.graph(self._graph, capture_error_mode="relaxed"), self._fused:
                self._results = self._function()
        self._graph.replay()
        return self._copies()

    def _copies(self) -> dict[str, torch.Tensor]:
        """The results in memory of their own, by one kernel for each type."""
        copies = {name: torch.empty_like(value) for name, value in self._results.items()}
        for dtype in {value.dtype for value in copies.values()}:
            names = [name for name, value in copies.items() if value.dtype == dtype]
            torch._foreach_copy_([copies[name] for name in names], [self._results[name] for name in names])
        return copies
