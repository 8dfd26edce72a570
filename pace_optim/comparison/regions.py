"""Where the error sits: the part of a dimension that holds more of it than its time would give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .dimensions import Dimension

LEAST_SHARE = 0.4
"""A place holds at least this share of the error,"""
LEAST_LIFT = 1.6
"""and this many times its share of the time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """An error against one dimension: shares of each of its B bins."""

    time: np.ndarray
    """Share of the time, (B,); sums to 1."""
    error: np.ndarray
    """Share of the squared error above the floor, (B,); sums to 1, or is all zero without such error."""
    rms: np.ndarray
    """Root mean square of the error, floor included, (B,) [rad]."""
    mean: np.ndarray
    """Mean of the error, with its sign, (B,) [rad]."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """Neighbouring bins ``first`` to ``last`` of a dimension."""

    first: int
    last: int
    share: float
    """Of the error above the floor."""
    base: float
    """Of the time (of a frequency: of the octaves)."""

    @property
    def lift(self) -> float:
        """How much denser the error is there than on average."""
        return self.share / self.base if self.base > 0 else np.inf

    @property
    def is_place(self) -> bool:
        """Whether it is worth a sentence."""
        return self.share >= LEAST_SHARE and self.lift >= LEAST_LIFT


def lay_out(error: np.ndarray, floor: np.ndarray, bins: np.ndarray, num_bins: int) -> Layout:
    """Squared error above the floor by bin: (Σ e² − Σ σ²) of each, none below zero, as a share of their sum.

    Args:
        error: (K,) [rad].
        floor: Noise σ at each sample, (K,) [rad].
        bins: Each sample's bin, (K,) int.
    """
    count = np.bincount(bins, minlength=num_bins)
    square = np.bincount(bins, weights=error**2, minlength=num_bins)
    above = np.maximum(square - np.bincount(bins, weights=floor**2, minlength=num_bins), 0.0)
    many = np.maximum(count, 1)
    return Layout(
        time=count / len(error),
        error=above / above.sum() if above.sum() > 0 else above,
        rms=np.sqrt(square / many),
        mean=np.bincount(bins, weights=error, minlength=num_bins) / many,
    )


def evidence(share: float, base: float) -> float:
    """How far a share is from what its base would give: the divergence of the two, Σ p ln(p / p₀) [nat]; 0 if below."""
    if share <= base:
        return 0.0
    base = max(base, 1e-6)
    rest = (1 - share) * np.log((1 - share) / (1 - base)) if share < 1 else 0.0
    return float(share * np.log(share / base) + rest)


def best_region(base: np.ndarray, share: np.ndarray, neighbours: bool = True) -> Region | None:
    """The run of bins whose share is the furthest above its base; ``None`` where there is no error.

    Args:
        base: (B,), sums to 1.
        share: (B,), sums to 1.
        neighbours: Whether several bins may be named as one.
    """
    best, most = None, 0.0
    for first in range(len(base)):
        for last in range(first, len(base) if neighbours else first + 1):
            p, p0 = float(share[first : last + 1].sum()), float(base[first : last + 1].sum())
            if (value := evidence(p, p0)) > most:
                best, most = Region(first=first, last=last, share=p, base=p0), value
    return best


def inside(dimension: Dimension, region: Region) -> np.ndarray:
    """Which samples lie in a region, (K,) bool."""
    return (dimension.bin >= region.first) & (dimension.bin <= region.last)


def refine(
    above: np.ndarray,
    mask: np.ndarray,
    region: Region,
    others: Sequence[tuple[float, Dimension]],
) -> tuple[Dimension, Region] | None:
    """A part of a region, by another dimension, that holds most of its error in much less of its time.

    Args:
        above: Squared error less floor at each sample, (K,).
        mask: The region's samples, (K,) bool.
        others: Dimensions to narrow it by, each with the weight of its evidence.

    Returns:
        The dimension and its region; share and base are of the whole error and time. ``None`` if no one does.
    """
    total = max(float(above.sum()), 1e-300)
    best, most = None, evidence(region.share, region.base)
    for weight, dimension in others:
        held = np.bincount(dimension.bin[mask], weights=above[mask], minlength=dimension.num_bins)
        part = np.maximum(held, 0.0) / total
        time = np.bincount(dimension.bin[mask], minlength=dimension.num_bins) / len(above)
        for first in range(dimension.num_bins):
            for last in range(first, dimension.num_bins if dimension.neighbours else first + 1):
                share, base = float(part[first : last + 1].sum()), float(time[first : last + 1].sum())
                narrow = 0.75 * region.share <= share and base <= 0.75 * region.base and base > 0
                if narrow and (value := weight * evidence(min(share, 1.0), base)) > most:
                    best, most = (dimension, Region(first=first, last=last, share=share, base=base)), value
    return best
