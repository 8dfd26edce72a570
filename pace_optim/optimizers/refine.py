"""From starts to the result: first on the beginning of the recordings, then on all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from pace_optim.optimizers.jacobian import Colouring
from pace_optim.optimizers.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.problem.evaluator import Evaluator

BEGINNING = 0.25
"""The part of each recording on which most of the way is gone."""

COARSE = LeastSquaresCfg(max_iteration=15, score_tolerance=1e-3, target_score=1e-12)
_DAMPING_AFTER_COARSE = 1e-5
_ANOTHER_VALLEY = 0.02
_MUCH_WORSE = 10.0


def refine(
    evaluator: Evaluator,
    colouring: Colouring,
    starts: Sequence[Descent],
    on_iteration: Callable[[list[Descent]], None] | None = None,
    found: Sequence[Descent] = (),
    on_beginning: Callable[[list[Descent]], None] | None = None,
    coarse: Evaluator | None = None,
) -> list[Descent]:
    """Least squares from several starts; most of the way is gone on a part of each recording, which is cheaper.

    Args:
        evaluator: Simulates.
        colouring: Which entries are perturbed together.
        starts: Fresh descents, or those of an interrupted run to go on with.
        on_iteration: Called with all descents after each iteration on the whole recordings.
        found: Descents that have ended: a start that comes into their valley, or stays far above them, is dropped.
        on_beginning: The same on the part of each recording, whose descents are not yet those of the whole.
        coarse: Simulates that part, at a longer physics step; ``None``: as the whole.

    Returns:
        The descents, those that had ended too, the best first.
    """
    descents = list(starts)
    if all(descent.iteration == 0 for descent in descents):
        vectors = [descent.x for descent in descents]
        descents = _near_their_valleys(evaluator, coarse or evaluator, colouring, vectors, on_beginning)
        if on_iteration is not None:
            on_iteration([*found, *descents])
    return least_squares(evaluator, colouring, [*found, *descents], on_iteration=on_iteration)


def _near_their_valleys(
    evaluator: Evaluator,
    coarse: Evaluator,
    colouring: Colouring,
    starts: Sequence[torch.Tensor],
    on_iteration: Callable[[list[Descent]], None] | None,
) -> list[Descent]:
    """Refine on the beginnings of the recordings; keep, of each start, what is better on the whole.

    Ends that are far worse than the best, or next to it, are left out.
    """
    where = coarse.dataset.beginning(BEGINNING)
    ended = least_squares(coarse, colouring, starts, COARSE, on_iteration, where)
    ends, directions = [d.x for d in ended], ended[0].directions
    candidates = torch.stack([*ends, *starts])
    likely = Descent(x=ends[0], directions=directions)  # the best: its derivatives come in the same batch
    neighbours, step = likely.around(ends[0], colouring)
    residuals = evaluator.residuals(evaluator.space.to_physical(torch.cat([candidates, neighbours])))
    scores = residuals.score[: len(candidates)]
    kept: list[Descent] = []
    for i in scores.argsort().tolist():
        x = candidates[i]
        if kept and not scores[i] < _MUCH_WORSE * scores.min():
            break
        if all(float((x - other.x).abs().max()) > _ANOTHER_VALLEY for other in kept):
            damping = _DAMPING_AFTER_COARSE
            kept.append(Descent(x=x, score=float(scores[i]), damping=damping, iteration=1, directions=directions))
    for descent in kept:
        if torch.equal(descent.x, ends[0]):
            around = torch.cat([residuals.error[:1], residuals.error[len(candidates) :]])
            descent.look(descent.x, replace(residuals, error=around), step, colouring)
    return kept[: len(starts)]
