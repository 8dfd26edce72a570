"""Fits of several models side by side, in windows and on whole recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from pace_optim.diagnosis.fitting.levenberg_marquardt import TRIALS, Way
from pace_optim.diagnosis.fitting.processes import spread
from pace_optim.diagnosis.fitting.side_by_side import SideBySide, Slot
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.single_joint_model.problem import TwinProblem

_BEHIND = 2.0
"""RMSE, as a multiple of the best model's, from which a model is not worth the finer step."""
_COARSE, _FINE, _WHOLE = 8, 3, 2
"""Iterations at the control step, then at the problem's physics step in windows, then on whole recordings."""
_LONGER = 3
"""How many times as many at the control step, at most, for a model that still falls."""
_THINNED = 0.8
"""With less than this part of the models still on their way, only those are simulated."""
_STRIDE = 2
"""Only every so many control steps count in a fit."""


def fit_coarse_to_fine(problem: TwinProblem, starts: Sequence[Fitted], rough: bool = False) -> list[Fitted]:
    """Go most of the way in windows at the control step, on at the problem's own, and the rest on whole recordings.

    Models that the control step shows to be far behind the best one on every joint stay where it left them.

    Args:
        problem: The joints simulated alone.
        starts: Models and where they start.
        rough: Whether to go on over wide steps where narrow ones have led.
    """
    coarse = problem.coarse()
    result = fit_side_by_side(coarse, starts, _COARSE)
    for _ in range(_LONGER - 1):
        falling = [near and each.falls for near, each in zip(_near(result), result, strict=True)]
        result = _again(result, falling, lambda those: fit_side_by_side(coarse, those, _COARSE))
    if rough:
        result = _again(result, _near(result), lambda those: fit_side_by_side(coarse, those, _COARSE, rough=True))
    result = _again(result, _near(result), lambda those: fit_side_by_side(problem.in_windows(), those, _FINE))
    return _again(result, _near(result), lambda those: fit_to_whole(problem, those))


def fit_over_wide_steps(problem: TwinProblem, now: Fitted, kept: torch.Tensor | None = None) -> Fitted:
    """A model fitted in windows over wide steps, where narrow ones may lead no further.

    Args:
        problem: The joints simulated alone.
        now: The model.
        kept: Which windows that are trained on count for which joints, (R, n) bool; all if not given.
    """
    return fit_side_by_side(problem.in_windows(), [now], _COARSE, rough=True, kept=kept)[0]


def fit_to_whole(problem: TwinProblem, starts: Sequence[Fitted]) -> list[Fitted]:
    """The last iterations of models that windows have led, on whole recordings."""
    return fit_side_by_side(problem, starts, _WHOLE, keep_jacobian=True)


def _near(models: Sequence[Fitted]) -> list[bool]:
    """Which models are near the best one on some joint."""
    scores = torch.stack([each.score for each in models])
    return (scores <= _BEHIND**2 * scores.amin(dim=0)).any(dim=1).tolist()


def _again(
    models: Sequence[Fitted], which: Sequence[bool], fit: Callable[[list[Fitted]], list[Fitted]]
) -> list[Fitted]:
    """All models, some of them fitted again."""
    if not any(which):
        return list(models)
    fitted = iter(fit([each for each, yes in zip(models, which, strict=True) if yes]))
    return [next(fitted) if yes else each for each, yes in zip(models, which, strict=True)]


def fit_side_by_side(
    problem: TwinProblem,
    starts: Sequence[Fitted],
    max_iteration: int = 9,
    keep_jacobian: bool = False,
    part: float = 1.0,
    rough: bool = False,
    kept: torch.Tensor | None = None,
) -> list[Fitted]:
    """Fit several models from their present x, each joint by itself.

    Every iteration simulates, for each model, the favoured step, its neighbours (for the next Jacobian) and steps
    with more damping. Joints do not influence each other, so that one row serves all of them.

    Args:
        problem: The joints simulated alone.
        starts: Models and where they start.
        max_iteration: Largest number of iterations.
        keep_jacobian: Whether the last Jacobian is kept.
        part: Only so much of the beginning of the recordings is simulated.
        rough: Whether derivatives are taken over wide steps first.
        kept: Which of the recordings that are trained on count for which joints, (R, n) bool; all if not given.
    """
    return spread(
        lambda own: _fit(problem, own, max_iteration, keep_jacobian, part, rough, kept),
        starts,
        [start.tried for start in starts],
    )


def _fit(
    problem: TwinProblem,
    starts: Sequence[Fitted],
    max_iteration: int,
    keep_jacobian: bool,
    part: float,
    rough: bool,
    kept: torch.Tensor | None,
) -> list[Fitted]:
    """:func:`fit_side_by_side` in one process."""
    batch = _batch(problem, starts)
    where = batch.dataset.train.clone()
    where[math.ceil(part * len(where)) :] = False
    counts = where[where.any(dim=1)][::_STRIDE].sum(dim=0).double()
    weight = torch.ones(len(counts), starts[0].model.num_joints) if kept is None else kept.float()
    samples = counts @ weight.double()
    ways = running = [Way(start, samples, keep_jacobian, rough) for start in starts]
    for _ in range(max_iteration):
        rows = [way.ask() for way in running]
        physical = [way.model.to_physical(x) for way, x in zip(running, rows, strict=True)]
        errors = batch.split(batch.simulate(physical, where, _STRIDE))
        for way, x, error in zip(running, rows, errors, strict=True):
            if not way.finished:  # where it ends must not depend on what is fitted beside it
                way.tell(x, error if kept is None else error * weight)
        going = [way for way in running if not way.finished]
        if not going:
            break
        if len(going) < _THINNED * len(running):
            running, batch = going, _batch(problem, going)
    return [way.result() for way in ways]


def _batch(problem: TwinProblem, fits: Sequence[Fitted] | Sequence[Way]) -> SideBySide:
    """What simulates one iteration of each."""
    slots = [Slot(model=each.model, rows=each.model.size + len(TRIALS)) for each in fits]
    return SideBySide(problem, slots, training=True)
