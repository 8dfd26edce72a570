"""Levenberg–Marquardt of every joint of every model at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.model import JointModel
from pace_optim.diagnosis.processes import spread
from pace_optim.diagnosis.side_by_side import SideBySide, Slot
from pace_optim.joint_twins.problem import TwinProblem
from pace_optim.least_squares import bounded_step

_SMOOTH = (1e-4,)
"""Normalised step of the derivatives."""
_ROUGH = (3e-2, 1e-2, 1e-4)
"""The same where contacts and sticking make the error rough: a narrow one sees the roughness and not the slope. The
next is taken when one leads no further."""
_TRIALS = (1.0, 30.0, 1e3)
_DAMPING = 1e-3
_ENOUGH = 3e-3
"""A joint whose score falls by less than this part in an iteration has converged."""
_STILL = 2
"""Steps in a row that gain less than that, after which a joint has converged."""
_BEHIND = 2.0
"""RMSE, as a multiple of the best model's, from which a model is not worth the finer step."""
_COARSE, _FINE, _WHOLE = 8, 3, 2
"""Iterations at the control step, then at the problem's physics step in windows, then on whole recordings."""
_LONGER = 3
"""How many times as many at the control step, at most, for a model that still falls."""
_FALLS, _FALLS_OVER = 0.05, 3
"""A model still falls whose squared error over all joints has fallen by more than this part over so many steps."""
_STRIDE = 2
"""Only every so many control steps count in a fit."""


@dataclass(kw_only=True, eq=False)
class Fitted:
    """A model fitted to the training recordings."""

    model: JointModel
    x: torch.Tensor
    """Normalised, (n, P)."""
    score: torch.Tensor
    """Mean square error of each joint, (n,) [rad²]; infinite where it is not known yet."""
    tried: type[Effect] | None = None
    """The effect that is tried in it."""
    jacobian: torch.Tensor | None = None
    """Derivatives of the errors at x (P, K, R, n) float32, where wanted."""
    error: torch.Tensor | None = None
    """At x, (K, R, n) float32, where wanted."""
    falls: bool = False
    """Whether its error was still falling when its iterations were over."""

    @classmethod
    def start(cls, model: JointModel, physical: torch.Tensor, tried: type[Effect] | None = None) -> Fitted:
        """A model at physical values (n, P), not fitted yet."""
        unknown = torch.full((model.num_joints,), torch.inf, dtype=torch.float64)
        return cls(model=model, x=model.to_normalised(physical), score=unknown, tried=tried)

    def take(self, other: Fitted, joints: torch.Tensor) -> None:
        """Take over another fit of the same effects on some joints, (n,) bool, and what is known of it there."""
        lower, upper = (
            torch.where(joints[:, None], getattr(other.model, side), getattr(self.model, side))
            for side in ("lower", "upper")
        )
        self.model = replace(self.model, lower=lower, upper=upper)
        self.x = torch.where(joints[:, None], other.x, self.x)
        self.score = torch.where(joints, other.score, self.score)
        if self.jacobian is not None and other.jacobian is not None:
            self.jacobian = torch.where(joints, other.jacobian, self.jacobian)
        if self.error is not None and other.error is not None:
            self.error = torch.where(joints, other.error, self.error)


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
    slots = [Slot(model=s.model, rows=s.model.size + len(_TRIALS)) for s in starts]
    batch = SideBySide(problem, slots, training=True)
    where = batch.dataset.train.clone()
    where[math.ceil(part * len(where)) :] = False
    counts = where[where.any(dim=1)][::_STRIDE].sum(dim=0).double()
    weight = torch.ones(len(counts), starts[0].model.num_joints) if kept is None else kept.float()
    samples = counts @ weight.double()
    ways = [_Way(start, samples, keep_jacobian, rough) for start in starts]
    for _ in range(max_iteration):
        rows = [way.ask() for way in ways]
        physical = [way.model.to_physical(x) for way, x in zip(ways, rows, strict=True)]
        errors = batch.split(batch.simulate(physical, where, _STRIDE))
        for way, x, error in zip(ways, rows, errors, strict=True):
            if not way.finished:  # where it ends must not depend on what is fitted beside it
                way.tell(x, error if kept is None else error * weight)
        if all(way.finished for way in ways):
            break
    return [way.result() for way in ways]


