"""What a fit concludes from where its optimizers ended: values, error bars, warnings; all of it is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from pace_actuators.drive_result import ALL
from pace_actuators.text import plural
from pace_envs.task_source import EnvironmentRecord
from pace_optim.comparison.drive_loads import drive_loads
from pace_optim.estimate.derivatives import Jacobian
from pace_optim.estimate.error_bars.assessment import Assessment, assess, trajectories
from pace_optim.estimate.error_bars.consistency import Consistency, check_consistency
from pace_optim.estimate.error_bars.far_from_noise import FAR_ABOVE_NOISE, far_end, times_noise
from pace_optim.estimate.error_bars.loop_rate import LoopRates, loop_rates, used_loop
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.error_bars.undetermined import (
    DELAY,
    change_without_step,
    held_at_prior,
    step_share,
    undetermined,
    without_delay,
)
from pace_optim.estimate.error_bars.warnings import by_effect, fit_warnings, rough_motion
from pace_optim.estimate.least_squares import LeastSquaresCfg
from pace_optim.identification.optimization import NEAR, Optimization, Outcome
from pace_optim.problem.evaluator import Evaluator, Residuals
from pace_optim.problem.problem import Problem
from pace_optim.run.result import FitResult, make_result, rmse_by_joint
from pace_optim.run.summary import error_line

_LONG = 60.0
"""A fit that took longer prints its error before it is checked [s]."""
CHECKS_INTERRUPTED = "checks interrupted"
"""Stop reason of a result that was not checked to the end."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _End:
    """The vector that is kept, and what is known of it."""

    problem: Problem
    """What was fitted; with the rate of the drives' loops where the recordings show it."""
    at: Assessment
    """The vector, and what noise alone leaves open."""
    train_rmse: float
    """Where the optimizers ended [rad]."""
    times: float | None
    """The same as a multiple of the noise."""
    stop_reasons: tuple[str, ...]
    left_open: list[str] = field(default_factory=list)
    """Labels of what the recordings leave open: it is at its prior."""
    rates: LoopRates | None = None
    """What is known of the loops' rate where it is not stated."""
    without_step: torch.Tensor | None = None
    """How the motion would change without a physics step, (K, R, n) [rad]."""
    consistency: Consistency = field(default_factory=Consistency)

    @property
    def x(self) -> torch.Tensor:
        """The vector, normalised (size,)."""
        return self.at.x

    @property
    def jacobian(self) -> Jacobian:
        """On the training samples of the recordings that are trained on."""
        return self.at.jacobian

    @property
    def is_far(self) -> bool:
        """Whether that is so far above the noise that error bars mean nothing."""
        return self.times is not None and self.times >= FAR_ABOVE_NOISE

    @property
    def known(self) -> np.ndarray:
        """Which parameters have an error bar, (size,) bool."""
        return ~np.isnan(self.at.uncertainty.std)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Error bars that know what comes from the physics step and from the loops' rate, too."""
        result, shares = self.at.uncertainty, [] if self.rates is None else list(self.rates.shares)
        if self.without_step is not None:
            shares.append(step_share(self.jacobian, self.without_step, self.problem.space, self.x, self.known))
        for share in shares:
            result = result.with_step(np.where(self.known, share, np.nan))
        return result

    def moved(self, run: Optimization, x: torch.Tensor, held: Sequence[str] = ()) -> _End:
        """Another vector nearby, with some parameters held."""
        problem = self.problem
        at = self.at.moved(problem, *_evaluators(run, problem), x, held)
        train = _train_rmse(problem, at.residuals)
        return replace(self, at=at, train_rmse=train, times=times_noise(problem, train))


