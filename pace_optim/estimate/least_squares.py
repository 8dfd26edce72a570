"""Levenberg–Marquardt on rollout residuals of a whole robot, inside the bounds.

An iteration looks around x, which gives J, H = JᵀJ, g = Jᵀr and the simulation's noise (``derivatives``), and tries
steps at several dampings (``levenberg_marquardt``). A look costs as many simulations as a tree has parameters, a step a
few: so the iteration goes on with the same J, and g = Jᵀr of its best trial, as long as that pays (Shamanskii's method;
Ortega and Rheinboldt, 1970, 10.2). J may be of a longer physics step than r: it says where to go, r how far that is
good. H, g and x are all that the next one needs: a descent that is resumed is the one
that was interrupted, bit for bit.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch

from pace_actuators.files import checked
from pace_optim.estimate.derivatives import NOISE_ROWS, Jacobian, stencil
from pace_optim.estimate.levenberg_marquardt import DAMPING_TRIALS, FIRST_DAMPING, LinearModel, next_damping
from pace_optim.problem.evaluator import Evaluator, Residuals

ROUGH = 0.05
"""Part of the error from which on the simulation's own noise is notable."""
_CREEPING = 3
_REFUSED = 2
_FEW = DAMPING_TRIALS[:2]
"""Dampings of steps with derivatives of another vector: they are small."""
_CHORDS, _SLIGHT = 5, 1e-6
"""Such steps at most where there are no others, and the damping of the first."""
_AS_EXPECTED = 0.5
"""Part of the expected gain that a step must bring for J to serve for another."""


@dataclass(kw_only=True)
class LeastSquaresCfg:
    """When a descent ends."""

    max_iteration: int = 40
    """Largest number of iterations."""

    score_tolerance: float = 1e-6
    """Stop when less than this part of the score is left to gain, by the linear model. Where the score is k² times that
    of the noise, k² times as much: what is left to gain is then small against what is missing."""

    loosest_tolerance: float = 5e-3
    """The largest such part."""

    creep_tolerance: float = 1e-4
    """Stop when the score fell by less than this part of it in each of the last three iterations, on average."""

    near_enough: float = 2e-3
    """A descent by derivatives of a longer physics step ends when an iteration lowers the score by less than this part
    of it: the look for the error bars takes the rest. A rough simulation goes on with derivatives at the fit's step.
    Where the score is k² times that of the noise, k² times as much, and derivatives of any step."""

    loosest_enough: float = 2e-3
    """The largest such part."""

    target_score: float = 1e-16
    """Stop below this score [rad²]."""

    noise_score: float = 0.0
    """Score that the measurement's noise alone leaves [rad²]."""

    give_up_ratio: float = 100.0
    """Stop, from the fifth iteration on, a start whose score is this many times that of a start before it."""

    same_valley: float = 2e-2
    """Stop a start that has come this near to the end of one before it, in every normalised parameter."""

    def tolerance(self, score: float) -> float:
        """The part of a score that may be left to gain."""
        return self._grown(self.score_tolerance, score, self.loosest_tolerance)

    def enough(self, score: float) -> float:
        """The part of a score that an iteration by derivatives of a longer step must gain."""
        return self._grown(self.near_enough, score, self.loosest_enough)

    def _grown(self, part: float, score: float, most: float) -> float:
        """A part that grows as the score stands above the noise."""
        above = score / self.noise_score if self.noise_score > 0 else 1.0
        return max(part, min(part * above, most))


@dataclass(kw_only=True)
class DescentState:
    """The plain numbers of a descent."""

    stage: str = ""
    """Of which stage of a fit it is."""
    damping: float = FIRST_DAMPING
    """Levenberg–Marquardt damping, relative to the diagonal of JᵀJ."""
    noise: float = 0.0
    """The simulation's own noise where it was looked last [rad]."""
    stop_reason: str = ""
    """Why it has ended; empty: it has not."""
    iteration: int = 0
    refused: int = 0
    """Iterations in a row in which no trial was better."""
    own_step: bool = False
    """Whether derivatives take the fit's own physics step, where there is a longer one."""
    simulations: int = 0
    """Vectors simulated."""
    scores: list[float] = field(default_factory=list)
    """The score at the start and after each iteration [rad²]; empty until it is known, and where it is not finite."""

    @property
    def score(self) -> float:
        """The present score [rad²]; infinite where none is known."""
        return self.scores[-1] if self.scores else math.inf


