"""A fit from settings to a run's folder: load, search, refine, assess, write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pace_actuators.effects import effect_modules
from pace_envs import load_env_cfg
from pace_envs.task_source import EnvironmentRecord
from pace_optim.comparison.drive_loads import drive_loads
from pace_optim.optimizers.cmaes_optimizer import CMAESOptimizer
from pace_optim.optimizers.jacobian import Jacobian, colour
from pace_optim.optimizers.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.optimizers.other_starts import other_valleys, scattered
from pace_optim.optimizers.refine import BEGINNING, COARSE, refine
from pace_optim.optimizers.search import RefiningPays, agree_to_stop, search
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.problem import Problem, as_vector
from pace_optim.problem.processes import Processes
from pace_optim.problem.try_out import check_size, try_out
from pace_optim.report import check_folder, write_report
from pace_optim.run.folder import RunFolder
from pace_optim.run.history import History
from pace_optim.run.inputs import (
    check_same_configuration,
    check_unchanged,
    input_digests,
    recording_digests,
    with_absolute_paths,
)
from pace_optim.run.open import Run, problem_of
from pace_optim.run.result import FitResult, make_result, rmse_by_joint
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensorboard_log import TensorBoardLog
from pace_optim.run.tensors import read_bounds
from pace_optim.terminal.progress import ProgressLine
from pace_optim.uncertainty.assessment import assess, trajectories
from pace_optim.uncertainty.consistency import Consistency, check_consistency
from pace_optim.uncertainty.honest_end import FAR_ABOVE_NOISE, far_end, times_noise
from pace_optim.uncertainty.other_solutions import with_other_solutions
from pace_optim.uncertainty.undetermined import DELAY, held_at_prior, undetermined, without, without_delay
from pace_optim.uncertainty.warnings import fit_warnings

_HYBRID_POPULATION = 48
"""Candidates per generation of the hybrid's search: enough for a tree's dozen parameters, cheap enough to end soon."""

_SCATTERED = 2
"""Of the other starts that are tried where the first one ended far above the noise, those anywhere in the bounds."""

_NEAR = LeastSquaresCfg(score_tolerance=0.02)
"""For a vector that is known to be near the best."""


def fit(
    settings: FitSettings,
    progress: ProgressLine | None = None,
    before: Run | None = None,
    on_start: Callable[[Path], None] = lambda _: None,
    assess_interrupted: bool = True,
    processes: Processes | None = None,
) -> tuple[FitResult, Path]:
    """Identify a robot.

    Args:
        settings: What to fit, and how; its task and effects are known (:func:`pace_envs.task_source.use_task`).
        progress: Shows how far it is.
        before: The run whose robot is fitted anew, if there is one.
        on_start: Gets the run's folder before the first simulation.
        assess_interrupted: Whether an interrupted fit still assesses and writes the best so far; otherwise the
            interruption is passed on at once, and the folder has what ``resume`` needs.
        processes: Who shares the search's candidates; this one writes, the others call :func:`help_fit`.

    Returns:
        The result and the run's folder.

    Raises:
        ValueError: If anything does not fit; nothing has been written then.
    """
    if before is None:
        env_cfg, place = load_env_cfg(settings.task), None
    else:
        env_cfg, place = before.load_cfg(), before.record.folder
    problem = _load(settings, env_cfg)
    settings = with_absolute_paths(settings, env_cfg)
    record = EnvironmentRecord.of(settings.task, problem.env_cfg, effect_modules(problem.effects), place)
    digests, inputs = recording_digests(settings), input_digests(settings, record)
    folder = RunFolder.create(settings.log_dir, problem.env_cfg.sim2real.robot_name)
    folder.write_start(settings.to_dict(), digests, problem, inputs=inputs, environment=record.to_dict())
    on_start(folder.path)
    run = _Fit(settings, problem, folder, progress or ProgressLine(), record, processes)
    return run.run(assess_interrupted)


def resume(
    path: str | Path,
    max_iteration: int | None = None,
    progress: ProgressLine | None = None,
    task: str | None = None,
    device: str | None = None,
    processes: Processes | None = None,
) -> tuple[FitResult, Path]:
    """Go on with an interrupted fit; the result is that of one that was never interrupted.

    Args:
        path: The run's folder.
        max_iteration: Another largest number of generations.
        progress: Shows how far it is.
        task: Where the run's environment is found now, if it has been moved.
        device: Where the search simulates; ``None``: as before.
        processes: As for :func:`fit`.

    Raises:
        ValueError: If the run cannot be resumed, or anything that it was started with has changed.
    """
    settings, _ = FitSettings.load(Path(path) / "settings.json")
    folder = RunFolder(Path(path))
    checkpoint = folder.read_checkpoint()
    read_bounds(folder.path)
    if (folder.path / "result.json").exists():  # of a fit that had ended: its report is made of more
        check_folder(folder.path)
    before = Run.open(folder.path, task)
    check_unchanged(before)
    settings = before.settings if max_iteration is None else replace(before.settings, max_iteration=max_iteration)
    if device is not None:
        settings = replace(settings, device=device)
    problem = _load(settings, before.load_cfg())
    check_same_configuration(before, problem)
    run = _Fit(settings, problem, folder, progress or ProgressLine(), before.record, processes)
    run.restore(checkpoint)
    return run.run()


def help_fit(processes: Processes, device: str, path: str | None = None, task: str | None = None) -> None:
    """Simulate this process's share of the search's candidates, for the process that fits and writes.

    Args:
        processes: All of them.
        device: Where this one simulates.
        path: The run's folder, if it is resumed.
        task: As for :func:`resume`.

    Raises:
        ValueError: If another process is lost, or there is nothing here of what it fits.
    """
    start: Any = processes.agree(None)
    if start is None:
        return
    settings, history, line_generation = start
    settings = replace(settings, device=device)
    problem = _load(settings, load_env_cfg(settings.task) if path is None else Run.open(Path(path), task).load_cfg())
    searcher = make_searcher(problem.for_search(device), settings)
    optimizer = make_optimizer(problem, settings, processes)
    optimizer.restore(history, line_generation)
    search(optimizer, searcher.rollout(optimizer.num_shown), lambda _: agree_to_stop(optimizer, processes))


def search_population(problem: Problem, settings: FitSettings) -> int:
    """Candidates in a generation; a hybrid takes all of ``num_envs`` on a GPU alone."""
    population = max(4, settings.num_envs // len(problem.dataset.trained()))
    is_small = settings.optimizer == "hybrid" and settings.device == "cpu"
    return min(population, _HYBRID_POPULATION) if is_small else population


def make_optimizer(problem: Problem, settings: FitSettings, processes: Processes) -> CMAESOptimizer:
    """The search of a fit."""
    return CMAESOptimizer(
        problem.space,
        search_population(problem, settings),
        problem.env_cfg.sim2real.cmaes,
        trees=problem.trees,
        seed=settings.seed,
        start=problem.space.start,
        processes=processes,
    )


def make_searcher(problem: Problem, settings: FitSettings) -> Evaluator:
    """What scores the candidates of a search: the hybrid's only has to find the valley, for which a part is enough."""
    if settings.optimizer == "hybrid":
        problem = problem.on_beginnings(BEGINNING)
    return problem.training_evaluator()


