"""When a search has done enough: small objects that look at its state, and their names in configurations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchState:
    """What a criterion may look at, after each generation of one strategy."""

    generation: int
    """Generations so far."""
    scores: np.ndarray
    """Scores of the last generation, (population,) [rad²]."""
    best_scores: Sequence[float]
    """Best score so far after each generation [rad²]; infinite until the trees share their delay."""
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
class ScoreGradient:
    """The best score falls by less than a part of itself in a generation, on average over the last ones."""

    generations: int = 10
    threshold: float = 1e-3

    def __call__(self, state: SearchState) -> str | None:
        """Compare the logarithms of the best score now and before."""
        n, best = self.generations, state.best_scores
        if len(best) <= n or not 0 < best[-1] < math.inf:
            return None
        if math.log(best[-1 - n] / best[-1]) / n < self.threshold:
            return f"best score fell by less than {self.threshold:g} of itself in a generation, over {n} generations"
        return None


@dataclass(frozen=True)
class EarlyStopping:
    """No candidate of the last generations was better than the best before them."""

    generations: int = 15

    def __call__(self, state: SearchState) -> str | None:
        """Look at the best scores."""
        best = state.best_scores
        if len(best) > self.generations and best[-1] >= best[-1 - self.generations]:
            return f"no better candidate in {self.generations} generations"
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


STOP_RULES: dict[str, type[Any]] = {
    "spread": ScoreSpread,
    "plateau": Plateau,
    "window": MovingWindow,
    "gradient": ScoreGradient,
    "early_stopping": EarlyStopping,
    "parameters": ParameterSpread,
    "target": TargetScore,
}
"""Rules by the names that ``CMAESOptimizerCfg.stop`` and ``fit --stop`` take."""


def stop_rule(rule: Any) -> Criterion:
    """The rule that a configuration names.

    Args:
        rule: ``"plateau"``, with numbers ``"plateau:generations=30,improvement=0.01"``, or a custom rule.
    """
    if callable(rule):
        return rule
    name, _, text = str(rule).partition(":")
    if name not in STOP_RULES:
        raise ValueError(f"Unknown stop rule {name!r}. Available: {', '.join(STOP_RULES)}.")
    kind, values = STOP_RULES[name], {}
    known = {f.name: int if "int" in str(f.type) else float for f in fields(kind)}
    for part in filter(None, text.split(",")):
        key, _, number = part.partition("=")
        try:
            values[key] = known[key](number)
        except (KeyError, ValueError):
            numbers = ", ".join(f"{key}=NUMBER" for key in known)
            raise ValueError(f"The stop rule {rule!r} has {part!r}, expected {name}:{numbers}.") from None
        if not 0 < values[key] < math.inf:
            raise ValueError(f"The stop rule {rule!r} has {part!r}, expected a number > 0.")
    try:
        return kind(**values)
    except TypeError:
        raise ValueError(f"The stop rule {rule!r} lacks a number: write {name}:{next(iter(known))}=NUMBER.") from None