@dataclass(kw_only=True, eq=False)
class Descent(DescentState):
    """One start's way down."""

    x: torch.Tensor
    """Present normalised vector, (size,)."""
    hessian: torch.Tensor | None = None
    """JᵀJ where it was looked last, (size, size)."""
    gradient: torch.Tensor | None = None
    """Jᵀr at x, (size,); ``None``: look around first."""
    jacobian: Jacobian | None = None
    """J at x where it is at hand, for the next iteration alone; no part of a checkpoint."""

    @classmethod
    def restore(cls, checkpoint: Mapping[str, np.ndarray]) -> list[Descent]:
        """Descents as :func:`checkpoint_of` has them."""
        states = [
            checked(DescentState, each, "descents", "Start a new fit.")
            for each in json.loads(str(checkpoint["descents"]))
        ]
        known = zip(checkpoint["descent_x"], checkpoint["descent_hessian"], checkpoint["descent_gradient"], strict=True)
        return [
            cls(
                **vars(state),
                x=torch.as_tensor(x),
                hessian=torch.as_tensor(hessian) if hessian.any() else None,
                gradient=None if np.isnan(gradient).any() else torch.as_tensor(gradient),
            )
            for state, (x, hessian, gradient) in zip(states, known, strict=True)
        ]

    def look(self, evaluator: Evaluator) -> tuple[torch.Tensor, torch.Tensor, Jacobian | None]:
        """H and g at x; where they are not known, they, the noise and J are taken."""
        renewed = evaluator.look_at_phases(evaluator.space.to_physical(self.x), anew=True)
        if self.hessian is not None and self.gradient is not None:
            return self.hessian, self.gradient, self.jacobian
        around = stencil(self.x, evaluator.colouring, self.hessian, self.noise, self.score)
        vectors = torch.cat([self.x[None], around.vectors])
        here, residuals = evaluator.look_around(evaluator.space.to_physical(vectors), own_step=self.own_step)
        self.simulations += len(vectors)
        score = float(here.score[0])
        if not self.scores and math.isfinite(score):
            self.scores = [score]
        elif renewed and math.isfinite(score):  # by what is known of phases here
            self.scores[-1] = score
        self.noise = around.noise(residuals)
        jacobian = replace(around.jacobian(residuals), residuals=here)
        self.hessian, self.gradient = jacobian.normal_equations()
        return self.hessian, self.gradient, jacobian


def checkpoint_of(descents: Sequence[Descent]) -> dict[str, np.ndarray]:
    """All that :meth:`Descent.restore` needs, as arrays."""
    size = len(descents[0].x) if descents else 0
    states = [{each.name: getattr(d, each.name) for each in fields(DescentState)} for d in descents]
    nothing, unknown = np.zeros((size, size)), np.full(size, np.nan)
    hessians = [nothing if d.hessian is None else d.hessian.numpy() for d in descents]
    gradients = [unknown if d.gradient is None else d.gradient.numpy() for d in descents]
    return {
        "descents": np.array(json.dumps(states)),
        "descent_x": np.array([d.x.numpy() for d in descents]).reshape(len(descents), size),
        "descent_hessian": np.array(hessians).reshape(len(descents), size, size),
        "descent_gradient": np.array(gradients).reshape(len(descents), size),
    }


def least_squares(
    evaluator: Evaluator,
    starts: Sequence[torch.Tensor | Descent],
    cfg: LeastSquaresCfg | None = None,
    on_iteration: Callable[[list[Descent]], None] | None = None,
) -> list[Descent]:
    """Refine starts, one after the other, to the nearest minimum of the score.

    Args:
        starts: Normalised vectors, (size,), or descents to go on with.
        on_iteration: Called with all descents after each iteration; it may raise KeyboardInterrupt to stop.

    Returns:
        The descents, the best first.
    """
    cfg = cfg or LeastSquaresCfg()
    descents = [start if isinstance(start, Descent) else Descent(x=start.clamp(-1.0, 1.0).clone()) for start in starts]
    for i, descent in enumerate(descents):
        while not descent.stop_reason:
            _iterate(descent, evaluator, cfg)
            _give_up(descent, descents[:i], cfg)
            if on_iteration is not None:
                on_iteration(descents)
    return sorted(descents, key=lambda d: d.score)


