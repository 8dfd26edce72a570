"""Levenberg–Marquardt on rollout residuals of a whole robot, several starts and all trials in one batch."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from pace_optim.optimizers.jacobian import Colouring, Jacobian, jacobian, perturbed
from pace_optim.optimizers.levenberg_marquardt import (
    DAMPING_TRIALS,
    FIRST_DAMPING,
    LinearModel,
    next_damping,
    rows_of,
    trial_rows,
)
from pace_optim.optimizers.wide_derivatives import (
    first_directions,
    is_rough,
    jacobian_over,
    moved_along,
    principal_directions,
    probe,
)
from pace_optim.problem.evaluator import Evaluator, Residuals

_STALLED = 3
_CREEPING = 4
_GIVEN = 5
_NEAR = 1e-2
"""A step that is expected to lower the score by less than this part of it hardly changes the derivatives, ..."""
_KEPT = 0.5
"""and they are kept while steps gain this part of what is expected of them."""


@dataclass(kw_only=True)
class LeastSquaresCfg:
    """Settings of the refinement."""

    max_iteration: int = 40
    """Largest number of iterations."""

    score_tolerance: float = 1e-6
    """Stop when an iteration lowers the score by less than this part of it."""

    creep_tolerance: float = 1e-4
    """Stop when the score fell by less than this part of it in each of the last four iterations, on average."""

    step_tolerance: float = 1e-7
    """Stop when no normalised parameter moves by more than this."""

    target_score: float = 1e-16
    """Stop below this score [rad²]."""

    give_up_ratio: float = 100.0
    """A start whose score is this many times the best one's after a few iterations is dropped."""

    same_valley: float = 2e-2
    """A start that has come this near to the best one, in every normalised parameter, is dropped."""


@dataclass(kw_only=True, eq=False)
class Descent:
    """One start's way down."""

    x: torch.Tensor
    """Present normalised vector, (size,)."""
    score: float = np.inf
    """Its score [rad²]."""
    damping: float = FIRST_DAMPING
    """Levenberg–Marquardt damping, relative to the diagonal of JᵀJ."""
    jacobian: Jacobian | None = None
    """Residuals at x, and derivatives at ``jacobian_x``; ``None`` until they are known."""
    jacobian_x: torch.Tensor | None = None
    """Where the derivatives were taken, normalised (size,)."""
    directions: torch.Tensor | None = None
    """Where the motion is rough, the wide steps over which its next derivatives are taken, (size, size)."""
    jacobian_directions: torch.Tensor | None = None
    """Those over which the present ones were."""
    stop_reason: str | None = None
    iteration: int = 0
    stalled: int = 0
    """Iterations in a row that gained next to nothing."""
    scores: list[float] = field(default_factory=list)
    lost_jacobian: bool = False
    """Whether the Jacobian was known when the descent was written down."""

    @classmethod
    def restore(cls, checkpoint: Mapping[str, np.ndarray]) -> list[Descent]:
        """Descents as a run's checkpoint has them; their Jacobians are computed again."""
        scores = json.loads(str(checkpoint["descent_scores"]))
        known = [
            tuple(torch.as_tensor(one) if one.any() else None for one in both)
            for both in checkpoint["descent_directions"]
        ]
        return [
            cls(
                x=torch.as_tensor(x),
                score=float(score),
                damping=float(damping),
                stop_reason=str(stop) or None,
                iteration=int(iteration),
                stalled=int(stalled),
                scores=history,
                jacobian_x=torch.as_tensor(jacobian_x),
                directions=directions,
                jacobian_directions=jacobian_directions,
                lost_jacobian=bool(has_jacobian) and not stop,
            )
            for x, jacobian_x, (score, damping, iteration, stalled, has_jacobian), stop, history, (
                directions,
                jacobian_directions,
            ) in zip(
                checkpoint["descent_x"],
                checkpoint["descent_jacobian_x"],
                checkpoint["descent_state"],
                checkpoint["descent_stop"],
                scores,
                known,
                strict=True,
            )
        ]

    @property
    def is_fresh(self) -> bool:
        """Whether the derivatives are those at x."""
        return self.jacobian_x is not None and torch.equal(self.jacobian_x, self.x)

    def looks_around(self, trial: torch.Tensor, cfg: LeastSquaresCfg) -> bool:
        """Whether the derivatives at a trial step are worth simulating beside it: where much is expected of it."""
        return self.jacobian is None or (self.stalled == 0 and self.expected_gain(trial) >= _NEAR * self.score)

    def around(self, x: torch.Tensor, colouring: Colouring) -> tuple[torch.Tensor, torch.Tensor]:
        """Neighbours of x, (m, size), that tell its derivatives and whether the motion is rough, and their steps."""
        if self.directions is not None:
            return moved_along(x, self.directions, colouring)
        neighbours, step = perturbed(x, colouring)
        return torch.cat([neighbours, (x + probe(x))[None]]), step

    def look(self, x: torch.Tensor, residuals: Residuals, step: torch.Tensor, colouring: Colouring) -> None:
        """Take the derivatives at x from its residuals (row 0) and its neighbours'; none where the motion is rough.

        Then its neighbours are further away from there on.
        """
        self.jacobian_x, self.jacobian_directions = x.clone(), self.directions
        if self.directions is not None:
            self.jacobian = jacobian_over(residuals, step, colouring)
            self.directions = principal_directions(self.jacobian, x)
            return
        self.jacobian = jacobian(residuals, step, colouring)
        if is_rough(self.jacobian, residuals.error[1 + len(colouring.colours)], probe(x)):
            self.go_over_wide_steps(first_directions(len(x)))

    def go_over_wide_steps(self, directions: torch.Tensor) -> None:
        """Begin anew from here, with derivatives over wide steps."""
        self.jacobian, self.directions = None, directions
        self.damping, self.stalled, self.scores = FIRST_DAMPING, 0, [self.score]

    def trials(self) -> torch.Tensor:
        """Steps at several dampings, the favoured first, (trials, size)."""
        if self.jacobian is None:
            return self.x[None]
        return LinearModel(*self.jacobian.normal_equations()).trials(self.x, self.damping)

    def expected_gain(self, x: torch.Tensor) -> float:
        """How much lower the linear model has the score at x [rad²]."""
        if self.jacobian is None:
            return np.inf
        return LinearModel(*self.jacobian.normal_equations()).expected_gain(x - self.x)


