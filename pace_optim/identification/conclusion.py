"""What a fit concludes from where its optimizers ended: values, error bars, warnings; all of it is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch

from pace_actuators.drive_result import ALL
from pace_envs.task_source import EnvironmentRecord
from pace_optim.comparison.drive_loads import drive_loads
from pace_optim.identification.optimization import NEAR, Optimization, Outcome
from pace_optim.optimizers.derivatives import Jacobian
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.run.result import FitResult, make_result, rmse_by_joint
from pace_optim.run.summary import summary
from pace_optim.uncertainty.assessment import Assessment, assess, trajectories
from pace_optim.uncertainty.consistency import Consistency, check_consistency
from pace_optim.uncertainty.honest_end import FAR_ABOVE_NOISE, far_end, times_noise
from pace_optim.uncertainty.step_share import change_without_step, change_without_steps, step_share
from pace_optim.uncertainty.uncertainty import Uncertainty
from pace_optim.uncertainty.undetermined import DELAY, held_at_prior, undetermined, without_delay
from pace_optim.uncertainty.warnings import fit_warnings, rough_motion

_LONG = 60.0
"""A fit that took longer tells its result before it is checked [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _End:
    """The vector that is kept, and what is known of it."""

    x: torch.Tensor
    """Normalised, (size,)."""
    uncertainty: Uncertainty
    residuals: Residuals
    """On all samples."""
    jacobian: Jacobian
    """On the training samples of the recordings that are trained on."""
    noise: float
    """The simulation's own noise [rad]."""
    left_open: list[str]
    """Labels of what the recordings leave open: it is at its prior."""
    train_rmse: float
    """Where the optimizers ended [rad]."""
    times: float | None
    """The same as a multiple of the noise."""
    without_steps: tuple[torch.Tensor, ...] = ()
    """How the motion would change without a physics step, and if drives held no torque either, (K, R, n) [rad]."""

    @property
    def is_far(self) -> bool:
        """Whether that is so far above the noise that error bars mean nothing."""
        return self.times is not None and self.times >= FAR_ABOVE_NOISE

    def moved(self, x: torch.Tensor, held: list[str], run: Optimization) -> _End:
        """Another vector, with some parameters held."""
        known = _known_at(run, x, held)
        end = replace(self, x=x, uncertainty=known.uncertainty, residuals=known.residuals, jacobian=known.jacobian)
        return end.with_step_share(run.problem.space)

    def with_step_share(self, space: ParameterSpace) -> _End:
        """With error bars that know what comes from the steps, where that is known."""
        known, result = ~np.isnan(self.uncertainty.std), self.uncertainty
        for change in self.without_steps:
            result = result.with_step(step_share(self.jacobian, change, space, self.x, known))
        return replace(self, uncertainty=result)


def conclude(run: Optimization, record: EnvironmentRecord, outcome: Outcome) -> FitResult:
    """Simulate the result once more on everything, with its derivatives, and write it down.

    Args:
        run: What has ended.
        record: Where its environment comes from.
        outcome: Where it ended.

    Raises:
        ValueError: If there the simulation diverges.
    """
    end = _reached(run, outcome)
    if not end.is_far and not outcome.is_interrupted:
        end = _told_of_step(run, end)
    if run.progress.elapsed > _LONG and not outcome.is_interrupted:
        run.progress.tell(*summary(_result(run, record, outcome, end)), "That was the fit; what follows checks it.")
    if left_open := undetermined(run.problem, end.x, end.uncertainty, end.is_far):
        end = _with_prior(run, outcome, end, left_open)
    if not end.is_far and not outcome.is_interrupted:
        end = _perhaps_without_delay(run, end)
    space, physical = run.problem.space, run.problem.space.to_physical(end.x)
    run.folder.write_tensors("best_trajectory.pt", trajectories(run.problem, end.residuals))
    drives = drive_loads(run.problem, run.assessor, physical[space["encoder_bias"]].numpy())
    run.folder.write_json("drives.json", drives)
    result = _result(run, record, outcome, end, _check_consistency(run, outcome, end))
    result.save(run.folder.path / "result.json")
    return result


def _result(
    run: Optimization, record: EnvironmentRecord, outcome: Outcome, end: _End, consistency: Consistency | None = None
) -> FitResult:
    """What is known so far, as a run keeps it."""
    problem, data, settings = run.problem, run.problem.dataset, run.settings
    every, consistency = end.residuals, consistency or Consistency()
    where = {"train": data.train[every.step], "validation": data.validation[every.step]}
    rmse = {name: rmse_by_joint(every, mask, problem.joint_names) for name, mask in where.items()}
    uncertainty = end.uncertainty
    physical = problem.space.to_physical(end.x)
    open_ = set(undetermined(problem, end.x, end.uncertainty, end.is_far)) - set(uncertainty.no_influence)
    unsure = [label for label in problem.space.labels if label in open_ and label not in end.left_open]
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
        simulated_steps=run.steps + consistency.simulated_steps,
        wall_time_s=run.progress.elapsed,
        stop_reasons=[
            f"stands still at {end.times:,.0f} times the noise" if end.is_far and reason == "converged" else reason
            for reason in outcome.stop_reasons
        ],
        undetermined=end.left_open,
        times_noise=end.times,
        std_means_nothing=end.is_far,
        warnings=[
            *far_end(end.times, end.train_rmse, settings.optimizer, problem.joint_types),
            *rough_motion(end.noise, float(end.jacobian.residuals.score[0])),
            *fit_warnings(problem, physical, uncertainty, rmse, end.left_open, unsure),
            *consistency.sentences,
        ],
    )


