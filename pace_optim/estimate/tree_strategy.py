"""One CMA-ES strategy over a group of entries of the parameter vector."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np

from pace_optim.estimate.convergence import Criterion, SearchState

_MARGIN = 0.05
"""Width of the curved part inside a bound, and of the part outside that is mapped onto it."""
_PERIOD = 2 * (2.0 + _MARGIN + _MARGIN)
_START = -1.0 - 2 * _MARGIN - 1.0


def into_unit_box(x: np.ndarray) -> np.ndarray:
    """Each value inside [-1, 1], any shape: pycma's transformation of bounds, the same to the last digit.

    The identity up to 0.95, a parabola on to 1.05, mirrored at ±1.05, periodic: smooth everywhere
    (``BoxConstraintsLinQuadTransformation``). pycma computes it candidate by candidate.
    """
    y = np.array(x, dtype=float)
    far = (y < _START) | (y > -_START)
    y[far] -= _PERIOD * ((y[far] - _START) // _PERIOD)
    above = y > 1.0 + _MARGIN
    y[above] -= 2 * (y[above] - 1.0 - _MARGIN)
    below = y < -1.0 - _MARGIN
    y[below] += 2 * (-1.0 - _MARGIN - y[below])
    low = y < -1.0 + _MARGIN
    y[low] = -1.0 + (y[low] - (-1.0 - _MARGIN)) ** 2 / 4 / _MARGIN
    high = y > 1.0 - _MARGIN
    y[high] = 1.0 - (y[high] - (1.0 + _MARGIN)) ** 2 / 4 / _MARGIN
    return y


_MAXSTD = 2.0 / 3.0
"""Largest standard deviation: pycma's own where it knows the bounds."""
DIVERGED_SCORE = 1e6
"""The score of a simulation that is not finite [rad²]."""


State = tuple[np.ndarray, float, str | None, np.ndarray, np.ndarray]


class TreeStrategy:
    """pycma's strategy with its own random numbers, its best candidate and its reasons to stop.

    pycma brings candidates into their bounds one by one, which takes longer than their simulation on a GPU. So its
    strategy gets no bounds here, and a generation is brought into them at once: the candidates are the same.

    Attributes:
        best_x: The best candidate, normalised, (len(entries),).
        best_score: Its score [rad²].
        best_scores: The best score after each generation [rad²]; infinite before the best was forgotten.
        stop_reason: Why it has stopped; ``None`` while it goes on.
        mean: Of the search distribution, normalised, inside the bounds.
        spread: Standard deviation of the search distribution, normalised.
    """

    def __init__(
        self,
        entries: Sequence[int],
        *,
        start: np.ndarray,
        sigma: float,
        population_size: int,
        seed: int,
        criteria: Sequence[Criterion],
    ):
        """Start a search.

        Args:
            entries: Which entries of the full vector it searches.
            start: Where it starts, normalised, (len(entries),).
            criteria: When it stops, beside pycma's own conditions.
        """
        self.entries = np.asarray(entries)
        self.criteria = tuple(criteria)
        self._begin = partial(_pycma, list(start), sigma, population_size, np.random.default_rng(seed))
        self.best_x = np.array(start, dtype=float)
        self.best_score = np.inf
        self.best_scores: list[float] = []
        self.stop_reason: str | None = None
        self.mean, self.spread = self.best_x.copy(), np.full(len(self.best_x), min(sigma, _MAXSTD))

    @cached_property
    def _strategy(self) -> Any:
        """From the first generation on: a fit that needs no search need not import pycma."""
        return self._begin()

    def _look(self) -> None:
        """Keep what pycma knows of its distribution."""
        self.mean = into_unit_box(self._strategy.mean)
        self.spread = np.array(self._strategy.stds)

    @property
    def state(self) -> State:
        """What others read of it: another process may have done its arithmetic."""
        return self.best_x, self.best_score, self.stop_reason, self.mean, self.spread

    @state.setter
    def state(self, state: State) -> None:
        self.best_x, self.best_score, self.stop_reason, self.mean, self.spread = state

    def ask(self) -> np.ndarray:
        """Candidates of the next generation, normalised, (population_size, len(entries))."""
        self._asked = self._strategy.ask_geno()
        return into_unit_box(self._asked)

    def tell(self, scores: np.ndarray, shown: np.ndarray) -> None:
        """Take the scores of the generation that was asked for last.

        Args:
            scores: [rad²], (population_size,).
            shown: What was simulated, where it differs from what :meth:`ask` gave, (population_size, len(entries)).
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of its clock, which its own ask would have started
            self._strategy.tell(list(self._asked), scores, check_points=False)  # they are its own: none is clipped
        self._look()
        i = int(scores.argmin())
        if scores[i] < self.best_score:
            self.best_score, self.best_x = float(scores[i]), shown[i].copy()
        self.best_scores.append(self.best_score)
        state = SearchState(
            generation=len(self.best_scores), scores=scores, best_scores=self.best_scores, spread=self.spread
        )
        own = [reason for criterion in self.criteria if (reason := criterion(state))]
        pycma = [f"cma: {name}" for name in self._strategy.stop()]
        self.stop_reason = next(iter(own + pycma), None)

    def forget_best(self) -> None:
        """Start over with the best, after what is simulated for a vector has changed."""
        self.best_score = np.inf
        self.best_scores = [np.inf] * len(self.best_scores)
        self.stop_reason = None


def _pycma(start: list[float], sigma: float, population_size: int, generator: np.random.Generator) -> Any:
    """A strategy without bounds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of optional packages at import
        import cma
        from cma.boundary_handler import BoundTransform

        options = {
            "maxstd": _MAXSTD,
            "popsize": population_size,
            "randn": lambda *shape: generator.standard_normal(shape),
            "seed": np.nan,
            "verbose": -9,
            "tolfun": 1e-13,
            "tolfunhist": 1e-14,
            "tolx": 1e-10,
            "maxiter": np.inf,
        }
        return cma.CMAEvolutionStrategy(BoundTransform([-1.0, 1.0]).inverse(start), sigma, options)
