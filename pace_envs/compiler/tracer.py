"""Takes torch's operations, in place of torch, by its dispatch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

_NO_TENSORS = frozenset((bool, int, float, str, type(None), torch.dtype, torch.device, torch.layout))
"""Types of other arguments: to ask whether one is a tensor takes longer than to note an operation."""


class Tracer(TorchDispatchMode):
    """While it is entered, operations on tensors that it knows are noted and not done; others are torch's.

    Views are torch's own: a tensor that shows the same memory is known by it.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing here is compiled by torch: its compiler, which takes seconds to import, need not be kept off."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: Any = None) -> Any:
        """An operation of torch."""
        kwargs = dict(kwargs or {})
        name, is_view, changes = _facts(func)
        if is_view:
            return func(*args, **kwargs)  # the same memory
        tensors = tensors_in((*args, *kwargs.values()))
        if changes:
            self.will_change([args[i] if i < len(args) else kwargs.get(key) for i, key in changes])
        if not tensors or "empty" in name:
            return self.made(func, name, args, kwargs)
        if self.knows(tensors):
            out = kwargs.pop("out", None)
            target = args[0] if out is None and changes else out
            result = self.noted(func, name.rstrip("_"), args, kwargs, target, tensors)
            if result is not None:
                return result
            if out is not None:
                kwargs["out"] = out
        return self.left_to_torch(func, args, kwargs)

    def will_change(self, changed: Sequence[torch.Tensor]) -> None:
        """Tensors are about to be changed in place."""

    def made(self, func: Any, name: str, args: tuple, kwargs: dict[str, Any]) -> Any:
        """A tensor that depends on no other."""
        return func(*args, **kwargs)

    def knows(self, tensors: Sequence[torch.Tensor]) -> bool:
        """Whether operations on these are noted."""
        raise NotImplementedError

    def noted(self, func: Any, name: str, args: tuple, kwargs: dict, target: Any, tensors: list[torch.Tensor]) -> Any:
        """The result of an operation that is noted; ``None`` where that cannot be.

        Args:
            name: Its name, without the underscore of those in place.
            kwargs: Options, without ``out``.
            target: What it writes; ``None`` for a new tensor.
            tensors: Those among the arguments and options.
        """
        raise NotImplementedError

    def left_to_torch(self, func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        """What torch does itself."""
        return func(*args, **kwargs)


@cache
def _facts(func: Any) -> tuple[str, bool, list[tuple[int, str]]]:
    """An operation's name, whether its result shows an argument's memory unchanged, and the arguments it changes."""
    schema = func._schema
    name = schema.name.partition("::")[2]
    is_view = any(each.alias_info is not None and not each.alias_info.is_write for each in schema.returns)
    infos = [(i, each.name, each.alias_info) for i, each in enumerate(schema.arguments)]
    changes = [(i, key) for i, key, info in infos if info is not None and info.is_write]
    return name, is_view or name == "_unsafe_view", changes


def tensors_in(values: Iterable[Any]) -> list[torch.Tensor]:
    """The tensors among values and lists of them."""
    found = []
    for value in values:
        kind = type(value)
        if kind in (list, tuple):
            found += tensors_in(value)
        elif kind is torch.Tensor or (kind not in _NO_TENSORS and isinstance(value, torch.Tensor)):
            found.append(value)
    return found
