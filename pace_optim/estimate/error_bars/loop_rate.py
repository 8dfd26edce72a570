"""The rate of the drives' loops where it is not stated: which ones the recordings allow, and what depends on it.

A loop that holds its torque over a period h sees the motion h / 2 late on average, which is kp h / 2 of viscous
friction and kd h / 2 of armature. A fit with a wrong rate finds these in its values, at nearly the same error.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from pace_optim.estimate.derivatives import Jacobian
from pace_optim.estimate.error_bars.far_from_noise import noise_score
from pace_optim.estimate.error_bars.uncertainty import SURE, autocovariance, filtered
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, by_chords, least_squares
from pace_optim.problem.drive_steps import loop_gains
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.free_phases import FreePhases
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem

_RATES = (1e3, 2e3, 4e3, 8e3)
"""Rates of servo drives' loops [Hz]. Faster ones are between the last and a continuous loop, a period of 0."""
_USUAL, _FAST = 1e-3, 5e-4
"""Periods that are simulated beside the assumed one [s]: the usual one of servo drives, and one that is far shorter. A
continuous loop takes the place of that where a delay is the command's. Others follow by a polynomial."""
_FINEST = 5e-4
"""Physics step of all simulations at most [s], and half of the usual period: the step's error looks like a rate."""
_COARSE = 2.0 + 1e-6
"""Times that: a longer physics step may be one that made the recordings."""
_LEFT = 3e-5
"""Part of the score that the fit's derivatives may leave to gain with another period."""
_REFIT = LeastSquaresCfg(max_iteration=4, score_tolerance=_LEFT, near_enough=_LEFT)
_APART = 0.02
"""Part of a period by which a log's must exceed it to be another."""
UNEXPLAINED = 0.5
"""Part of what no candidate explains. One that is worse than the best by it is two standard deviations away."""
_HIDDEN = 1e-2
"""Part of the noise's variance in which an error of the model hides: noise is known no better."""
_NAMED = 2
"""Values that a sentence shows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopRates:
    """What the recordings say of the loops' period."""

    periods: tuple[float, ...]
    """Candidates, the longest first [s]."""
    values: np.ndarray
    """What a fit finds with each, physical (periods, size)."""
    likelihood: np.ndarray
    """Of each, (periods,); that of the best is 1."""
    assumed: float
    """The period that is used if the recordings do not show one [s]."""
    fitted: float
    """The period that was fitted with [s]."""

    @property
    def allowed(self) -> tuple[float, ...]:
        """Those that the recordings do not refute, the longest first: within two standard deviations of the best."""
        least = math.exp(-0.5 * SURE**2)
        return tuple(p for p, each in zip(self.periods, self.likelihood, strict=True) if each >= least)

    @property
    def weights(self) -> np.ndarray:
        """How probable each is, (periods,); their sum is 1.

        Before the recordings, all periods are alike. A candidate stands for those that are nearest to it.
        """
        ends = np.array([self.periods[0], *self.periods, self.periods[-1]])
        weights = self.likelihood * (ends[:-2] - ends[2:])
        return weights / weights.sum() if weights.any() else np.ones(len(self.periods))

    @property
    def chosen(self) -> float:
        """The fitted period where the recordings allow it, else the candidate that is nearest to the mean [s]."""
        mean = float(self.weights @ self.periods)
        return self.fitted if self.fitted in self.allowed else min(self.allowed, key=lambda each: abs(each - mean))

    @property
    def farthest(self) -> float:
        """The allowed period that is farthest from the chosen one [s]."""
        return max(self.allowed, key=lambda period: abs(period - self.chosen))

    def value_at(self, period: float) -> np.ndarray:
        """What a fit finds with a candidate, physical (size,)."""
        return self.values[self.periods.index(period)]

    @property
    def shares(self) -> np.ndarray:
        """How each candidate's values differ from those of the chosen one, as its likelihood counts, (periods, size).

        The sum of their squares is the variance of the values that comes from the rate.
        """
        return np.sqrt(self.weights)[:, None] * (self.values - self.value_at(self.chosen))

    def at(self, space: ParameterSpace, physical: np.ndarray) -> LoopRates:
        """The same about a result: the chosen period's values are the result's, and the others' as far away as here."""
        moved = self.values + (physical - self.value_at(self.chosen))
        return replace(self, values=np.clip(moved, space.lower.numpy(), space.upper.numpy()))

    def to_dict(self, space: ParameterSpace) -> dict[str, Any]:
        """For ``result.json``: the periods, and the values with the chosen one and the farthest from it."""
        ends = dict.fromkeys((self.chosen, self.farthest))
        return {
            **used_loop(self.assumed, self.chosen),
            "allowed_s": list(self.allowed),
            "parameters": {f"{period:g}": space.to_dict(torch.from_numpy(self.value_at(period))) for period in ends},
        }

    def sentences(self, space: ParameterSpace, known: np.ndarray) -> list[str]:
        """The warning about the rate.

        Args:
            known: Which of them have an error bar, (size,) bool.
        """
        used, other = self.chosen, self.farthest
        begin = "The loop rate of the drives is not stated (--drive_dt). "
        if len(self.allowed) == 1:
            begin += f"These recordings favour {_rate(used)}; the error bars include the others. "
            return [f"{begin}[W15]"]
        if used != self.assumed:
            slow, fast = self.allowed[0], self.allowed[-1]
            begin += f"These recordings allow {_rate(slow)} to {_rate(fast)}; {_rate(used)} is used. "
        change = self.value_at(other) - self.value_at(used)
        size = np.where(known, np.abs(change) / np.maximum(np.abs(self.value_at(used)), 1e-12), 0.0)
        shown = [
            f"{re.sub('[_.]', ' ', name)} of {key} is {self.value_at(used)[i]:.4g} with {_rate(used)} and "
            f"{self.value_at(other)[i]:.4g} with {_rate(other)}"
            for i in np.argsort(-size)[:_NAMED].tolist()
            for name, _, key in [space.labels[i].partition("/")]
        ]
        return [
            f"{begin}These recordings cannot separate {_rate(used)} and {_rate(other)}: {', '.join(shown)}. The error "
            "bars include the difference; a stated rate removes it. [W15]"
        ]


