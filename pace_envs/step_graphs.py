"""CUDA graphs of a function with Python state: one for each state that it is in, replayed in the order it takes."""

from __future__ import annotations

import contextlib
import types
from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch

from pace_actuators import PaceDCMotor
from pace_actuators.effects import Effect
from pace_envs.fused import Fusion

_ROOTS = ("pace_actuators", "pace_envs")
Key = tuple[tuple[str, Hashable], ...]


class StepGraphs:
    """Replays a function from CUDA graphs that were captured of it.

    A CUDA graph repeats kernels on fixed addresses; the function may assign new tensors to attributes, count and branch
    in Python. So its state is found on the objects that it belongs to: their tensors, and everything else that can be
    compared (numbers, flags, names). For each state of the latter there is a graph of its own, captured when the state
    comes for the second time (the first time runs as it is, which loads what is loaded once), and each graph knows in
    which state it ends. A tensor that the function replaces is copied back to where it was.

    What the function reads and is not on these objects must stay where it is; whoever replaces it calls :meth:`clear`.
    """

    def __init__(
        self, function: Callable[[], None], owners: Sequence[object], device: torch.device, fusion: Fusion | None = None
    ):
        """Keep the function.

        Args:
            function: Queues kernels on torch's current stream, and never waits for them.
            owners: Objects whose attributes it reads and changes, with all that they hold.
            device: The GPU.
            fusion: Makes few kernels of it; ``None`` leaves it as it is.
        """
        self._fused: AbstractContextManager[Any] = contextlib.nullcontext() if fusion is None else fusion
        self._function = function
        self._owners = list(owners)
        self._device = device
        self.clear()

    def clear(self) -> None:
        """Forget the graphs."""
        self._graphs: dict[Key, _Graph | None] = {}
        self._seen: set[Key] = set()
        self._own: set[str] = set()
        self._home: dict[str, torch.Tensor] = {}
        self._objects: dict[int, object] = {}
        self._key: Key = ()
        self._expected: tuple = ()
        self._pool: Any = None

    @property
    def num_graphs(self) -> int:
        """How many graphs there are."""
        return sum(graph is not None for graph in self._graphs.values())

    @torch.inference_mode(False)
    @torch.no_grad()
    def __call__(self) -> None:
        """Do what the function does."""
        if not self._expected or self._fingerprint() != self._expected:  # somebody has changed something
            self._key = self._settle()
        graph = self._graphs.get(self._key)
        if graph is None:
            graph = self._capture() if self._key in self._seen and self._key not in self._graphs else None
        if graph is None:
            self._seen.add(self._key)
            with self._fused:
                self._function()
                self._key = self._settle(after=True)
            self._expected = self._fingerprint()
            return
        graph.replay()
        if graph.ends is None:  # now that it has run, it is known where
            graph.ends = self._settle(), self._fingerprint()
        self._key, self._expected = graph.ends

    # ------------------------------------------------------------------ inside

    def _capture(self) -> _Graph | None:
        """A graph of the function from the present state on; ``None`` where it cannot be captured yet."""
        key, before, homes = self._key, self._attributes(), set(self._own)
        graph = torch.cuda.CUDAGraph()
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="relaxed"), self._fused:
            self._function()
            self._settle(after=True)
        changes = self._changes(before)
        if self._own != homes:  # a tensor was replaced for the first time, which shared its memory with another
            for path in self._own - homes:
                self._home[path] = self._home[path].clone()
            _restore(before)
            self._expected = ()
            return None
        self._graphs[key] = _Graph(graph, changes)
        return self._graphs[key]

    def _settle(self, after: bool = False) -> Key:
        """Bring all tensors to their places; returns the state of everything else.

        Args:
            after: Whether the function has just run: what it has replaced gets a place that nothing else shares.
        """
        self._objects = {}
        found: list[tuple[str, Hashable]] = []
        for i, owner in enumerate(self._owners):
            self._visit(str(i), owner, found, after)
        return tuple(found)

    def _visit(self, path: str, value: Any, found: list[tuple[str, Hashable]], after: bool) -> Any:
        if isinstance(value, torch.Tensor):
            found.append((path, value.dtype))
            return self._place(path, value, after)
        if value is None or isinstance(value, (bool, int, float, str)):
            found.append((path, value))
        elif isinstance(value, (set, frozenset)):
            found.append((path, frozenset(value)))
        elif isinstance(value, tuple) and type(value) is tuple:
            items = tuple(self._visit(f"{path}.{i}", item, found, after) for i, item in enumerate(value))
            return value if all(new is old for new, old in zip(items, value, strict=True)) else items
        elif isinstance(value, (list, dict)):
            for key, item in list(enumerate(value) if isinstance(value, list) else value.items()):
                new = self._visit(f"{path}.{key}", item, found, after)
                if new is not item:
                    value[key] = new
        elif _has_state(value) and id(value) not in self._objects:
            self._objects[id(value)] = value
            for name, item in list(vars(value).items()):
                new = self._visit(f"{path}.{name}", item, found, after)
                if new is not item:
                    setattr(value, name, new)
        return value

    def _place(self, path: str, value: torch.Tensor, after: bool) -> torch.Tensor:
        home = self._home.get(path)
        if home is value:
            return value
        if home is None or home.shape != value.shape:
            if home is not None:  # its graphs read from memory of another size
                self._graphs.clear()
                self._seen.clear()
            self._home[path] = value
            self._own.discard(path)
            return value
        if after and path not in self._own:
            self._own.add(path)
            if not torch.cuda.is_current_stream_capturing():
                self._home[path] = value.clone()
            return self._home[path]
        home.copy_(value)
        return home

    def _fingerprint(self) -> tuple:
        """Changes when an attribute of an object does."""
        return tuple(
            frozenset(item) if type(item) is set else id(item)
            for value in self._objects.values()
            for item in vars(value).values()
        )

    def _attributes(self) -> list[tuple[object, dict[str, Any]]]:
        return [
            (value, {name: frozenset(item) if type(item) is set else item for name, item in vars(value).items()})
            for value in self._objects.values()
        ]

    def _changes(self, before: list[tuple[object, dict[str, Any]]]) -> list[tuple[object, dict[str, Any]]]:
        """What the function has assigned, in place of what was there."""
        changes = []
        for value, attributes in before:
            now = {name: frozenset(item) if type(item) is set else item for name, item in vars(value).items()}
            differs = {
                name: item
                for name, item in now.items()
                if name not in attributes
                or not (item == attributes[name] if isinstance(item, frozenset) else item is attributes[name])
            }
            if differs:
                changes.append((value, differs))
        return changes


class _Graph:
    """A captured graph, and what it leaves behind in Python."""

    def __init__(self, graph: torch.cuda.CUDAGraph, changes: list[tuple[object, dict[str, Any]]]):
        self._graph = graph
        self._changes = changes
        self.ends: tuple[Key, tuple] | None = None

    def replay(self) -> None:
        """Queue its kernels, and bring Python to the state after them."""
        self._graph.replay()
        _restore(self._changes)


def _restore(attributes: list[tuple[object, dict[str, Any]]]) -> None:
    for value, items in attributes:
        for name, item in items.items():
            if type(item) is frozenset:
                own = getattr(value, name)
                own.clear()
                own.update(item)
            else:
                setattr(value, name, item)


def _has_state(value: object) -> bool:
    """Whether it is an object of ours, or a user's effect or drive, that may change from step to step."""
    kind = type(value)
    if isinstance(value, (type, types.FunctionType, types.MethodType, types.ModuleType)) or not hasattr(
        value, "__dict__"
    ):
        return False
    if isinstance(value, (Effect, PaceDCMotor)):
        return True
    return kind.__module__.partition(".")[0] in _ROOTS and not kind.__name__.endswith("Cfg")
