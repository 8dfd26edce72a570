"""The way from the starts of a problem to its minimum.

1. Descend on pieces: windows of two seconds, a share of each recording. Over a short time the error bends less, and
   has fewer valleys.
2. Where that ends far above the noise, and above the error of the torques that no parameter makes, search the
   pieces around the best end by CMA-ES, one strategy for each kinematic tree. Armatures, frictions and the like are
   searched by magnitude. The search may simulate a stated multiple of what the descents took. Descend again from its
   best.
3. Descend on the whole recordings from the end that is best there.

A fit tries other problems on pieces before it searches (:mod:`pace_optim.identification.optimization`).

Residuals are those of the fit's own physics step. Derivatives, and the search, take the longest stable one.

A descent stops when what is left to gain is small against what is missing (``LeastSquaresCfg.tolerance`` and
``enough``): where physics is missing, the fit ends early.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from pace_optim.estimate.error_bars.far_from_noise import noise_score
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.problem.problem import Problem

PIECES, WHOLE = "pieces", "whole"
"""The stages of descents, in this order; their names may begin with more."""


@dataclass(kw_only=True)
class WayDownCfg:
    """Numbers of the stages."""

    share: float = 0.1
    """Share of each recording that the pieces make."""

    on_pieces: LeastSquaresCfg = field(
        default_factory=lambda: LeastSquaresCfg(
            max_iteration=15, score_tolerance=1e-3, near_enough=3e-2, target_score=1e-10
        )
    )
    """Descents on pieces."""

    on_whole: LeastSquaresCfg = field(default_factory=lambda: LeastSquaresCfg(loosest_enough=3e-2))
    """Descents on the whole recordings."""

    far: float = 3.0
    """Times the noise above which the end of a descent on pieces may be a wrong valley."""

    more: float = 1.5
    """Times the error of missing physics above which it may be one too."""

    search_budget: float = 2.0
    """Simulations of the search, in multiples of what the descents on pieces took."""


class WayDown:
    """The stages of one problem; its descents are all that it goes on from when it is resumed."""

    def __init__(
        self,
        problem: Problem,
        *,
        cfg: WayDownCfg | None = None,
        on_iteration: Callable[[Sequence[Descent]], None] | None = None,
        name: str = "",
    ):
        """Prepare the stages; nothing is simulated yet.

        Args:
            on_iteration: Called with the stage's descents after each iteration.
            name: What its stages' names begin with, where a fit has several ways.
        """
        self.cfg = cfg or WayDownCfg()
        self.problem = problem
        self.evaluator = problem.training_evaluator()
        """On the recordings that are trained on."""
        self.pieces = problem.on_pieces(self.cfg.share).training_evaluator()
        """On their pieces."""
        self.assessor = problem.evaluator()
        """On all recordings."""
        self.noise_score = noise_score(problem)
        """Score that the measurement's noise alone leaves [rad²]; 0: unknown."""
        self.missing_score = 0.0
        """Score that missing physics leaves by itself [rad²]; 0: unknown."""
        self.descents: list[Descent] = []
        """All so far, in the order in which they began."""
        begins = f"{name}, " if name else ""
        self.stages = f"{begins}{PIECES}", f"{begins}{WHOLE}"
        self._on_iteration = on_iteration or (lambda _: None)

    @property
    def is_on_whole(self) -> bool:
        """Whether it has left the pieces."""
        return bool(self._of(self.stages[1]))

    def run(
        self,
        starts: Sequence[torch.Tensor],
        search: Callable[[int, torch.Tensor], Sequence[torch.Tensor]] | None = None,
    ) -> Descent:
        """Go all the way; returns the best descent on the whole recordings.

        Args:
            search: Searches the pieces with a budget of simulations around a vector; returns starts.
        """
        if not self.is_on_whole:
            best = self.begin(starts)
            if search is not None and self.is_far(best.score):
                spent = sum(d.simulations for d in self._of(self.stages[0])[: len(starts)])
                starts = [*starts, *search(round(self.cfg.search_budget * spent), best.x)]
                self.begin(starts)
            self.descents.append(self._best_on_whole(starts))
        return self._descend(self.stages[1], self.cfg.on_whole)

    def near(self, x: torch.Tensor, cfg: LeastSquaresCfg) -> Descent:
        """Descend on the whole recordings from a vector that is known to be near the best."""
        if not self.is_on_whole:
            self.descents.append(Descent(x=x, stage=self.stages[1]))
        return self._descend(self.stages[1], cfg)

    def is_far(self, score: float) -> bool:
        """Whether a score is above the noise and what missing physics leaves by more than a wrong valley may add."""
        explained = max(self.cfg.far**2 * self.noise_score, self.cfg.more**2 * self.missing_score)
        return score > explained and score > self.cfg.on_pieces.target_score

    def _of(self, stage: str) -> list[Descent]:
        """A stage's descents so far."""
        return [d for d in self.descents if d.stage == stage]

    def begin(self, starts: Sequence[torch.Tensor]) -> Descent:
        """Descend on pieces from those starts that are new; returns the best end of all so far."""
        pieces = self.stages[0]
        new = starts[len(self._of(pieces)) :]
        self.descents += [Descent(x=x.clamp(-1.0, 1.0).clone(), stage=pieces) for x in new]
        self._descend(pieces, self.cfg.on_pieces)
        return min(self._of(pieces)[: len(starts)], key=lambda d: d.score)

    def _descend(self, stage: str, cfg: LeastSquaresCfg) -> Descent:
        """Let a stage's descents end; returns the best."""
        evaluator = self.pieces if stage == self.stages[0] else self.evaluator
        cfg = replace(cfg, noise_score=self.noise_score)
        return least_squares(evaluator, self._of(stage), cfg, self._on_iteration)[0]

    def _best_on_whole(self, starts: Sequence[torch.Tensor]) -> Descent:
        """A descent that begins at the end on pieces, or the start, whose score on the whole recordings is lowest."""
        ends = self._of(self.stages[0])
        vectors = torch.stack([*(d.x for d in ends), *starts])
        scores = self.evaluator.residuals(self.evaluator.space.to_physical(vectors)).score
        best = int(scores.argmin())
        hessian = ends[best].hessian if best < len(ends) else None
        known = [float(scores[best])] if bool(scores[best].isfinite()) else []
        return Descent(x=vectors[best].clone(), stage=self.stages[1], hessian=hessian, damping=_DAMPING, scores=known)


_DAMPING = 1e-5
"""Where a descent on the whole recordings begins: near its valley."""