def _load(settings: FitSettings, env_cfg: Any) -> Problem:
    both = {Path(name).resolve() for name in settings.data} & {Path(name).resolve() for name in settings.validation}
    if both:
        raise ValueError(f"{both.pop()} is named by --data and --validation: what is trained on validates nothing.")
    problem = problem_of(settings, env_cfg)
    cmaes = problem.env_cfg.sim2real.cmaes
    chosen = {
        name: value for name in ("max_iteration", "epsilon", "sigma") if (value := getattr(settings, name)) is not None
    }
    problem.env_cfg.sim2real.cmaes = replace(
        cmaes,
        per_tree=cmaes.per_tree and not settings.joint_strategy,
        save_optimization_process=cmaes.save_optimization_process or settings.save_optimization_process,
        **chosen,
    )
    if problem.dataset.num_recordings * 4 > settings.num_envs and settings.optimizer == "cmaes":
        raise ValueError(
            f"--num_envs {settings.num_envs} is too few for {problem.dataset.num_recordings} recordings: expected at "
            f"least {4 * problem.dataset.num_recordings}, 4 candidates on each recording."
        )
    if not bool((problem.space.upper > problem.space.lower).any()):
        raise ValueError("The bounds of every parameter are equal: there is nothing to identify. Widen bounds_params.")
    try_out(problem)
    if settings.device != "cpu":
        problem.for_search(settings.device).make_env(1).close()
    if settings.optimizer != "least_squares":  # which chooses how much it simulates at once
        simulated = search_population(problem, settings) * len(problem.dataset.trained())
        check_size(problem, simulated, settings.num_envs)
    return problem


