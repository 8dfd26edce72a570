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
from pace_optim.estimate.error_bars.physics_step import change_without_step, step_share
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.error_bars.undetermined import DELAY, held_at_prior, undetermined, without_delay
from pace_optim.estimate.error_bars.warnings import by_effect, fit_warnings, rough_motion
from pace_optim.estimate.least_squares import LeastSquaresCfg
from pace_optim.estimate.own_objective import Objective, objective_error_bars, optimizer_class
from pace_optim.estimate.way_down import WayDown
from pace_optim.identification.optimization import NEAR, Optimization, Outcome
from pace_optim.problem.evaluator import Residuals
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

    way: WayDown
    """With the problem that was fitted: at the rate of the drives' loops where the recordings show it."""
    at: Assessment
    """The vector, and what noise alone leaves open."""
    stop_reasons: tuple[str, ...]
    left_open: list[str] = field(default_factory=list)
    """Labels of what the recordings leave open: it is at its prior."""
    rates: LoopRates | None = None
    """What is known of the loops' rate where it is not stated."""
    without_step: torch.Tensor | None = None
    """How the motion would change without a physics step, (K, R, n) [rad]."""
    consistency: Consistency = field(default_factory=Consistency)

    @property
    def problem(self) -> Problem:
        """What was fitted."""
        return self.way.problem

    @property
    def x(self) -> torch.Tensor:
        """The vector, normalised (size,)."""
        return self.at.x

    @property
    def jacobian(self) -> Jacobian:
        """On the training samples of the recordings that are trained on."""
        return self.at.jacobian

    @cached_property
    def rmse(self) -> dict[str, dict[str, float]]:
        """Errors of training and validation by joint [rad]."""
        return _rmse(self.problem, self.at.residuals)

    @cached_property
    def times(self) -> float | None:
        """That of training as a multiple of the noise."""
        return times_noise(self.problem, self.rmse["train"][ALL])

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

    def moved(self, x: torch.Tensor, held: Sequence[str] = ()) -> _End:
        """Another vector nearby, with some parameters held."""
        return replace(self, at=self.at.moved(self.way.assessor, self.way.evaluator, x, held))


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
    _write_drives(run, end.way, end.x, end.left_open)
    return _write(run, record, end, checked=True)


def _write(run: Optimization, record: EnvironmentRecord, end: _End, checked: bool = False) -> FitResult:
    """Write what is known so far; warnings that need simulations only where all has been checked."""
    run.folder.write_tensors("best_trajectory.pt", trajectories(end.problem, end.at.residuals))
    result = _result(run, record, end, checked)
    result.save(run.folder.path / "result.json")
    return result


def _write_drives(run: Optimization, way: WayDown, x: torch.Tensor, left_open: Sequence[str] = ()) -> None:
    space, physical = way.problem.space, way.problem.space.to_physical(x)
    known, bias = way.problem.as_found(space.to_dict(physical), left_open), physical[space["encoder_bias"]].numpy()
    run.folder.write_json("drives.json", drive_loads(known, way.assessor, bias))


def _of_run(run: Optimization, record: EnvironmentRecord) -> dict[str, Any]:
    """What a result says of its run."""
    return {
        "effects": run.problem.effects,
        "environment": record.to_dict(),
        "optimizer": run.settings.optimizer,
        "seed": run.settings.seed,
        "generations": run.optimizer.generation if run.optimizer else 0,
        "wall_time_s": run.progress.elapsed,
    }


def _rmse(problem: Problem, every: Residuals) -> dict[str, dict[str, float]]:
    """Errors of training and validation by joint, from the residuals on all samples [rad]."""
    where = {"train": problem.dataset.train[every.step], "validation": problem.dataset.validation[every.step]}
    return {name: rmse_by_joint(every, mask, problem.joint_names) for name, mask in where.items()}


