"""What a drive is made of."""

from __future__ import annotations

from collections.abc import Collection, Hashable
from typing import ClassVar

import torch

_PLAIN = (type(None), bool, int, float, str, frozenset)


class Part:
    """A part of a drive. Its calls change the attributes that ``memory`` names; the others they only read."""

    __slots__ = ()
    memory: ClassVar[Collection[str]] = ()
    """What it keeps from call to call."""

    def kept(self) -> Collection[str]:
        """What it keeps from call to call."""
        return self.memory

    def tensors(self) -> dict[str, torch.Tensor]:
        """Its tensors, by attribute."""
        return {name: value for name, value in vars(self).items() if isinstance(value, torch.Tensor)}

    def flags(self) -> dict[str, Hashable]:
        """What Python branches over, by attribute: numbers, names, sets of names, and what is ``None``."""
        own = getattr(self, "__dict__", {})  # a drive's state has fields alone
        return {name: value for name, value in own.items() if isinstance(value, _PLAIN)}
