"""When a search has done enough: small objects that look at its state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchState:
    """What a criterion may look at, after each generation of one strategy."""

    generation: int
    """Generations so far."""
    scores: np.ndarray
    """Scores of the last generation, (population,) [rad²]."""
    best_scores: Sequence[float]
    """Best score so far after each generation [rad²]."""
    spread: np.ndarray
    """Standard deviation of the search distribution, (parameters,), in normalised coordinates."""


class Criterion(Protocol):
    """Says why a search should stop, or ``None`` to go on."""

    def __call__(self, state: SearchState) -> str | None:
        """Look at the state."""


@dataclass(frozen=True)
class ScoreSpread:
    """PACE's criterion: (max - min) / min of a generation's scores falls below epsilon."""

    epsilon: float = 1e-2

    def __call__(self, state: SearchState) -> str | None:
        """Look at the last generation."""
        low, high = float(state.scores.min()), float(state.scores.max())
        if high - low < self.epsilon * low:
            return f"score spread below {self.epsilon:g}"
        return None


@dataclass(frozen=True)
class Plateau:
    """The best score has improved by less than a part of itself over the last generations."""

    generations: int = 20
    improvement: float = 1e-3

    def __call__(self, state: SearchState) -> str | None:
        """Look at the best scores."""
        best = state.best_scores
        if len(best) > self.generations and best[-1] > (1 - self.improvement) * best[-1 - self.generations]:
            return f"best score improved by less than {self.improvement:g} in {self.generations} generations"
        return None


@dataclass(frozen=True)
class MovingWindow:
    """The mean of the best scores over one window is no better than over the window before it."""

    generations: int = 10
    improvement: float = 1e-2

    def __call__(self, state: SearchState) -> str | None:
        """Compare the last two windows."""
        n, best = self.generations, np.asarray(state.best_scores)
        if len(best) < 2 * n:
            return None
        if best[-n:].mean() > (1 - self.improvement) * best[-2 * n : -n].mean():
            return f"mean best score of {n} generations improved by less than {self.improvement:g}"
        return None


@dataclass(frozen=True)
class ParameterSpread:
    """The search distribution has become narrow in every parameter (normalised coordinates)."""

    tolerance: float = 1e-3

    def __call__(self, state: SearchState) -> str | None:
        """Look at the widest parameter."""
        if float(state.spread.max()) < self.tolerance:
            return f"parameter spread below {self.tolerance:g}"
        return None


@dataclass(frozen=True)
class TargetScore:
    """The best score is good enough."""

    score: float

    def __call__(self, state: SearchState) -> str | None:
        """Look at the best score."""
        return f"score below {self.score:g}" if state.best_scores[-1] <= self.score else None