def _result(run: Optimization, record: EnvironmentRecord, end: _End, checked: bool = True) -> FitResult:
    """What is known so far, as a run keeps it."""
    problem, every = end.problem, end.at.residuals
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
        **_of_run(run, record),
        simulated_steps=run.steps + end.consistency.simulated_steps,
        stop_reasons=[stalled if end.is_far and reason == "converged" else reason for reason in end.stop_reasons],
        undetermined=end.left_open,
        times_noise=end.times,
        std_means_nothing=end.is_far,
        assumes_loop_rate=problem.assumes_loop_rate,
        loop_rate=_loop_rate(end.problem, rates),
        warnings=by_effect(
            [
                *far_end(end.times, end.rmse["train"][ALL], run.settings.optimizer, problem.joint_types),
                *rough_motion(end.at.noise, float(end.jacobian.residuals.score[0])),
                *([] if rates is None else rates.sentences(problem.space, end.known)),
                *(fit_warnings(problem, physical, told, end.rmse, end.left_open, unsure) if checked else []),
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
    way, problem = run.way, run.problem
    at = assess(problem, way.assessor, outcome.x, run.ended, way.evaluator)
    run.refuse_divergence(float(at.jacobian.residuals.score[0]))
    return _End(way=way, at=at, stop_reasons=tuple(outcome.stop_reasons))


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
    return replace(_reached(run, run.with_loop(rates.chosen, x)), rates=rates)


def _with_step(run: Optimization, end: _End) -> _End:
    """Add the physics step's part of each error bar; halve the step where it makes much of the error."""
    while True:
        run.progress.say("simulating with a finer step, to measure the part of the step")
        there = end.jacobian.residuals
        change = change_without_step(end.problem, end.problem.space.to_physical(end.x), there, end.at.phases)
        outcome = None if end.is_far else run.at_half_the_step(end.x, there, change)
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
    return replace(end.moved(x, left_open), left_open=left_open)


def _perhaps_without_delay(run: Optimization, end: _End) -> _End:
    """Set an insignificant delay to zero."""
    x = without_delay(end.problem, end.x, end.uncertainty, end.left_open, NEAR)
    return end if x is None else end.moved(x, [*end.left_open, DELAY])


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


def conclude_own(run: Optimization, record: EnvironmentRecord, outcome: Outcome) -> FitResult:
    """Evaluate the user's own objective at its best candidate, with its error bars, and write it down.

    Positions are simulated and compared too: the errors of ``rmse`` are theirs. Nothing is refined, held at a prior or
    fitted again, since least squares minimise another objective.
    """
    way, problem, x = run.way, run.problem, outcome.x
    run.progress.say("error bars of the objective")
    objective = Objective(optimizer_class(run.settings.optimizer), problem)
    physical, validation = problem.space.to_physical(x), problem.dataset.validation
    every = objective.residuals(way.assessor, physical)
    run.refuse_divergence(float(every.score[0]))
    uncertainty, score = objective_error_bars(objective, way.evaluator, x)
    held_out = float(objective.errors(way.assessor, physical[None], validation).sum()) if validation.any() else None
    run.folder.write_tensors("best_trajectory.pt", trajectories(problem, every))
    _write_drives(run, way, x)
    rmse = _rmse(problem, every)
    times = times_noise(problem, rmse["train"][ALL])
    unsure = [label for label in undetermined(problem, x, uncertainty) if label not in uncertainty.no_influence]
    result = make_result(
        problem,
        x,
        every,
        uncertainty,
        **_of_run(run, record),
        objective={"train": score, "validation": held_out},
        simulated_steps=run.steps,
        stop_reasons=outcome.stop_reasons,
        times_noise=times,
        warnings=by_effect([*_other_objective(times), *fit_warnings(problem, physical, uncertainty, rmse, (), unsure)]),
    )
    result.save(run.folder.path / "result.json")
    return result


def _other_objective(times: float | None) -> list[str]:
    """A warning where the positions are far above the noise."""
    if times is None or times < FAR_ABOVE_NOISE:
        return []
    return [
        f"The positions of this minimum are {times:,.0f} times the measurement noise away from the recording: the "
        "objective differs from the position error. Compare with a fit without --optimizer. [W19]"
    ]
