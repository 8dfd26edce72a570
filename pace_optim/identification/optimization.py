"""A fit's optimizers at work: search, refinement, other starts; every step can be resumed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from pace_optim.identification.beginning import make_optimizer, make_searcher
from pace_optim.optimizers.cmaes_optimizer import CMAESOptimizer
from pace_optim.optimizers.jacobian import colour
from pace_optim.optimizers.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.optimizers.other_starts import other_valleys, scattered
from pace_optim.optimizers.refine import COARSE, refine
from pace_optim.optimizers.search import RefiningPays, agree_to_stop, search
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.problem import Problem, as_vector
from pace_optim.problem.processes import Processes
from pace_optim.run.folder import RunFolder
from pace_optim.run.history import History
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensorboard_log import TensorBoardLog
from pace_optim.terminal.progress import ProgressLine
from pace_optim.uncertainty.honest_end import FAR_ABOVE_NOISE, times_noise

_SCATTERED = 2
"""Of the other starts that are tried where the first one ended far above the noise, those anywhere in the bounds."""

NEAR = LeastSquaresCfg(score_tolerance=0.02)
"""For a vector that is known to be near the best."""
_INTERRUPTED = "interrupted"


@dataclass(kw_only=True, eq=False)
class Outcome:
    """Where the optimizers ended."""

    x: torch.Tensor
    """Best normalised vector, (size,)."""
    stop_reasons: list[str] = field(default_factory=list)

    @property
    def is_interrupted(self) -> bool:
        """Whether that is only the best so far."""
        return self.stop_reasons == [_INTERRUPTED]


class Optimization:
    """One run's optimizers: their state, and what is written along the way."""

    def __init__(
        self,
        settings: FitSettings,
        problem: Problem,
        folder: RunFolder,
        progress: ProgressLine,
        processes: Processes | None = None,
    ):
        """Prepare evaluators and optimizers; nothing is simulated yet.

        Args:
            settings: How to fit.
            problem: What is fitted.
            folder: Where it is written.
            progress: Shows how far it is.
            processes: Who shares the search's candidates.
        """
        self.settings = settings
        self.problem = problem
        self.folder = folder
        self.progress = progress
        self.history = History()
        self.evaluator: Evaluator = problem.training_evaluator()
        longest = problem.for_search()
        self.coarse = longest.training_evaluator() if longest.physics_dt > problem.physics_dt else self.evaluator
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
        self.searched = False
        """Whether other starts were tried and none ended lower."""
        self._is_rough = False
        self._saved: dict[str, list] = {"params": [], "scores": []}
        self.log = TensorBoardLog(folder.path)

    @property
    def steps(self) -> int:
        """Simulated steps, with those before a resume."""
        every = {self.searcher, self.coarse, self.evaluator, self.assessor}
        return self._steps_before + sum(evaluator.simulated_steps for evaluator in every)

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Bring the optimizers to where the checkpoint has them."""
        self._steps_before = int(checkpoint["simulated_steps"])
        self.history = self.folder.history_of(checkpoint)
        if self.optimizer is not None and checkpoint["history"].size:
            self.optimizer.restore(list(checkpoint["history"]), int(checkpoint["line_generation"]), self._keep_process)
            self._search_stop = checkpoint["search_stop"].tolist()
        self.descents = Descent.restore(checkpoint)

    def run(self, keep_interrupted: bool = True) -> Outcome:
        """Search and refine; interrupted, the best so far is kept, or the interruption is passed on."""
        try:
            self._write_checkpoint()  # so that a run can be resumed from its first moment
            return self._optimize()
        except KeyboardInterrupt:  # --resume goes on from the checkpoint
            if not keep_interrupted:
                raise
            return Outcome(x=self._best_so_far(), stop_reasons=[_INTERRUPTED])

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
            self.descents = [found] = self._refine([found])
            others = self._elsewhere(found)
        if others:
            self._try_others(found, others)
        return Outcome(x=self.descents[0].x, stop_reasons=[*self._search_stop, str(self.descents[0].stop_reason)])

    def _refine_from(self, x: torch.Tensor) -> Outcome:
        """Refine a known vector: it needs no coarse stage, and few steps."""
        self.descents = least_squares(self.evaluator, self.colouring, [x], NEAR, self._after_iteration)
        return Outcome(x=self.descents[0].x, stop_reasons=[str(self.descents[0].stop_reason)])

    def _elsewhere(self, found: Descent) -> list[Descent]:
        """Other starts, where a descent ended far above the noise: it may be in a wrong valley."""
        rmse = (found.score / len(self.problem.joint_names)) ** 0.5
        times = times_noise(self.problem, rmse)
        if times is None or times < FAR_ABOVE_NOISE:
            self.processes.agree(None)
            return []
        self.progress.say(f"{times:,.0f} times the noise: looking for other starts (Ctrl-C keeps what is found)")
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
        self.descents = self._refine(others, [found])
        self.searched = self.descents[0] is found

    def _refine(self, starts: Sequence[Descent], found: Sequence[Descent] = ()) -> list[Descent]:
        return refine(
            self.evaluator, self.colouring, starts, self._after_iteration, found, self._on_beginning, self.coarse
        )

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
        self.refuse_divergence(best)
        if not self._is_rough and any(descent.directions is not None for descent in descents):
            self._is_rough = True
            self.progress.say("the motion is rough: going on with derivatives over wider steps")
        self.descents = list(descents)
        self.history.refine_best.append(best)
        self.history.refine_steps.append(self.steps)
        self.history.refine_time_s.append(self.progress.elapsed)
        iteration = max(d.iteration for d in descents)
        self.log.log_refinement(iteration, best)
        self.progress.show("refine", iteration, LeastSquaresCfg().max_iteration, best, None, self.steps)
        self._write_checkpoint()

    def refuse_divergence(self, score: float) -> None:
        """Refuse a best candidate that diverges.

        Raises:
            ValueError: If the score is not finite.
        """
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
