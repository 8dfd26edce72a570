"""The way of a fit from its starts to its result.

1. Descend on pieces: windows of two seconds, a share of each recording. Over a short time the error bends less, and
   has fewer valleys.
2. Where that ends above the noise, and the rate of the drives' loops is assumed, descend with others. The way goes on
   with one that explains more.
3. Where that ends far above the noise, and above the error of the torques that no parameter makes, search the
   pieces around the best end by CMA-ES, one strategy for each kinematic tree. Armatures, frictions and the like are
   searched by magnitude. The search may simulate a stated multiple of what the descents took. Descend again from its
   best.
4. Descend on the whole recordings from the end that is best there.

Residuals are those of the fit's own physics step. Derivatives, and the search, take the longest stable one.

A descent stops when what is left to gain is small against what is missing (``LeastSquaresCfg.tolerance`` and
``enough``): where physics is missing, the fit ends early.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from pace_optim.estimate.derivatives import Colouring
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.problem.evaluator import Evaluator

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
    """The stages of one fit; its descents are all that it goes on from when it is resumed."""

    def __init__(
        self,
        evaluator: Evaluator,
        colouring: Colouring,
        *,
        pieces: Evaluator | None = None,
        noise_score: float = 0.0,
        cfg: WayDownCfg | None = None,
        on_iteration: Callable[[Sequence[Descent]], None] | None = None,
        name: str = "",
    ):
        """Prepare the stages.

        Args:
            pieces: Simulates the pieces; ``None``: the whole recordings are the pieces.
            noise_score: Score that the measurement's noise alone leaves [rad²]; 0: unknown.
            on_iteration: Called with the stage's descents after each iteration.
            name: What its stages' names begin with, where a fit has several ways.
        """
        self.cfg = cfg or WayDownCfg()
        self.evaluator = evaluator
        self.pieces = pieces or evaluator
        self.colouring = colouring
        self.noise_score = noise_score
        self.missing_score = 0.0
        """Score that missing physics leaves by itself [rad²]; 0: unknown."""
        self.descents: list[Descent] = []
        """All so far, in the order in which they began."""
        self.stages = f"{name}{PIECES}", f"{name}{WHOLE}"
        self._on_iteration = on_iteration or (lambda _: None)

    def run(
        self,
        starts: Sequence[torch.Tensor],
        search: Callable[[int, torch.Tensor], Sequence[torch.Tensor]] | None = None,
        scan: Callable[[torch.Tensor], torch.Tensor | None] = lambda _: None,
        elsewhere: Callable[[Descent], WayDown | None] = lambda _: None,
    ) -> Descent:
        """Go all the way; returns the best descent on the whole recordings.

        Args:
            starts: Normalised vectors, (size,).
            search: Searches the pieces with a budget of simulations around a vector; returns starts.
            scan: Gives another start by the best end so far, or none.
            elsewhere: Gives the way of a model with other facts, begun at the best end so far, if it is to be gone on.
        """
        pieces, whole = self.stages
        if self._of(whole):
            return self._descend(whole, [])
        starts = list(starts)
        best = self.begin(starts)
        if (found := scan(best.x)) is not None:
            starts.append(found)
            best = self.begin(starts)
        if (way := elsewhere(best)) is not None:
            way.missing_score = self.missing_score
            return way.run([best.x], search)
        if search is not None and self.is_far(best.score):
            spent = sum(d.simulations for d in self._of(pieces)[: len(starts)])
            starts.extend(search(round(self.cfg.search_budget * spent), best.x))
            self.begin(starts)
        self.descents.append(self._best_on_whole(starts))
        return self._descend(whole, [])

    def near(self, x: torch.Tensor, cfg: LeastSquaresCfg) -> Descent:
        """Descend on the whole recordings from a vector that is known to be near the best."""
        if not self.descents:
            self.descents = [Descent(x=x, stage=self.stages[-1])]
        return self._descend(self.stages[-1], [], cfg)

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
        self._descend(pieces, [Descent(x=x.clamp(-1.0, 1.0).clone(), stage=pieces) for x in starts])
        return min(self._of(pieces)[: len(starts)], key=lambda d: d.score)

    def _descend(self, stage: str, starts: Sequence[Descent], cfg: LeastSquaresCfg | None = None) -> Descent:
        """Let a stage's descents end, those of its starts that are new among them; returns the best."""
        own = self._of(stage)
        added = starts[len(own) :]
        own, self.descents = [*own, *added], [*self.descents, *added]
        on_whole = stage == self.stages[-1]
        cfg = cfg or (self.cfg.on_whole if on_whole else self.cfg.on_pieces)
        cfg, evaluator = replace(cfg, noise_score=self.noise_score), self.evaluator if on_whole else self.pieces
        return least_squares(evaluator, self.colouring, own, cfg, self._on_iteration)[0]

    def _best_on_whole(self, starts: Sequence[torch.Tensor]) -> Descent:
        """A descent that begins at the end on pieces, or the start, whose score on the whole recordings is lowest."""
        ends = self._of(self.stages[0])
        vectors = torch.stack([*(d.x for d in ends), *starts])
        scores = self.evaluator.residuals(self.evaluator.space.to_physical(vectors)).score
        best = int(scores.argmin())
        hessian = ends[best].hessian if best < len(ends) else None
        known = [float(scores[best])] if bool(scores[best].isfinite()) else []
        return Descent(x=vectors[best].clone(), stage=self.stages[-1], hessian=hessian, damping=_DAMPING, scores=known)


_DAMPING = 1e-5
"""Where a descent on the whole recordings begins: near its valley."""