def conclude(
    run: Optimization, record: EnvironmentRecord, outcome: Outcome, keep_interrupted: bool = True
) -> FitResult:
    """Write the result, then check it, and add what each check finds.

    Args:
        keep_interrupted: Whether an interruption ends the checks; otherwise it is passed on. The file stays.
    """
    end = _reached(run, outcome)
    checks: Sequence[Callable[[Optimization, _End], _End]] = _CHECKS
    if outcome.is_interrupted:
        checks = (_silent_at_prior,)
    try:
        for check in checks:
            _write(run, record, end)
            if end.is_far and check not in _WHERE_FAR:
                continue
            end = check(run, end)
            if check is _with_step and run.progress.elapsed > _LONG:
                error = error_line(_result(run, record, end, checked=False))
                run.progress.tell(f"{error}. That was the fit; checks follow (Ctrl-C keeps the fit).")
    except KeyboardInterrupt:
        if not keep_interrupted:
            raise
        end = replace(end, stop_reasons=(*end.stop_reasons, CHECKS_INTERRUPTED))
    space = end.problem.space
    bias = space.to_physical(end.x)[space["encoder_bias"]].numpy()
    run.folder.write_json("drives.json", drive_loads(end.problem, _evaluators(run, end.problem)[0], bias))
    return _write(run, record, end, checked=True)


def _write(run: Optimization, record: EnvironmentRecord, end: _End, checked: bool = False) -> FitResult:
    """Write what is known so far; warnings that need simulations only where all has been checked."""
    run.folder.write_tensors("best_trajectory.pt", trajectories(end.problem, end.at.residuals))
    result = _result(run, record, end, checked)
    result.save(run.folder.path / "result.json")
    return result


def _result(run: Optimization, record: EnvironmentRecord, end: _End, checked: bool = True) -> FitResult:
    """What is known so far, as a run keeps it."""
    problem, data, settings, every = end.problem, end.problem.dataset, run.settings, end.at.residuals
    where = {"train": data.train[every.step], "validation": data.validation[every.step]}
    rmse = {name: rmse_by_joint(every, mask, problem.joint_names) for name, mask in where.items()}
    uncertainty = end.uncertainty
    physical = problem.space.to_physical(end.x)
    open_ = set(undetermined(problem, end.x, end.uncertainty, end.is_far)) - set(uncertainty.no_influence)
    unsure = [label for label in problem.space.labels if label in open_ and label not in end.left_open]
    rates = None if end.rates is None else end.rates.at(problem.space, physical.numpy())
    told = replace(uncertainty, indistinguishable=()) if end.is_far else uncertainty  # where correlations mean nothing
    stalled = f"no further progress, at {end.times or 0.0:,.0f} times the measurement noise"
    return make_result(
        problem,
        end.x,
        every,
        uncertainty,
        effects=problem.effects,
        environment=record.to_dict(),
        optimizer=settings.optimizer,
        seed=settings.seed,
        generations=run.optimizer.generation if run.optimizer else 0,
        simulated_steps=run.steps + end.consistency.simulated_steps,
        wall_time_s=run.progress.elapsed,
        stop_reasons=[stalled if end.is_far and reason == "converged" else reason for reason in end.stop_reasons],
        undetermined=end.left_open,
        times_noise=end.times,
        std_means_nothing=end.is_far,
        assumes_loop_rate=run.problem.assumes_loop_rate,
        loop_rate=_loop_rate(end.problem, rates),
        warnings=by_effect(
            [
                *far_end(end.times, end.train_rmse, settings.optimizer, problem.joint_types),
                *rough_motion(end.at.noise, float(end.jacobian.residuals.score[0])),
                *([] if rates is None else rates.sentences(problem.space, end.known)),
                *(fit_warnings(problem, physical, told, rmse, end.left_open, unsure) if checked else []),
                *end.consistency.sentences,
            ]
        ),
    )


def _loop_rate(problem: Problem, rates: LoopRates | None) -> dict[str, Any]:
    """What is known of the loops' rate; nothing where it is stated, or as assumed for want of a comparison."""
    if rates is not None:
        return rates.to_dict(problem.space)
    assumed, used = problem.assumed_loop, problem.loop_dt
    return {} if assumed in (None, used) else used_loop(assumed, used)


def _reached(run: Optimization, outcome: Outcome) -> _End:
    """Where the optimizers ended, with error bars."""
    problem = run.problem
    every, training = _evaluators(run, problem)
    at = assess(problem, every, run.colouring, outcome.x, run.ended, training)
    run.refuse_divergence(float(at.jacobian.residuals.score[0]))
    train = _train_rmse(problem, at.residuals)
    return _End(
        problem=problem,
        at=at,
        train_rmse=train,
        times=times_noise(problem, train),
        stop_reasons=tuple(outcome.stop_reasons),
    )


