"""Bounds and scales of parameters: the coordinates that optimizers see."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True, eq=False)
class Box:
    """Normalised coordinates, which run from -1 to 1 between the bounds.

    physical = lower + (x + 1)/2 (upper - lower)              linear scale
    physical = exp(log lower + (x + 1)/2 (log upper - log lower))   logarithmic scale
    """

    lower: torch.Tensor
    """(…, size), physical."""
    upper: torch.Tensor
    """(…, size), physical."""
    log: torch.Tensor
    """Which entries have a logarithmic scale, (size,) bool."""

    def to_physical(self, x: torch.Tensor) -> torch.Tensor:
        """Physical values of normalised ones (…, size)."""
        low, width = self._low_and_width()
        value = low + (x + 1) / 2 * width
        return torch.where(self.log, value.exp(), value).clamp(self.lower, self.upper)

    def to_normalised(self, physical: torch.Tensor) -> torch.Tensor:
        """Normalised values of physical ones (…, size); entries whose bounds are equal become 0."""
        low, width = self._low_and_width()
        value = torch.where(self.log, physical.clamp(min=1e-300).log(), physical)
        return torch.where(width > 0, (value - low) / width.clamp(min=1e-300) * 2 - 1, 0.0)

    def slope(self, x: torch.Tensor) -> torch.Tensor:
        """D physical / d x at normalised values (…, size)."""
        half_width = self._low_and_width()[1] / 2
        return torch.where(self.log, self.to_physical(x) * half_width, half_width)

    def _low_and_width(self) -> tuple[torch.Tensor, torch.Tensor]:
        low, high = (torch.where(self.log, bound.clamp(min=1e-300).log(), bound) for bound in (self.lower, self.upper))
        return low, high - low
