"""A function of an environment, replayed from one CUDA graph."""

from __future__ import annotations

import contextlib
import gc
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch

from pace_envs.compiler.fusion import Fusion
from pace_envs.compiler.nvrtc import kernels_of

_RUNS_BEFORE = 3
"""Runs before a capture: constants are copied to the GPU, every tensor has found its place, kernels are compiled."""
Place = tuple[int, str]
_PLAIN = (type(None), bool, int, float, str, set, frozenset)

_ALIGNED, _WIDTH, _MOST_BLOCKS = 16, 256, 1024
"""Bytes that a thread copies at once, threads of a block, and blocks at most."""


class StepGraph:
    """Replays a function that returns tensors, and keeps all else that it changes where it was.

    A CUDA graph repeats kernels on fixed addresses. The function may assign new tensors to attributes: :class:`Homes`
    copies them to where the old ones were. What it reads of Python is a key: another key, another capture. Numbers,
    flags and names that it changes are those of the capture after each replay. A function that waits for the GPU runs
    without a graph.
    """

    def __init__(
        self,
        function: Callable[[], dict[str, torch.Tensor]],
        homes: Homes,
        generator: torch.Generator,
        fusion: Fusion | None,
    ):
        """Keep the function.

        Args:
            function: Queues kernels on torch's current stream, and never waits for them.
            homes: Places of the tensors that it may replace.
            generator: Where it draws random numbers from.
            fusion: Makes few kernels of it; ``None`` leaves it as it is.
        """
        self._function = function
        self._homes = homes
        self._generator = generator
        self._fused: AbstractContextManager[Any] = contextlib.nullcontext() if fusion is None else fusion
        self._names: list[str] = []
        self._copies = Copies([])
        self._key: Hashable = None
        self._runs = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._changes: list[tuple[dict[str, Any], str, Any]] = []
        self.is_refused = False
        """Whether it waits for the GPU and is not captured."""

    @property
    def is_captured(self) -> bool:
        """Whether the next call with the same key is replayed."""
        return self._graph is not None

    @torch.inference_mode(False)
    @torch.no_grad()
    def __call__(self, key: Hashable) -> dict[str, torch.Tensor]:
        """Do what the function does; returns tensors of the caller's own.

        Args:
            key: What the function reads of Python beside the attributes of the objects.
        """
        if self.is_refused:
            return self._function()
        now = key, self._homes.key()
        if now != self._key:
            self._key, self._runs, self._graph = now, 0, None
        if self._graph is None and self._runs < _RUNS_BEFORE:
            self._runs += 1
            with _waits(self._runs == _RUNS_BEFORE) as waits, self._fused:
                results = self._function()
                self._homes.settle()
            if waits:
                self._refuse()
            return results
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            self._graph.register_generator_state(self._generator)
            with _no_collection(), torch.cuda.graph(self._graph, capture_error_mode="relaxed"), self._fused:
                results = {name: value.contiguous() for name, value in self._function().items()}
                self._homes.settle()
            self._names, self._copies = list(results), Copies(list(results.values()))
            self._changes = self._homes.changes()
        self._graph.replay()
        for holder, name, value in self._changes:
            _set(holder, name, value)
        return dict(zip(self._names, self._copies(), strict=True))

    def _refuse(self) -> None:
        self.is_refused = True
        warnings.warn(
            "A step of the environment waits for the GPU. So it is not replayed from a CUDA graph, and takes longer. "
            "Write the task's terms without .item(), .nonzero() and branches over a tensor's values. [W26]",
            stacklevel=3,
        )