class _Way:
    """One model's way down: rows are the favoured step, its P neighbours, and the other trials."""

    def __init__(self, start: Fitted, samples: torch.Tensor, keep: bool, rough: bool):
        self.model, self.tried, self._samples, self._keep = start.model, start.tried, samples, keep
        n, size = start.x.shape
        self.x = start.x.clone()
        self.score = torch.full((n,), torch.inf, dtype=torch.float64)
        self._damping = torch.full((n,), _DAMPING, dtype=torch.float64)
        self._hessian = torch.zeros(n, size, size, dtype=torch.float64)
        self._gradient = torch.zeros(n, size, dtype=torch.float64)
        self._known = torch.zeros(n, dtype=torch.bool)
        self._still = torch.zeros(n, dtype=torch.long)
        self._converged = torch.zeros(n, dtype=torch.bool)
        self._widths = torch.tensor(_ROUGH if rough else _SMOOTH, dtype=torch.float64)
        self._width = torch.zeros(n, dtype=torch.long)
        self._free = start.model.free
        self._jacobian: torch.Tensor | None = None
        self._error: torch.Tensor | None = None
        self._scores: list[float] = []

    @property
    def finished(self) -> bool:
        """Whether every joint has once come to its end."""
        return bool(self._converged.all())

    def ask(self) -> torch.Tensor:
        """Normalised rows, (P + trials, n, P)."""
        n, size = self.x.shape
        trials = self.x.repeat(len(_TRIALS), 1, 1)
        for j in range(n):
            free = self._free[j]
            if not bool(self._known[j]) or not bool(free.any()):
                continue
            at = free.nonzero()[:, 0]
            hessian, gradient = self._hessian[j][at[:, None], at], self._gradient[j][at]
            for t, factor in enumerate(_TRIALS):
                trials[t, j, at] = bounded_step(self.x[j, at], hessian, gradient, float(self._damping[j]) * factor)
        favoured = trials[0]
        width = self._widths[self._width][:, None]
        self._step = torch.where(favoured > 0, -width, width)
        neighbours = favoured.repeat(size, 1, 1)
        for p in range(size):
            neighbours[p, :, p] += self._step[:, p]
        return torch.cat([favoured[None], neighbours, trials[1:]])

    def tell(self, x: torch.Tensor, error: torch.Tensor) -> None:
        """Take the best row of each joint."""
        size = self.x.shape[1]
        scores = error.square().sum(dim=(1, 2), dtype=torch.float64) / self._samples
        choice = [0, *range(1 + size, len(x))]
        best = scores[choice].argmin(dim=0)
        lowest = scores[choice].gather(0, best[None])[0]
        better = lowest < self.score
        # a joint whose Jacobian was not known has not moved: its favoured row is x itself, and tells nothing of a gain
        fresh = ~self._known
        gain = (self.score - lowest) / self.score
        self._still = torch.where(fresh, self._still, torch.where(gain > _ENOUGH, 0, self._still + 1))
        narrower = (self._still > 0) & (self._width + 1 < len(self._widths))
        self._still[narrower] = 0
        self._converged |= self._still >= _STILL
        chosen = x[choice].gather(0, best[None, :, None].expand(1, -1, size))[0]
        moved = better & ~fresh
        self.x = torch.where(moved[:, None], chosen, self.x)
        self.score = torch.where(better, lowest, self.score)
        self._scores.append(float(self.score.sum()))
        factor = torch.tensor(_TRIALS, dtype=torch.float64)[best]
        lowered = (self._damping * factor / 10).clamp(min=1e-9)
        self._damping = torch.where(moved, lowered, torch.where(fresh, self._damping, self._damping * 1e3))
        at_favoured = fresh | (moved & (best == 0))
        self._known = torch.where(at_favoured, True, torch.where(moved, False, self._known)) & ~narrower
        self._width += narrower
        self._damping = torch.where(narrower, _DAMPING, self._damping)
        if bool(at_favoured.any()):
            difference = error[1 : 1 + size] - error[:1]
            columns = difference / self._step.T[:, None, None, :].float()
            hessian = torch.einsum("pkrj,skrj->jps", columns, columns).double() / self._samples[:, None, None]
            gradient = torch.einsum("pkrj,krj->jp", columns, error[0]).double() / self._samples[:, None]
            self._hessian = torch.where(at_favoured[:, None, None], hessian, self._hessian)
            self._gradient = torch.where(at_favoured[:, None], gradient, self._gradient)
            if self._keep:
                mask = at_favoured.float()
                old_j = torch.zeros_like(columns) if self._jacobian is None else self._jacobian
                old_e = torch.zeros_like(error[0]) if self._error is None else self._error
                self._jacobian = columns * mask + old_j * (1 - mask)
                self._error = error[0] * mask + old_e * (1 - mask)

    def result(self) -> Fitted:
        """Where it ended."""
        return Fitted(
            model=self.model,
            x=self.x,
            score=self.score,
            tried=self.tried,
            jacobian=self._jacobian,
            error=self._error,
            falls=self._falls(),
        )

    def _falls(self) -> bool:
        """Whether the last steps have lowered the error."""
        last = self._scores[-1 - _FALLS_OVER :]
        return not self.finished and len(last) > 1 and last[-1] < (1 - _FALLS) * last[0]