def _train_rmse(problem: Problem, every: Residuals) -> float:
    return rmse_by_joint(every, problem.dataset.train[every.step], problem.joint_names)[ALL]


def _evaluators(run: Optimization, problem: Problem) -> tuple[Evaluator, Evaluator]:
    """What simulates all recordings, and what simulates those that are trained on."""
    if problem is run.problem:
        return run.assessor, run.evaluator
    return problem.evaluator(), problem.training_evaluator()


def _with_loop_rate(run: Optimization, end: _End) -> _End:
    """Add what depends on an assumed loop rate; take another rate where only others fit."""
    if end.problem.assumes_loop_rate:
        run.progress.say("simulating other loop rates of the drives, as none is stated (--drive_dt)")
    rates = loop_rates(end.problem, end.x, end.jacobian, end.known, end.at.phases)
    if rates is None:
        return end
    end = replace(end, rates=rates)
    if rates.chosen == rates.fitted:
        return end
    x = end.problem.space.to_normalised(torch.from_numpy(rates.value_at(rates.chosen)))
    return replace(_reached(run, run.with_loop(end.problem, rates.chosen, x)), rates=rates)


def _with_step(run: Optimization, end: _End) -> _End:
    """Add the physics step's part of each error bar; halve the step where it makes much of the error."""
    while True:
        run.progress.say("simulating with a finer step, to measure the part of the step")
        there = end.jacobian.residuals
        change = change_without_step(end.problem, end.problem.space.to_physical(end.x), there, end.at.phases)
        outcome = None if end.is_far else run.at_half_the_step(end.problem, end.x, there, change)
        if outcome is None:
            return replace(end, without_step=change)
        end = replace(_reached(run, outcome), rates=end.rates)


def _with_prior(run: Optimization, end: _End) -> _End:
    """What the recordings leave open is put to its prior, and the rest fitted again."""
    return _at_prior(run, end, NEAR)


def _silent_at_prior(run: Optimization, end: _End) -> _End:
    """The same of what has no influence alone, which takes no fit."""
    return _at_prior(run, end, None)


def _at_prior(run: Optimization, end: _End, cfg: LeastSquaresCfg | None) -> _End:
    left_open = undetermined(end.problem, end.x, end.uncertainty, end.is_far)
    if not left_open:
        return end
    count = plural(len(left_open), "value")
    run.progress.say(f"fitting again with what the recordings do not determine at its prior: {count}")
    x, left_open = held_at_prior(end.problem, end.x, end.uncertainty, left_open, cfg)
    return replace(end.moved(run, x, left_open), left_open=left_open)


def _perhaps_without_delay(run: Optimization, end: _End) -> _End:
    """Set an insignificant delay to zero."""
    x = without_delay(end.problem, end.x, end.uncertainty, end.left_open, NEAR)
    return end if x is None else end.moved(run, x, [*end.left_open, DELAY])


def _consistent(run: Optimization, end: _End) -> _End:
    """Fit each recording alone, where there are several and the optimizer can afford it."""
    if not run.settings.check_consistency or run.settings.optimizer == "cmaes":
        return end
    every = end.at.residuals
    train = end.problem.dataset.train[every.step].repeat(1, 1 + every.with_torques) & every.where
    score = float(every.error[0].square()[train].sum(dim=1).mean())
    result = check_consistency(end.problem, end.x, score, run.progress.say, end.jacobian)
    if result.recordings:
        run.folder.write_json("consistency.json", asdict(result))
    return replace(end, consistency=result)


_CHECKS = (_with_loop_rate, _with_step, _with_prior, _perhaps_without_delay, _consistent)
"""What is checked of a result, in this order."""
_WHERE_FAR = (_silent_at_prior, _with_prior)
"""The same far above the noise: where physics is missing, recordings disagree, and that is the diagnosis' work."""
