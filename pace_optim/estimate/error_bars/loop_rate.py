"""The rate of the drives' loops where it is not stated: which ones the recordings allow, and what depends on it.

A loop that holds its torque over a period h sees the motion h / 2 late on average, which is kp h / 2 of viscous
friction and kd h / 2 of armature. A fit with a wrong rate finds these in its values, at nearly the same error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pace_optim.estimate.derivatives import Jacobian
from pace_optim.estimate.error_bars.far_from_noise import noise_score
from pace_optim.estimate.error_bars.uncertainty import SURE, autocovariance, filtered, inverse_of
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.terminal.parallel import parallel_map

_RATES = (1e3, 2e3, 4e3, 8e3)
"""Rates of servo drives' loops [Hz]. Faster ones are between the last and a continuous loop, a period of 0."""
_SIMULATED = (1e-3, 5e-4)
"""Periods that are simulated beside the assumed one and a continuous loop [s]; shorter ones follow by a polynomial."""
_FINER = 2
"""All are simulated with a physics step that is this part of the finest of them: the step's error looks like a rate."""
_COARSE = 2.0 + 1e-6
"""Times the finest of them: a longer physics step may be one that made the recordings."""
_CHORD_STEPS = 4
"""Gauss–Newton steps with the derivatives of the assumed rate, at most."""
_NOTHING_LEFT = 1e-5
"""They end where the next is expected to lower the score by less than this part of it."""
_APART = 0.02
"""Part of a period by which a log's must exceed it to be another."""
UNEXPLAINED = 0.5
"""Part of what no candidate explains. One that is worse than the best by it is two standard deviations away."""
_NAMED = 2
"""Values that a sentence shows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopRates:
    """What the recordings say of the loops' period."""

    periods: tuple[float, ...]
    """Candidates, the longest first [s]."""
    values: np.ndarray
    """What a fit finds with each, physical (periods, size)."""
    weights: np.ndarray
    """How likely each is, (periods,); their sum is 1."""
    assumed: float
    """The period that is taken where the recordings tell none [s]."""
    fitted: float
    """The period that was fitted with [s]."""

    @property
    def allowed(self) -> tuple[float, ...]:
        """Those that the recordings do not refute, the longest first: within two standard deviations of the best."""
        least = math.exp(-0.5 * SURE**2) * self.weights.max()
        return tuple(p for p, weight in zip(self.periods, self.weights, strict=True) if weight >= least)

    @property
    def chosen(self) -> float:
        """The fitted period where the recordings allow it, else the longest that they do [s]."""
        return self.fitted if self.fitted in self.allowed else self.allowed[0]

    def value_at(self, period: float) -> np.ndarray:
        """What a fit finds with a candidate, physical (size,)."""
        return self.values[self.periods.index(period)]

    @property
    def shares(self) -> np.ndarray:
        """How each candidate's values differ from those of the chosen one, as its likelihood counts, (periods, size).

        The sum of their squares is the variance of the values that comes from the rate.
        """
        return np.sqrt(self.weights)[:, None] * (self.values - self.value_at(self.chosen))

    def to_dict(self, space: ParameterSpace) -> dict[str, Any]:
        """For ``result.json``: the periods, and the values at both ends of what the recordings allow."""
        ends = dict.fromkeys((self.chosen, self.allowed[-1]))
        return {
            **used_loop(self.assumed, self.chosen),
            "allowed_s": list(self.allowed),
            "parameters": {f"{period:g}": space.to_dict(torch.from_numpy(self.value_at(period))) for period in ends},
        }

    def sentences(self, space: ParameterSpace, known: np.ndarray) -> list[str]:
        """The warning about the rate.

        Args:
            space: The parameters.
            known: Which of them have an error bar, (size,) bool.
        """
        slow, fast = self.chosen, self.allowed[-1]
        begin = "The loop rate of the drives is not stated (--drive_dt). "
        if len(self.allowed) == 1:
            begin += f"These recordings favour {_rate(slow)}; the error bars include the others. "
        elif slow != self.assumed:
            begin += f"These recordings allow {_rate(self.allowed[0])} to {_rate(fast)}; {_rate(slow)} is used. "
        if fast == slow:
            return [f"{begin}[W15]"]
        change = self.value_at(fast) - self.value_at(slow)
        size = np.where(known, np.abs(change) / np.maximum(np.abs(self.value_at(slow)), 1e-12), 0.0)
        shown = [
            f"{space.labels[i].split('/')[0].replace('_', ' ')} of {space.labels[i].split('/')[1]} is "
            f"{self.value_at(slow)[i]:.4g} with {_rate(slow)} and {self.value_at(fast)[i]:.4g} with {_rate(fast)}"
            for i in np.argsort(-size)[:_NAMED].tolist()
        ]
        return [
            f"{begin}These recordings cannot separate {_rate(slow)} and {_rate(fast)}: {', '.join(shown)}. The error "
            "bars include the difference; a stated rate removes it. [W15]"
        ]


def _rate(period: float) -> str:
    return f"{1e-3 / period:.3g} kHz" if period else "a continuous loop"


def used_loop(assumed: float, used: float) -> dict[str, float]:
    """For ``result.json``: the period that was assumed, and the one that the values are of [s]."""
    return {"assumed_s": assumed, "used_s": used}