def _reached(run: Optimization, outcome: Outcome) -> _End:
    """Where the optimizers ended, with error bars."""
    problem, known = run.problem, _known_at(run, outcome.x)
    run.refuse_divergence(float(known.residuals.score[0]))
    train = rmse_by_joint(known.residuals, problem.dataset.train[known.residuals.step], problem.joint_names)[ALL]
    return _End(
        x=outcome.x,
        uncertainty=known.uncertainty,
        residuals=known.residuals,
        jacobian=known.jacobian,
        noise=known.noise,
        left_open=[],
        train_rmse=train,
        times=times_noise(problem, train),
    )


def _known_at(run: Optimization, x: torch.Tensor, held: Sequence[str] = ()) -> Assessment:
    return assess(run.problem, run.assessor, run.colouring, x, held, run.descents[-1] if run.descents else None)


def _told_of_step(run: Optimization, end: _End) -> _End:
    """What of each value comes from the physics step, and from that of the drives' loops where nobody stated it."""
    run.progress.say("simulating with a finer step, to tell what comes from the step")
    space = run.problem.space
    physical, there = space.to_physical(end.x), end.jacobian.residuals
    changes = [look(run.problem, physical, there) for look in (change_without_step, change_without_steps)]
    return replace(end, without_steps=tuple(c for c in changes if c is not None)).with_step_share(space)


def _with_prior(run: Optimization, outcome: Outcome, end: _End, left_open: list[str]) -> _End:
    """What the recordings leave open is put to its prior, and the rest fitted again."""
    run.progress.say(f"fitting again with what the recordings do not determine at its prior: {len(left_open)} values")
    cfg = None if outcome.is_interrupted else NEAR
    x, left_open = held_at_prior(run.problem, end.x, end.uncertainty, left_open, cfg)
    return replace(end.moved(x, left_open, run), left_open=left_open)


def _perhaps_without_delay(run: Optimization, end: _End) -> _End:
    """A delay that is none is put to none."""
    x = without_delay(run.problem, end.x, end.uncertainty, end.left_open, NEAR)
    return end if x is None else end.moved(x, [*end.left_open, DELAY], run)


def _check_consistency(run: Optimization, outcome: Outcome, end: _End) -> Consistency:
    """Fit each recording alone, where there are several and the optimizer can afford it."""
    wanted = run.settings.check_consistency and run.settings.optimizer != "cmaes"
    if not wanted or outcome.is_interrupted:
        return Consistency()
    train = run.problem.dataset.train[end.residuals.step]
    score = float(end.residuals.error[0].square()[train].sum(dim=1).mean())
    result = check_consistency(run.problem, end.x, score, run.progress.say, end.jacobian)
    if result.recordings:
        run.folder.write_json("consistency.json", asdict(result))
    return result