def _rate(period: float) -> str:
    return f"{1e-3 / period:.3g} kHz" if period else "a continuous loop"


def used_loop(assumed: float, used: float) -> dict[str, float]:
    """For ``result.json``: the period that was assumed, and the one that the values are of [s]."""
    return {"assumed_s": assumed, "used_s": used}


def loop_rates(
    problem: Problem, x: torch.Tensor, there: Jacobian, known: np.ndarray, phases: FreePhases | None = None
) -> LoopRates | None:
    """Compare the rates that the loops may have, at a fit with one of them.

    All are simulated with one physics step and fitted again, by the fit's derivatives as long as they serve. Each
    begins at the end of the one nearest to it, or, if that is better, where a later loop moves this end. Residuals and
    values between the shortest simulated periods follow by the polynomial through these. With r the residuals of a
    candidate and d = r - r' their difference to the best one's,

        χ² = (r·r - r'·r') d·d / (dᵀ Σ d)

    is what the recordings hold against it, Σ the covariance of the residuals. Its likelihood is exp(-χ² / 2). What the
    best candidate leaves above the noise, M, is no noise: roughness, or physics that is missing. The noise is an
    estimate, so M is at least a hundredth of it. So χ² is at most (2 (r·r - r'·r') / (M / 2))².

    Args:
        problem: What was fitted, with loops of an assumed rate.
        there: Its residuals, and derivatives there, on the training samples.
        known: Which parameters have an error bar, (size,) bool; the others stay.
        phases: What the residuals have taken out of free phases.

    Returns:
        What was found; ``None`` where the rate is stated, or none is better than the fit at its own, coarser physics
        step: then a simulation with that step has made the recordings.
    """
    if problem.assumed_loop is None or not known.any():
        return None
    control, fitted = problem.control_dt, problem.loop_dt
    logged = max(r.command_dt or 0.0 for r in problem.dataset.recordings)
    slower = [logged] if logged > (1 + _APART) * control else []
    fast = 0.0 if problem.delay_mode == "command" else _FAST  # a delayed torque needs a loop that holds it
    periods = sorted({control, fitted, *(p for p in (_USUAL, fast) if p < control), *slower}, reverse=True)
    finest = min(_FINEST, control / 2)
    ends: dict[float, _Refit] = {}
    for period in sorted(periods, key=lambda each: abs(each - fitted)):
        nearest = min(ends, key=lambda other: abs(other - period), default=fitted)
        begin = ends[nearest].x if ends else x
        end = _refitted(problem.with_loop(period, finest), problem, begin, period - nearest, there, phases)
        if end is not None:
            ends[period] = end
        elif period == fitted:
            return None
    coarse = float(there.residuals.score[0])
    if problem.physics_dt > _COARSE * finest and coarse <= min(end.score for end in ends.values()):
        return None
    found = {period: ends[period] for period in periods if period in ends}
    nodes = tuple(found)[-3:]
    between = [1 / f for f in _RATES if 1 / f < max(nodes) and 1 / f not in found] if len(nodes) > 1 else []
    candidates = tuple(sorted({*found, *between}, reverse=True))
    weights = np.zeros((len(candidates), len(found)))
    for row, period in zip(weights, candidates, strict=True):
        if period in found:
            row[tuple(found).index(period)] = 1.0
        else:
            row[-len(nodes) :] = _lagrange(nodes, period)
    values, errors = (np.stack([end.values for end in found.values()]), torch.stack([e.error for e in found.values()]))
    where = there.residuals.where
    chi2 = _against(errors, weights, where, noise_score(problem) * int(where.sum()))
    return LoopRates(
        periods=candidates,
        values=weights @ values,
        likelihood=np.exp(-0.5 * chi2),
        assumed=problem.assumed_loop,
        fitted=fitted,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Refit:
    """A fit with another period."""

    x: torch.Tensor
    """Normalised, (size,)."""
    score: float
    """On the training samples [rad²]."""
    values: np.ndarray
    """Physical, (size,)."""
    error: torch.Tensor
    """On the training samples, (K, R, n) [rad]."""


def _with_longer_period(evaluator: Evaluator, x: torch.Tensor, longer: float) -> torch.Tensor:
    """What a fit finds where a loop that holds its torque has a period that is longer by h [s], normalised (size,).

    Seen h / 2 later, the motion takes away kp h / 2 of viscous friction and kd h / 2 of armature, to first order.

    Args:
        evaluator: Of the problem.
        x: What it finds with the shorter period, normalised (size,).
    """
    env, space = evaluator.rollout(1).env, evaluator.space
    physical = space.to_physical(x)
    for name, gain in zip(("viscous_friction", "armature"), loop_gains(env, evaluator.dataset.recordings), strict=True):
        for joint, each in zip(env.scene["robot"].joint_names, gain.tolist(), strict=True):
            if (label := f"{name}/{joint}") in space.labels:
                physical[space.labels.index(label)] += each * longer / 2
    return space.to_normalised(physical.clamp(space.lower, space.upper))


def _refitted(
    other: Problem, problem: Problem, x: torch.Tensor, longer: float, there: Jacobian, phases: FreePhases | None
) -> _Refit | None:
    """A fit with another period, first by known derivatives; ``None`` where it diverges.

    Args:
        x: The end of a fit, normalised (size,).
        longer: By how much the other period is longer than that of this end [s].
        phases: What the residuals have taken out of free phases.
    """
    evaluator, space = other.evaluator_like(problem), problem.space
    evaluator.phases = phases
    starts = (x, _with_longer_period(evaluator, x, longer)) if longer else (x,)
    begins = [evaluator.residuals(space.to_physical(each)[None]) for each in starts]
    best = int(torch.cat([each.score for each in begins]).nan_to_num(nan=math.inf).argmin())
    x, begin = starts[best], begins[best]
    if not bool(begin.score.isfinite()):
        return None
    x, near, is_end = by_chords(evaluator, x, replace(there, residuals=begin), _LEFT)
    if not is_end:
        hessian, _ = near.normal_equations()
        x = least_squares(evaluator, [Descent(x=x, hessian=hessian)], _REFIT)[0].x
        near = replace(near, residuals=evaluator.residuals(space.to_physical(x)[None]))
    residuals = near.residuals
    return _Refit(x=x, score=float(residuals.score), values=space.to_physical(x).numpy(), error=residuals.error[0])


def _lagrange(nodes: Sequence[float], at: float) -> np.ndarray:
    """Weights of values at nodes in the value of the polynomial through them elsewhere, (nodes,)."""
    return np.array([math.prod((at - b) / (a - b) for b in nodes if b != a) for a in nodes])


def _against(errors: torch.Tensor, weights: np.ndarray, where: torch.Tensor, noise: float) -> np.ndarray:
    """χ² of each candidate against the best.

    Args:
        errors: Residuals at the simulated periods, (m, K, R, n).
        weights: Of these in each candidate's, (candidates, m).
        noise: Sum of squares that the noise alone leaves [rad²].
    """
    series = [
        errors[:, where[:, r], r, joint].numpy() for r in range(where.shape[1]) for joint in range(errors.shape[-1])
    ]
    gram = sum(each @ each.T for each in series)
    squares = np.einsum("cm,mn,cn->c", weights, gram, weights)
    best = int(squares.argmin())
    unexplained = max(squares[best] - noise, _HIDDEN * squares[best])
    result = np.zeros(len(weights))
    for c in range(len(weights)):
        apart = weights[c] - weights[best]
        variance = 0.0
        for each in series if c != best else ():
            d = (apart @ each)[None]
            variance += float((d * filtered(d, autocovariance(weights[best] @ each))).sum())
        if variance > 0:
            worse = squares[c] - squares[best]
            at_most = (SURE * worse / (UNEXPLAINED * unexplained)) ** 2
            result[c] = min(worse * float(apart @ gram @ apart) / variance, at_most)
    return result