@dataclass(kw_only=True, eq=False)
class Outcome:
    """Where the optimizers ended."""

    x: torch.Tensor
    """Best normalised vector, (size,)."""
    stop_reasons: list[str] = field(default_factory=list)


class _Fit:
    """One run: the optimizers' state and what is written along the way."""

    def __init__(
        self,
        settings: FitSettings,
        problem: Problem,
        folder: RunFolder,
        progress: ProgressLine,
        record: EnvironmentRecord,
        processes: Processes | None,
    ):
        self.settings = settings
        self.record = record
        self.problem = problem
        self.folder = folder
        self.progress = progress
        self.history = History()
        self.evaluator: Evaluator = problem.training_evaluator()
        self.searcher = make_searcher(problem.for_search(settings.device), settings)
        self.assessor: Evaluator = problem.evaluator()
        self.processes = processes or Processes()
        self.colouring = colour(problem.space, problem.trees, problem.joint_names)
        self.optimizer = (
            make_optimizer(problem, settings, self.processes) if settings.optimizer != "least_squares" else None
        )
        self.descents: list[Descent] = []
        self._steps_before = 0
        self._search_stop: list[str] = []
        self._searched = False
        """Whether other starts were tried and none ended lower."""
        self._saved: dict[str, list] = {"params": [], "scores": []}
        self.log = TensorBoardLog(folder.path)

    @property
    def steps(self) -> int:
        """Simulated steps, with those before a resume."""
        every = {self.searcher, self.evaluator, self.assessor}
        return self._steps_before + sum(evaluator.simulated_steps for evaluator in every)

    def run(self, assess_interrupted: bool = True) -> tuple[FitResult, Path]:
        """Search, refine, assess, write."""
        try:
            self._write_checkpoint()  # so that a run can be resumed from its first moment
            outcome = self._optimize()
        except KeyboardInterrupt:  # keep the best so far; --resume goes on from the checkpoint
            if not assess_interrupted:
                raise
            outcome = Outcome(x=self._best_so_far(), stop_reasons=["interrupted"])
        self.progress.close()
        result = self._assess(outcome)
        self.log.log_result(result)
        self.log.close()
        write_report(self.folder.path)
        return result, self.folder.path

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Bring the optimizers to where the checkpoint has them."""
        self._steps_before = int(checkpoint["simulated_steps"])
        self.history = self.folder.history_of(checkpoint)
        if self.optimizer is not None and checkpoint["history"].size:
            self.optimizer.restore(list(checkpoint["history"]), int(checkpoint["line_generation"]), self._keep_process)
            self._search_stop = checkpoint["search_stop"].tolist()
        self.descents = Descent.restore(checkpoint)

    def _optimize(self) -> Outcome:
        """Least squares from the prior; where that ends far above the noise, from elsewhere: the hybrid searches."""
        if self.optimizer is not None and self.settings.optimizer == "cmaes":
            self._search(self.optimizer)
            return Outcome(x=self.optimizer.best, stop_reasons=self._search_stop)
        if self.settings.start is not None:
            self.processes.agree(None)  # there is nothing to share: the others may go; so below
            return self._refine_from(as_vector(self.problem, self.settings.start))
        if not self.descents:
            self.descents = [Descent(x=self.problem.space.start)]
            self._write_checkpoint()
        found, *others = self.descents
        if others:  # resumed
            self.processes.agree(None)
        else:
            self.descents = [found] = refine(
                self.evaluator, self.colouring, [found], self._after_iteration, on_beginning=self._on_beginning
            )
            others = self._elsewhere(found)
        if others:
            self._try_others(found, others)
        return Outcome(x=self.descents[0].x, stop_reasons=[*self._search_stop, str(self.descents[0].stop_reason)])

    def _refine_from(self, x: torch.Tensor) -> Outcome:
        """Refine a known vector: it needs no coarse stage, and few steps."""
        self.descents = least_squares(self.evaluator, self.colouring, [x], _NEAR, self._after_iteration)
        return Outcome(x=self.descents[0].x, stop_reasons=[str(self.descents[0].stop_reason)])

    def _elsewhere(self, found: Descent) -> list[Descent]:
        """Other starts, where a descent ended far above the noise: it may be in a wrong valley."""
        rmse = (found.score / len(self.problem.joint_names)) ** 0.5
        times = times_noise(self.problem, rmse)
        if times is None or times < FAR_ABOVE_NOISE:
            self.processes.agree(None)
            return []
        self.progress.say(f"{times:.3g} times the noise: looking for other starts (Ctrl-C keeps what is found)")
        space = self.problem.space
        if self.optimizer is None:
            self.processes.agree(None)
            vectors = [*other_valleys(space, found.x), *scattered(space, _SCATTERED, self.settings.seed)]
        else:
            vectors = [self._search(self.optimizer), *other_valleys(space, self.optimizer.best)]
        return [Descent(x=x) for x in vectors]

    def _try_others(self, found: Descent, others: Sequence[Descent]) -> None:
        """Refine other starts, as far as an interrupted run had not done it yet."""
        self.descents = [found, *others]
        self._write_checkpoint()
        self.descents = refine(
            self.evaluator,
            self.colouring,
            others,
            self._after_iteration,
            found=[found],
            on_beginning=self._on_beginning,
        )
        self._searched = self.descents[0] is found

    def _write_checkpoint(self) -> None:
        self.folder.write_checkpoint(self.optimizer, self.descents, self._search_stop, self.steps, self.history)

    def _write_mean(self, optimizer: CMAESOptimizer) -> None:
        self.folder.write_mean(optimizer.generation, self.problem.space.to_physical(optimizer.mean))

    def _search(self, optimizer: CMAESOptimizer) -> torch.Tensor:
        """Run CMA-ES; for the hybrid, until refining pays. Returns the best, which the hybrid has refined a little."""
        probe = RefiningPays(self.searcher, self.colouring) if self.settings.optimizer == "hybrid" else None

        def after_generation(_: CMAESOptimizer) -> None:
            if probe is not None:
                probe(optimizer)
            self._after_generation(optimizer)
            agree_to_stop(optimizer, self.processes)

        if probe is not None and optimizer.generation:  # resumed: perhaps right after the look that ended the search
            with self.searcher.again():
                probe(optimizer)
        self.processes.agree((self.settings, optimizer.history, optimizer.line_generation))
        self.progress.say(f"search: {optimizer.population_size} candidates in a generation")
        search(optimizer, self.searcher.rollout(optimizer.num_shown), after_generation)
        optimizer.close()
        self._search_stop = optimizer.stop_reasons
        self._write_mean(optimizer)
        return optimizer.best if probe is None or probe.refined is None else probe.refined

    def _after_generation(self, optimizer: CMAESOptimizer) -> None:
        cfg, history = optimizer.cfg, self.history
        history.search_best.append(optimizer.best_score)
        history.search_mean.append(float(optimizer.scores.sum(axis=1).mean()))
        history.search_steps.append(self.steps)
        history.search_time_s.append(self.progress.elapsed)
        self.log.log_generation(optimizer)
        spread = float(optimizer.spread.max())
        self.progress.show("search", optimizer.generation, cfg.max_iteration, optimizer.best_score, spread, self.steps)
        self._keep_process(optimizer)
        if optimizer.generation % cfg.save_interval == 0:
            self._write_mean(optimizer)
            if cfg.save_optimization_process:
                self.folder.write_tensors("progress.pt", {k: torch.stack(v) for k, v in self._saved.items()})
        self._write_checkpoint()

    def _keep_process(self, optimizer: CMAESOptimizer) -> None:
        if optimizer.cfg.save_optimization_process:
            self._saved["params"].append(optimizer.candidates)
            self._saved["scores"].append(torch.as_tensor(optimizer.scores.sum(axis=1)))

    def _on_beginning(self, descents: Sequence[Descent]) -> None:
        """A descent on the beginnings of the recordings, which a resumed fit makes anew, says that it goes on."""
        best, iteration = min(d.score for d in descents), max(d.iteration for d in descents)
        self.progress.show("begin", iteration, COARSE.max_iteration, best, None, self.steps)

    def _after_iteration(self, descents: Sequence[Descent]) -> None:
        best = min(d.score for d in descents)
        self._refuse_divergence(best)
        self.descents = list(descents)
        self.history.refine_best.append(best)
        self.history.refine_steps.append(self.steps)
        self.history.refine_time_s.append(self.progress.elapsed)
        iteration = max(d.iteration for d in descents)
        self.log.log_refinement(iteration, best)
        self.progress.show("refine", iteration, LeastSquaresCfg().max_iteration, best, None, self.steps)
        self._write_checkpoint()

    def _refuse_divergence(self, score: float) -> None:
        if not np.isfinite(score):
            raise ValueError(
                f"The best candidate's simulation diverges, so there is no result; {self.folder.path} holds the "
                "settings only. Lower the bounds of the delay, or check the gains that were in force."
            )

    def _best_so_far(self) -> torch.Tensor:
        known = [d for d in self.descents if np.isfinite(d.score)]
        if known:
            return min(known, key=lambda d: d.score).x
        if self.optimizer is not None and self.optimizer.generation:
            return self.optimizer.best
        return self.problem.space.start

    def _check_consistency(self, outcome: Outcome, score: float, there: Jacobian) -> Consistency:
        """Fit each recording alone, where there are several and the optimizer can afford it."""
        wanted = self.settings.check_consistency and self.settings.optimizer != "cmaes"
        if not wanted or outcome.stop_reasons == ["interrupted"]:
            return Consistency()
        result = check_consistency(self.problem, outcome.x, score, self.progress.say, there)
        if result.recordings:
            self.folder.write_json("consistency.json", asdict(result))
        return result

    def _assess(self, outcome: Outcome) -> FitResult:
        """Simulate the result once more on everything, with its derivatives, and write it down."""
        problem, space, data = self.problem, self.problem.space, self.problem.dataset
        known = assess(problem, self.assessor, self.colouring, outcome.x)
        uncertainty, every = known.uncertainty, known.residuals
        self._refuse_divergence(float(every.score[0]))
        train = rmse_by_joint(every, data.train[every.step], problem.joint_names)["all"]
        times = times_noise(problem, train)
        far = times is not None and times >= FAR_ABOVE_NOISE
        left_open = undetermined(problem, uncertainty, far)
        if left_open:
            refit = outcome.stop_reasons != ["interrupted"]
            x, left_open = held_at_prior(problem, outcome.x, uncertainty, left_open, _NEAR if refit else None)
            outcome = replace(outcome, x=x)
            known = assess(problem, self.assessor, self.colouring, x)
            uncertainty, every = without(known.uncertainty, left_open, space), known.residuals
        if not far and outcome.stop_reasons != ["interrupted"]:
            none = without_delay(problem, outcome.x, uncertainty, left_open, _NEAR)
            if none is not None:
                outcome = replace(outcome, x=none)
                known = assess(problem, self.assessor, self.colouring, none)
                uncertainty, every = without(known.uncertainty, [*left_open, DELAY], space), known.residuals
        uncertainty = with_other_solutions(uncertainty, self.descents, space)
        physical = space.to_physical(outcome.x)
        where = {"train": data.train[every.step], "validation": data.validation[every.step]}
        rmse = {name: rmse_by_joint(every, mask, problem.joint_names) for name, mask in where.items()}
        self.folder.write_tensors("best_trajectory.pt", trajectories(problem, every))
        bias = physical[space["encoder_bias"]].numpy()
        self.folder.write_json("drives.json", drive_loads(problem, self.assessor, bias))
        score = float(every.error[0].square()[where["train"]].sum(dim=1).mean())
        consistency = self._check_consistency(outcome, score, known.jacobian)
        result = make_result(
            problem,
            outcome.x,
            every,
            uncertainty,
            effects=problem.effects,
            environment=self.record.to_dict(),
            optimizer=self.settings.optimizer,
            seed=self.settings.seed,
            generations=self.optimizer.generation if self.optimizer else 0,
            simulated_steps=self.steps + consistency.simulated_steps,
            wall_time_s=self.progress.elapsed,
            stop_reasons=[
                f"stands still at {times:.3g} times the noise" if far and reason == "converged" else reason
                for reason in outcome.stop_reasons
            ],
            undetermined=left_open,
            times_noise=times,
            std_means_nothing=far,
            warnings=[
                *far_end(times, train, self.settings.optimizer, self._searched),
                *fit_warnings(problem, physical, uncertainty, rmse, left_open),
                *consistency.sentences,
            ],
        )
        result.save(self.folder.path / "result.json")
        return result