def _iterate(descent: Descent, evaluator: Evaluator, cfg: LeastSquaresCfg) -> None:
    """Look around if x has moved, try steps, take the best, and say when it is time to stop."""
    blind = descent.hessian is None
    hessian, gradient, jacobian = descent.look(evaluator)
    descent.jacobian = None
    if not descent.scores:
        descent.stop_reason = "diverged at its start"
        return
    if descent.score <= cfg.target_score:
        descent.stop_reason = f"score below {cfg.target_score:g}"
        return
    descent.iteration += 1
    descent.scores.append(descent.score)
    step = Step(descent, hessian, gradient)
    left, allowed = step.expected, cfg.tolerance(descent.score) * descent.score
    steps = 1 if jacobian is None else 1 + (len(evaluator.colouring.colours) + 1 + NOISE_ROWS) // len(step.trials)
    for _ in range(steps):
        gain, residuals = step.take(evaluator)
        if jacobian is None or gain < _AS_EXPECTED * step.expected or descent.score <= cfg.target_score:
            break
        step = Step(descent, hessian, jacobian.gradient_at(descent.x, residuals.error[0]), _FEW)
        if step.expected <= allowed:
            break
    gained = descent.scores[-2] - descent.scores[-1]
    longer = jacobian is not None and evaluator.looks_coarser and not descent.own_step
    enough = cfg.enough(descent.score)
    far = enough > cfg.near_enough
    beside = (longer or far) and gained <= enough * descent.score
    if beside and not far and descent.noise >= ROUGH * descent.score**0.5 and descent.iteration < cfg.max_iteration:
        descent.own_step, descent.damping = True, FIRST_DAMPING
        descent.gradient, descent.refused = None, 0
        return
    if gained > 0:
        descent.gradient, descent.refused = None, 0
    else:
        descent.refused += 1
        if blind:  # the derivatives were those of a first look
            descent.gradient = None
    if descent.score <= cfg.target_score:
        descent.stop_reason = f"score below {cfg.target_score:g}"
    elif not blind and (left <= allowed or beside or descent.refused >= _REFUSED or _creeps(descent.scores, cfg)):
        descent.stop_reason = "converged"
    elif descent.iteration >= cfg.max_iteration:
        descent.stop_reason = f"max_iteration {cfg.max_iteration}"


class Step:
    """Trials of one step of a descent, at several dampings."""

    def __init__(
        self,
        descent: Descent,
        hessian: torch.Tensor,
        gradient: torch.Tensor,
        dampings: Sequence[float] = DAMPING_TRIALS,
    ):
        model = LinearModel(hessian, gradient)
        self.descent = descent
        self.trials = model.trials(descent.x, descent.damping, dampings)
        self.expected = model.expected_gain(self.trials[0] - descent.x)
        """What the first of them gains where J is right [rad²]."""

    def take(self, evaluator: Evaluator) -> tuple[float, Residuals]:
        """Simulate them and go to the best; returns what was gained [rad²] and the best's residuals, m = 1."""
        descent = self.descent
        residuals = evaluator.residuals(evaluator.space.to_physical(self.trials))
        descent.simulations += len(self.trials)
        scores = residuals.score
        best = int(scores.argmin())
        gain = descent.score - float(scores[best])
        if gain > 0:
            descent.x, descent.scores[-1] = self.trials[best].clone(), float(scores[best])
        descent.damping = next_damping(descent.damping, best if gain > 0 else None)
        return gain, residuals.rows(best, best + 1)


def by_chords(
    evaluator: Evaluator, x: torch.Tensor, there: Jacobian, tolerance: float = LeastSquaresCfg.score_tolerance
) -> tuple[torch.Tensor, Jacobian, bool]:
    """Steps with known derivatives, as long as they gain what these promise.

    Args:
        there: Residuals at x, and derivatives near it.
        tolerance: The part of the score that a step gains at least.

    Returns:
        Where they lead, the residuals there with these derivatives, and whether that is an end: by the derivatives,
        less than the tolerance is left to gain.
    """
    descent = Descent(x=x, damping=_SLIGHT, scores=[float(there.residuals.score[0])])
    hessian, gradient = there.normal_equations()
    for _ in range(_CHORDS):
        step = Step(descent, hessian, gradient, _FEW)
        if step.expected <= tolerance * descent.score:
            return descent.x, there, True
        gained, residuals = step.take(evaluator)
        if gained > 0:
            there = replace(there, residuals=residuals)
            gradient = there.gradient_at(descent.x, residuals.error[0])
        if gained < _AS_EXPECTED * step.expected:
            break
    return descent.x, there, False


def _creeps(scores: Sequence[float], cfg: LeastSquaresCfg) -> bool:
    """Whether the score has all but stopped falling, as it does where friction makes it rough."""
    tolerance = max(cfg.creep_tolerance, cfg.tolerance(scores[-1]))
    return len(scores) > _CREEPING and scores[-1 - _CREEPING] - scores[-1] < _CREEPING * tolerance * scores[-1]


def _give_up(descent: Descent, before: Sequence[Descent], cfg: LeastSquaresCfg) -> None:
    """Stop a start that has come into the valley of one before it, or stays far above it."""
    if descent.stop_reason or not before:
        return
    best = min(before, key=lambda d: d.score)
    if descent.iteration >= 5 and descent.score > cfg.give_up_ratio * best.score:
        descent.stop_reason = "another start is far better"
    elif any(float((descent.x - other.x).abs().max()) < cfg.same_valley for other in before):
        descent.stop_reason = "another start is in the same valley"