def least_squares(
    evaluator: Evaluator,
    colouring: Colouring,
    starts: Sequence[torch.Tensor | Descent],
    cfg: LeastSquaresCfg | None = None,
    on_iteration: Callable[[list[Descent]], None] | None = None,
    where: torch.Tensor | None = None,
) -> list[Descent]:
    """Refine starts to the nearest minimum of the score.

    Each iteration simulates, in one batch, every start's trial steps at several dampings, and beside the favoured
    trial the perturbed vectors for its Jacobian: where the favoured trial wins, the next Jacobian is already there.
    Steps that are expected to gain little are tried without them, and the derivatives are kept as long as such steps
    gain (the chord method): near the end a step then costs as much as its trials.

    Args:
        evaluator: Simulates.
        colouring: Which entries are perturbed together.
        starts: Normalised vectors, (size,), or descents to go on with.
        cfg: Settings.
        on_iteration: Called with all descents after each iteration; it may raise KeyboardInterrupt to stop.
        where: Which samples count, (T, R) bool; ``None`` means those to train on.

    Returns:
        The descents, the best first.
    """
    cfg = cfg or LeastSquaresCfg()
    descents = [start if isinstance(start, Descent) else Descent(x=start.clamp(-1.0, 1.0).clone()) for start in starts]
    for descent in descents:
        if descent.lost_jacobian:
            with evaluator.again():
                _find_jacobian(descent, evaluator, colouring, where)
    while running := [d for d in descents if d.stop_reason is None]:
        batches, steps = [], []
        for descent in running:
            trials = descent.trials()
            neighbours, step = descent.around(trials[0], colouring)
            if not descent.looks_around(trials[0], cfg):
                neighbours = neighbours[:0]
            batches.append(rows_of(trials, neighbours))
            steps.append(step)
        every = evaluator.residuals(evaluator.space.to_physical(torch.cat(batches)), where)
        start = 0
        for descent, batch, step in zip(running, batches, steps, strict=True):
            _advance(descent, batch, every.rows(start, start + len(batch)), step, colouring, cfg)
            start += len(batch)
        _drop_hopeless(descents, cfg)
        if on_iteration is not None:
            on_iteration(descents)
    return sorted(descents, key=lambda d: d.score)