def loop_rates(problem: Problem, x: torch.Tensor, there: Jacobian, known: np.ndarray) -> LoopRates | None:
    """Compare the rates that the loops may have, at a fit with one of them.

    All are simulated with one physics step, and fitted again by Gauss-Newton steps with the derivatives J of the
    fitted rate (the chord method). Residuals and values between the shortest simulated periods follow by the
    polynomial through these. A rate is not told by what was fitted alone: the residuals are those on all samples, also
    on those kept for validation. With r those of a candidate and d = r - r' their difference to the best one's,

        χ² = (r·r - r'·r') d·d / (dᵀ Σ d)

    is what the recordings hold against it, Σ the covariance of the residuals. Its likelihood is exp(-χ² / 2). What the
    best candidate leaves above the noise, M, is no noise: roughness, or physics that is missing. So χ² is at most
    (2 (r·r - r'·r') / (M / 2))².

    Args:
        problem: What was fitted, with loops of an assumed rate.
        x: The result, normalised (size,).
        there: Its residuals, and derivatives there, on the training samples.
        known: Which parameters have an error bar, (size,) bool; the others stay.

    Returns:
        What was found; ``None`` where the rate is stated, or none is better than the fit at its own, coarser physics
        step: then a simulation with that step has made the recordings.
    """
    if problem.assumed_loop is None or not known.any():
        return None
    control, fitted = problem.control_dt, problem.loop_dt
    logged = max(r.command_dt or 0.0 for r in problem.dataset.recordings)
    slower = [logged] if logged > (1 + _APART) * control else []
    continuous = [0.0] if problem.delay_mode == "command" else []  # a delayed torque needs a loop that holds it
    periods = sorted({control, fitted, *(p for p in _SIMULATED if p < control), *slower, *continuous}, reverse=True)
    finest = min(*_SIMULATED, control) / _FINER
    ends = parallel_map(
        lambda some: [_refitted(problem.with_loop(period, finest), x, there, known) for period in some], periods
    )
    found = {period: end for period, end in zip(periods, ends, strict=True) if end is not None}
    least = min((end.score for end in found.values()), default=math.inf)
    coarser = problem.physics_dt > _COARSE * _FINER * finest
    if fitted not in found or (coarser and float(there.residuals.score[0]) <= least):
        return None
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
    where = found[fitted].where
    chi2 = _against(errors, weights, where, noise_score(problem) * int(where.sum()))
    likelihood = np.exp(-0.5 * chi2)
    return LoopRates(
        periods=candidates,
        values=weights @ values,
        weights=likelihood / likelihood.sum(),
        assumed=problem.assumed_loop,
        fitted=fitted,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Refit:
    """A fit with another period."""

    values: np.ndarray
    """Physical, (size,)."""
    score: float
    """On the training samples [rad²]."""
    error: torch.Tensor
    """On all samples, (K, R, n) [rad]."""
    where: torch.Tensor
    """Which samples these are, (K, R) bool."""


def _refitted(problem: Problem, x: torch.Tensor, there: Jacobian, known: np.ndarray) -> _Refit | None:
    """The end of a few steps with known derivatives; ``None`` where a simulation diverges."""
    evaluator, free = problem.training_evaluator(), np.flatnonzero(known)
    hessian, _ = there.normal_equations()
    inverse = torch.from_numpy(inverse_of(hessian.numpy()[np.ix_(free, free)])[0])
    best: tuple[torch.Tensor, Residuals] | None = None
    for _ in range(1 + _CHORD_STEPS):
        residuals = evaluator.residuals(problem.space.to_physical(x)[None])
        score = float(residuals.score[0])
        if best is not None and not score < float(best[1].score[0]):
            break
        if not math.isfinite(score):
            return None
        best = x, residuals
        gradient = there.gradient_at(x, residuals.error[0])[free]
        step = -inverse @ gradient
        if -float(step @ gradient) < _NOTHING_LEFT * score:
            break
        x = x.clone()
        x[free] = (x[free] + step).clamp(-1.0, 1.0)
    if best is None:
        return None
    physical = problem.space.to_physical(best[0])
    every = problem.evaluator().residuals(physical[None], problem.dataset.sampled)
    score = float(best[1].score[0])
    return _Refit(values=physical.numpy(), score=score, error=every.error[0], where=every.where)


def _lagrange(nodes: Sequence[float], at: float) -> np.ndarray:
    """Weights of values at nodes in the value of the polynomial through them elsewhere, (nodes,)."""
    return np.array([math.prod((at - b) / (a - b) for b in nodes if b != a) for a in nodes])


def _against(errors: torch.Tensor, weights: np.ndarray, where: torch.Tensor, noise: float) -> np.ndarray:
    """χ² of each candidate against the best.

    Args:
        errors: Residuals at the simulated periods, (m, K, R, n).
        weights: Of these in each candidate's, (candidates, m).
        where: Which samples there are, (K, R) bool.
        noise: Sum of squares that the noise alone leaves [rad²].
    """
    series = [
        errors[:, where[:, r], r, joint].numpy() for r in range(where.shape[1]) for joint in range(errors.shape[-1])
    ]
    gram = sum(each @ each.T for each in series)
    squares = np.einsum("cm,mn,cn->c", weights, gram, weights)
    best = int(squares.argmin())
    unexplained = max(squares[best] - noise, 1e-6 * squares[best])
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