class Homes:
    """Keeps the tensors that objects have as attributes, or in dictionaries that are attributes, at fixed places."""

    def __init__(self, parts: Sequence[object], owner: object | None = None):
        """Look at objects.

        Args:
            parts: Of these, all that can be compared is in :meth:`key`.
            owner: Of this one the tensors alone; ``None`` for none.
        """
        self._parts, self._owner = list(parts), owner
        self._homes: dict[Place, torch.Tensor] = {}
        self._seen: dict[Place, Any] = {}
        self._ids: tuple = ()
        self._key: tuple = ()

    def key(self) -> Hashable:
        """Bring the tensors to their places; returns what changes where a graph on them is of no use any more."""
        if self._fingerprint() == self._ids:
            return self._key
        self._move(self._homes)
        self._seen = {
            (id(holder), name): value if isinstance(value, torch.Tensor) else _comparable(value)
            for holder, name, value in self._attributes()
        }
        self._ids = self._fingerprint()
        self._key = tuple((*place, _comparable(value)) for place, value in self._seen.items())
        return self._key

    def settle(self) -> None:
        """Bring the tensors to their places that were replaced since :meth:`key`; each gets one that nothing shares."""
        self._move({**self._seen, **self._homes})

    def changes(self) -> list[tuple[dict[str, Any], str, Any]]:
        """All else that was changed since :meth:`key`, as it is now."""
        now = [(holder, name, _comparable(value)) for holder, name, value in self._attributes()]
        return [
            (holder, name, value)
            for holder, name, value in now
            if not isinstance(holder[name], torch.Tensor) and self._seen.get((id(holder), name), value) != value
        ]

    def _move(self, places: Mapping[Place, Any]) -> None:
        moved = []
        for holder, name, value in self._attributes():
            place = id(holder), name
            old = places.get(place)
            if not isinstance(value, torch.Tensor) or not isinstance(old, torch.Tensor) or old is value:
                continue
            if _is_same(old, value):
                holder[name] = old
            else:
                moved.append((holder, name, value, self._homes.get(place)))
        targets = {home.untyped_storage().data_ptr() for *_, home in moved if home is not None}
        fits = [home is not None and home.shape == value.shape for *_, value, home in moved]
        copies = [
            value if fit and value.untyped_storage().data_ptr() not in targets else value.clone()
            for (*_, value, _), fit in zip(moved, fits, strict=True)
        ]
        for (holder, name, _, home), copy, fit in zip(moved, copies, fits, strict=True):
            holder[name] = home.copy_(copy) if fit and home is not None else copy
            self._homes[id(holder), name] = holder[name]

    def _attributes(self) -> Iterator[tuple[dict[str, Any], str, Any]]:
        """Tensors, and of the parts numbers, flags, names and sets of them."""
        for part in (*self._parts, *([] if self._owner is None else [self._owner])):
            for name, value in list(vars(part).items()):
                if isinstance(value, torch.Tensor) or (part is not self._owner and isinstance(value, _PLAIN)):
                    yield vars(part), name, value
                elif isinstance(value, dict) and part is not self._owner:
                    yield from ((value, key, each) for key, each in value.items() if isinstance(each, torch.Tensor))

    def _fingerprint(self) -> tuple:
        """Changes with the key, and is found faster."""
        return tuple(frozenset(value) if type(value) is set else id(value) for *_, value in self._attributes())


def _comparable(value: Any) -> Hashable:
    return id(value) if isinstance(value, torch.Tensor) else frozenset(value) if isinstance(value, set) else value


def _set(holder: dict[str, Any], name: str, value: Any) -> None:
    if isinstance(holder[name], set):
        holder[name].clear()
        holder[name].update(value)
    else:
        holder[name] = value


def _is_same(a: torch.Tensor, b: torch.Tensor) -> bool:
    """Whether two tensors show the same memory."""
    return a.data_ptr() == b.data_ptr() and a.shape == b.shape and a.stride() == b.stride() and a.dtype == b.dtype


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Python collects no garbage meanwhile: a capture ends where memory of the GPU is given back."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@contextlib.contextmanager
def _waits(wanted: bool) -> Iterator[list[str]]:
    """Notes what lets torch wait for the GPU, where that is wanted."""
    found: list[str] = []
    if not wanted:
        yield found
        return
    mode = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch calls the mode a prototype
        torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield found
    finally:
        torch.cuda.set_sync_debug_mode(mode)
    for each in caught:
        if "synchronizing CUDA operation" in str(each.message):
            found.append(str(each.message))
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)


class Copies:
    """Copies tensors that keep their addresses, again and again, each time into new memory."""

    def __init__(self, tensors: Sequence[torch.Tensor]):
        """Write the kernel."""
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