def _find_jacobian(descent: Descent, evaluator: Evaluator, colouring: Colouring, where: torch.Tensor | None) -> None:
    """Compute the Jacobian again, beside the descent's iterations."""
    seen = descent.x if descent.jacobian_x is None else descent.jacobian_x
    descent.directions = descent.jacobian_directions
    neighbours, step = descent.around(seen, colouring)
    batch = torch.cat([seen[None], neighbours, descent.x[None]])
    residuals = evaluator.residuals(evaluator.space.to_physical(batch), where)
    descent.look(seen, residuals.rows(0, len(batch) - 1), step, colouring)
    if descent.jacobian is not None:
        descent.jacobian = replace(descent.jacobian, residuals=residuals.rows(len(batch) - 1, len(batch)))
    descent.lost_jacobian = False


def _advance(
    descent: Descent,
    batch: torch.Tensor,
    residuals: Residuals,
    step: torch.Tensor,
    colouring: Colouring,
    cfg: LeastSquaresCfg,
) -> None:
    """Look around where the descent is, or take the best trial; say when it is time to stop.

    Args:
        descent: Changed in place.
        batch: Normalised vectors: the favoured trial, its neighbours (none before its last step), the other trials.
        residuals: Theirs.
        step: The neighbours' signed steps.
        colouring: Which entries were perturbed together.
        cfg: Settings.
    """
    descent.iteration += 1
    scores = residuals.score
    if descent.jacobian is None:  # the only trial is x itself
        if not np.isfinite(descent.score):
            descent.score = float(scores[0])
        descent.look(batch[0], residuals, step, colouring)
        descent.scores = descent.scores or [descent.score]
    else:
        rows = trial_rows(len(batch), len(DAMPING_TRIALS))
        best = int(scores[rows].argmin())
        gain = descent.score - float(scores[rows[best]])
        expected = descent.expected_gain(batch[0])
        descent.stalled = 0 if gain > cfg.score_tolerance * descent.score else descent.stalled + 1
        fresh, looked = descent.is_fresh, len(batch) > len(DAMPING_TRIALS)
        was_narrow = descent.directions is None
        if gain > 0:
            moved = float((batch[rows[best]] - descent.x).abs().max())
            descent.x, descent.score = batch[rows[best]].clone(), float(scores[rows[best]])
            descent.damping = next_damping(descent.damping, best)
            if descent.jacobian is not None and not looked:
                descent.jacobian = replace(descent.jacobian, residuals=residuals.rows(rows[best], rows[best] + 1))
            elif best == 0:  # its neighbours were simulated beside it
                descent.look(batch[0], residuals, step, colouring)
            else:
                descent.jacobian = None
            if moved < cfg.step_tolerance:
                descent.stop_reason = "converged"
        elif fresh:
            descent.damping = next_damping(descent.damping, None)
        if not fresh and gain < _KEPT * expected:
            descent.jacobian = None  # the derivatives are those of elsewhere: look around
        stands = expected < cfg.score_tolerance * descent.score or descent.stalled >= _STALLED
        descent.scores.append(descent.score)
        turned_rough = was_narrow and descent.directions is not None
        if turned_rough:
            descent.stop_reason = None
        elif stands or _creeps(descent.scores, cfg.creep_tolerance):
            if fresh:
                descent.stop_reason = "converged"
            else:  # look around before it ends
                descent.jacobian = None
    if descent.score <= cfg.target_score:
        descent.stop_reason = f"score below {cfg.target_score:g}"
    elif not np.isfinite(descent.score):
        descent.stop_reason = "diverged at its start"
    elif descent.stop_reason is None and descent.iteration >= cfg.max_iteration:
        descent.stop_reason = f"max_iteration {cfg.max_iteration}"


def _creeps(scores: Sequence[float], tolerance: float) -> bool:
    """Whether the score has all but stopped falling, as it does where friction makes it rough."""
    return len(scores) > _CREEPING and scores[-1 - _CREEPING] - scores[-1] < _CREEPING * tolerance * scores[-1]


def _drop_hopeless(descents: list[Descent], cfg: LeastSquaresCfg) -> None:
    """Stop starts that are far behind the best one after some iterations, or that have come down into its valley."""
    best = min(descents, key=lambda d: d.score)
    for descent in descents:
        if descent is best or descent.stop_reason is not None:
            continue
        begins = descent.iteration < _GIVEN
        if not begins and descent.score > cfg.give_up_ratio * best.score:
            descent.stop_reason = "another start is far better"
        elif (best.stop_reason is not None or not begins) and float((descent.x - best.x).abs().max()) < cfg.same_valley:
            descent.stop_reason = "another start is in the same valley"
