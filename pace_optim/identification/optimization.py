"""A fit's optimizers at work; every step can be resumed from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import torch

from pace_actuators.effects import effect_cfgs
from pace_actuators.joint_units import units_for
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer
from pace_optim.estimate.comb_scan import scanned
from pace_optim.estimate.derivatives import Jacobian
from pace_optim.estimate.error_bars.far_from_noise import noise_score
from pace_optim.estimate.error_bars.loop_rate import UNEXPLAINED
from pace_optim.estimate.error_bars.uncertainty import torque_noise
from pace_optim.estimate.error_bars.undetermined import at_prior
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, by_chords
from pace_optim.estimate.search import search
from pace_optim.estimate.way_down import PIECES, WHOLE, WayDown
from pace_optim.identification.balanced_start import balanced_start
from pace_optim.identification.setup import make_optimizer, make_searcher
from pace_optim.problem.evaluator import Evaluator, Residuals
from pace_optim.problem.problem import Problem, as_vector
from pace_optim.run.folder import RunFolder
from pace_optim.run.history import History
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensorboard_log import TensorBoardLog
from pace_optim.terminal.processes import Processes
from pace_optim.terminal.progress import ProgressLine

_T = TypeVar("_T")
NEAR = LeastSquaresCfg(score_tolerance=0.02)
"""For a vector that is known to be near the best."""
INTERRUPTED = "interrupted"
_LOOPS = (1e-3, 0.0)
"""Periods of drives' loops that are tried where theirs is not stated: the usual one of servo drives, and none [s]. A
delayed torque needs a loop that holds it."""
_TORQUE_ATTEMPTS = 3
"""Times that the noise of torques is set."""
_BY_CHANCE = 2.0
"""Times the number of parameters by which χ² of the positions may rise because torques are followed too."""
_IN_DOUBT = 1.5
"""Times the noise above which pieces are fitted with another structure of effects, and with another loop rate where it
is assumed."""
_STEP_IN_DOUBT = 1.3
"""Times the noise above which a fit may go on at half its physics step ..."""
_OF_THE_STEP = 0.25
"""... where the step makes this part of what is above the noise, ..."""
_OF_TORQUES = 0.7
"""Part of what torques leave that is left of it at half a physics step that shows."""
_HALVINGS = 2
"""... so many times."""
_FEWEST_GENERATIONS = 5
"""Generations of a search, at least."""


@dataclass(kw_only=True, eq=False)
class Outcome:
    """Where the optimizers ended."""

    x: torch.Tensor
    """Best normalised vector, (size,)."""
    stop_reasons: list[str] = field(default_factory=list)

    @property
    def is_interrupted(self) -> bool:
        """Whether that is only the best so far."""
        return self.stop_reasons == [INTERRUPTED]


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
            processes: Who shares the search's candidates.
        """
        self.settings = settings
        if not settings.only_searches:
            problem = with_structures(problem, settings.start)
        self.folder = folder
        self.progress = progress
        self.history = History()
        self._restored: list[Descent] = []
        self.searcher = make_searcher(problem, settings)
        self.processes = processes or Processes()
        self.optimizer = make_optimizer(problem, settings, self.processes) if settings.only_searches else None
        self._around = torch.zeros(0, dtype=torch.float64)
        """Physical parameters around which a hybrid searches, (size,); empty before."""
        self.ways: list[WayDown] = []
        """That of the problem as it was stated, then those of others."""
        self.way = self._way(problem)
        """The one whose end is the fit's."""
        self._halvings = 0
        self._steps_before = self._looks = self._looks_before = 0
        self._search_stop: list[str] = []
        self._searched = False
        self._saved: dict[str, list] = {"params": [], "scores": []}
        self.log = TensorBoardLog(folder.path)

    def _way(self, problem: Problem, name: str = "") -> WayDown:
        """The way down with a problem, as far as an interrupted run had gone it."""
        way = WayDown(problem, on_iteration=self._after_iteration, name=name)
        way.descents = [d for d in self._restored if d.stage in way.stages]
        self.ways.append(way)
        return way

    def _search_on(self, way: WayDown) -> None:
        """Take a way's end for the fit's, and search with its problem."""
        self.way = way
        self.searcher = make_searcher(self.problem, self.settings)

    def _ended(self, way: WayDown, end: Descent) -> Outcome:
        """The end of a way, which is the fit's."""
        self.way = way
        return Outcome(x=end.x, stop_reasons=[end.stop_reason])

    @property
    def problem(self) -> Problem:
        """What is fitted."""
        return self.way.problem

    @property
    def ended(self) -> Descent | None:
        """The last descent of the way whose end is the fit's; ``None`` before it."""
        return next(reversed(self.way.descents), None)

    @property
    def descents(self) -> list[Descent]:
        """All descents so far, in the order in which they began."""
        return [descent for way in self.ways for descent in way.descents]

    @property
    def steps(self) -> int:
        """Simulated steps, with those before a resume."""
        used = {self.searcher, *(e for way in self.ways for e in (way.evaluator, way.assessor, way.pieces))}
        return self._steps_before + sum(evaluator.simulated_steps for evaluator in used)

    def _go_elsewhere(self, best: Descent) -> None:
        """Take the way of other facts, begun at the best end on pieces: structures, loop rates, the torques' noise."""
        best = self._with_structure(best)
        best = self._with_other_loop(best)
        if self.problem.dataset.torques is None:
            return
        for attempt in range(_TORQUE_ATTEMPTS):  # what is left before a descent has ended is no noise
            if best.stop_reason == "converged":
                break
            best = self._way(self.problem, f"further {attempt}").begin([best.x])
        self.way = self._by_torque_noise(best.x)

    def _by_torque_noise(self, x: torch.Tensor) -> WayDown:
        """The way on which torques weigh by what they leave on pieces, begun at a normalised vector (size,).

        Their noise grows where positions are then followed worse than without them, by more than noise explains: a
        filter's errors look like errors of the drive. A change of parameters is as the square of a torque's weight, and
        χ² of the positions as the square of that.
        """
        noise = self._torque_noise(self.way.pieces, x)
        while (found := self._at_finer_step(x, noise)) is not None:
            x, noise = found
        problem, size = self.problem, int(self.problem.space.moves.sum())
        alone: torch.Tensor | None = None
        for attempt in range(1, _TORQUE_ATTEMPTS + 1):
            way = self._way(problem.with_torque_noise(noise), f"torque noise {attempt}")
            end = way.begin([x])
            if alone is None:
                without = self._way(problem.with_torque_noise(dict.fromkeys(noise, np.inf)), "positions")
                alone = without.begin([end.x]).x
            both = self._look(way.pieces, torch.stack([end.x, alone])).positions
            (followed, best), count = both.joint_score, int(problem.dataset.train.sum())
            chi2 = count * (followed / best - 1) / (_BY_CHANCE * size / len(noise))
            if not bool((chi2 > 1).any()):
                break
            noise = {
                joint: way.problem.torque_noise.get(joint, 0.0) * more
                for joint, more in zip(noise, chi2.clamp(min=1.0).pow(0.25).tolist(), strict=True)
            }
            x = alone
        return way

    def _at_finer_step(
        self, x: torch.Tensor, noise: Mapping[str, float]
    ) -> tuple[torch.Tensor, dict[str, float]] | None:
        """Where pieces end at half the physics step, and what torques leave there, if that is far less for one of them.

        Torques show a step before positions do: sensors are good to a part of a hundred.
        """
        floor = self.problem.torque_floor
        above = [joint for joint, value in noise.items() if value > _STEP_IN_DOUBT * floor.get(joint, np.inf)]
        if not above or not self._may_halve:
            return None
        finer = self._way_at_half_the_step("step")
        end = finer.begin([x])
        left = self._torque_noise(finer.pieces, end.x)
        if not any(left[joint] < _OF_TORQUES * noise[joint] for joint in above):
            return None
        self._halvings += 1
        self.progress.say(f"the physics step shows in torques: going on with one of {_ms(finer)}")
        self.way = finer
        return end.x, left

    @property
    def _may_halve(self) -> bool:
        """Whether the physics step may be halved once more."""
        return self.settings.physics_dt is None and self._halvings < _HALVINGS

    def _way_at_half_the_step(self, name: str) -> WayDown:
        finer = self.problem.with_physics_dt(self.problem.physics_dt / 2)
        return self._way(finer, f"{name} of {finer.physics_dt:g} s")

    def _torque_noise(self, evaluator: Evaluator, x: torch.Tensor) -> dict[str, float]:
        """What torques leave at a normalised vector (size,), by joint [N m]."""
        torques = evaluator.dataset.torques
        residuals = self._look(evaluator, x[None])
        values = [] if torques is None else torque_noise(residuals, torques)
        return dict(zip(self.problem.joint_names, values, strict=False))

    def _look(self, evaluator: Evaluator, x: torch.Tensor) -> Residuals:
        """Residuals of normalised vectors (m, size) between descents."""
        return self._looked(evaluator, lambda: evaluator.residuals(evaluator.space.to_physical(x)))

    def _looked(self, evaluator: Evaluator, look: Callable[[], _T]) -> _T:
        """What is simulated between descents.

        A run that is resumed looks again; the steps of looks before the interruption were counted before.
        """
        before, self._looks = evaluator.simulated_steps, self._looks + 1
        result = look()
        if self._looks <= self._looks_before:
            self._steps_before -= evaluator.simulated_steps - before
        return result

    def _with_structure(self, best: Descent) -> Descent:
        """Take the way with another structure of effects, begun at their probes, if it leads further on pieces.

        All joints take each structure in turn, then each joint the one with which it ended best.

        Returns:
            The best end on the way that is taken.
        """
        structures, noise = self.problem.structures, noise_score(self.problem)
        if not structures or best.score <= _IN_DOUBT**2 * noise:
            return best
        bases = [self.problem.space.to_physical(x) for x in (best.x, self.problem.space.start)]
        tried = [(self.way, best)]

        def go(held: Mapping[str, float], starts: Sequence[torch.Tensor], name: str) -> None:
            way = self._way(self.problem.holding(held), name)
            tried.append((way, way.begin([way.problem.space.to_normalised(each) for each in starts])))

        for value in sorted({each for values in structures.values() for each in values}):
            self.progress.say(f"above the noise: fitting {', '.join(structures)} at {value:g}")
            values = {label: value if value in own else own[0] for label, own in structures.items()}
            starts = [start for base in bases for start in self.problem.at_probes(base, value)]
            go(values, starts, f"structure {value:g}")
        # what each joint has left on pieces, (n,) [rad²]
        scores = [self._look(way.pieces, end.x[None]).joint_score[0] for way, end in tried]
        ends = [way.problem.space.to_physical(end.x) for way, end in tried]
        names = self.problem.joint_names
        mixed, places = ends[0].clone(), self.problem.space.owners([[name] for name in names])
        for entry, j in enumerate(places):
            left = [float(own.sum() if j is None else own[j]) for own in scores]
            mixed[entry] = ends[left.index(min(left))][entry]
        if not any(torch.equal(mixed, end) for end in ends):
            values = {label: float(mixed[self.problem.space.labels.index(label)]) for label in structures}
            go(values, [mixed], "structure of each joint")
        way, end = min(tried, key=lambda each: each[1].score)
        if way is self.way or best.score - end.score <= UNEXPLAINED * (best.score - noise):
            return best
        found = self._way(way.problem, "found structure")  # a way that goes on has one start
        self._search_on(found)
        return found.begin([end.x])

    def _with_other_loop(self, best: Descent) -> Descent:
        """Take the way of loops at another rate, begun at the best end on pieces, where that refutes the assumed rate.

        Returns:
            The best end on the way that is taken.
        """
        problem, noise = self.problem, noise_score(self.problem)
        if not problem.assumes_loop_rate:
            return best
        found, least, there = None, best, None
        for period in _LOOPS if problem.delay_mode == "command" else _LOOPS[:1]:
            if period == problem.loop_dt or least.score <= _IN_DOUBT**2 * noise:
                continue
            rate = f"at {1e-3 / period:g} kHz" if period else "continuously"
            self.progress.say(f"above the noise: fitting drive loops that run {rate}, as none is stated (--drive_dt)")
            other = self._way(problem.with_loop(period), f"loop of {period:g} s")
            there = there or self._derivatives(best)
            start = self._by_known_derivatives(other, best, there)
            if start is None:
                continue
            end = other.begin([start])
            if end.score < least.score:
                found, least = other, end
        if found is None or not self._explains_more(least.score, best.score):
            return best
        self._search_on(found)
        return least

    def _derivatives(self, best: Descent) -> Jacobian:
        """Residuals and derivatives on pieces at the best end there."""
        again = replace(best, gradient=None, jacobian=None, scores=list(best.scores))
        jacobian = self._looked(self.way.pieces, lambda: again.look(self.way.pieces)[2])
        if jacobian is None:
            raise ValueError("A descent whose gradient is not known looks around.")
        return jacobian

    def _by_known_derivatives(self, other: WayDown, best: Descent, there: Jacobian) -> torch.Tensor | None:
        """Where steps by the derivatives of the best end on pieces lead on another way; ``None`` if not further."""
        pieces = other.pieces
        pieces.phases = self.way.pieces.phases
        begin = self._look(pieces, best.x[None])
        if not bool(begin.score.isfinite()):
            return None
        x, near, is_end = self._looked(
            pieces,
            lambda: by_chords(pieces, best.x, replace(there, residuals=begin), other.cfg.on_pieces.score_tolerance),
        )
        return None if is_end and not self._explains_more(float(near.residuals.score[0]), best.score) else x

    def _explains_more(self, score: float, before: float) -> bool:
        """Whether a score is below another by what matters beside the noise."""
        return before - score > UNEXPLAINED * (score - noise_score(self.problem))

    def with_loop(self, period: float, x: torch.Tensor) -> Outcome:
        """Go on with loops of another period [s], near where a fit of pieces with it ends, normalised (size,)."""
        other = self._way(self.problem.with_loop(period), f"checked loop of {period:g} s")
        return self._ended(other, other.near(x, NEAR))

    def at_half_the_step(self, x: torch.Tensor, there: Residuals, change: torch.Tensor | None) -> Outcome | None:
        """Go on from the end of a fit at half its physics step, where that shows.

        Args:
            change: How they would change without a step, (K, R, n) [rad]; ``None``: that is not known.

        Returns:
            The end at the finer step; its problem is the run's from now on. ``None`` where it is no better.
        """
        noise, score = noise_score(self.problem), float(there.score[0])
        if change is None or not self._may_halve:
            return None
        of_step = float(change.square().sum() / there.where.sum())
        if score <= _STEP_IN_DOUBT**2 * noise or of_step <= _OF_THE_STEP * (score - noise):
            return None
        self._halvings += 1
        finer = self._way_at_half_the_step("checked step")
        self.progress.say(f"the physics step shows: going on with one of {_ms(finer)}")
        end = finer.near(x, NEAR)
        return self._ended(finer, end) if end.score < score else None

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Bring the optimizers to where the checkpoint has them."""
        self._steps_before, self._looks_before = int(checkpoint["simulated_steps"]), int(checkpoint["looks"])
        self.history = self.folder.history_of(checkpoint)
        if checkpoint["history"].size:
            self._around = torch.as_tensor(checkpoint["search_around"])
            self._make_optimizer().restore(
                list(checkpoint["history"]), int(checkpoint["line_generation"]), self._keep_process
            )
            self._search_stop = checkpoint["search_stop"].tolist()
        self._restored = Descent.restore(checkpoint)
        self.way.descents = [d for d in self._restored if d.stage in self.way.stages]

    def run(self, keep_interrupted: bool = True) -> Outcome:
        """Search and refine; interrupted, the best so far is kept, or the interruption is passed on."""
        try:
            self._write_checkpoint()  # so that a run can be resumed from its first moment
            return self._optimize()
        except KeyboardInterrupt:  # --resume goes on from the checkpoint
            if not keep_interrupted:
                raise
            x = self._best_so_far()
            self.way = next((way for way in self.ways if any(d.x is x for d in way.descents)), self.way)
            return Outcome(x=x, stop_reasons=[INTERRUPTED])

    def _optimize(self) -> Outcome:
        """PACE's search alone, or the way down: from the prior, or near a vector that is known."""
        if self.optimizer is not None and self.settings.only_searches:
            self._search(self.optimizer)
            return Outcome(x=self._best_of(self.optimizer), stop_reasons=self._search_stop)
        if self.settings.start is not None:
            x = as_vector(self.problem, self.settings.start)
            if self.problem.dataset.torques is not None:
                noise = self._torque_noise(self.way.evaluator, x)
                self.way = self._way(self.problem.with_torque_noise(noise), "torque noise")
            end = self.way.near(x, NEAR)
        else:
            stated, starts = self.way, self._without_effects_too(self._first())
            if not stated.is_on_whole:
                best = stated.begin(starts)
                if (found := self._scan(best.x)) is not None:
                    starts.append(found)
                    best = stated.begin(starts)
                self._go_elsewhere(best)
                if self.way is not stated:
                    self.way.missing_score, starts = stated.missing_score, [best.x]
            searches = self.settings.optimizer != "least_squares"
            end = self.way.run(starts, self._search_within if searches else None)
        if not self._searched:
            self.processes.agree(None, at_leisure=True)  # there was nothing to share: the others may go
        return self._ended(self.way, end)

    def _first(self) -> torch.Tensor:
        """What is nearer on pieces: the prior's start, or the one that the balance of torques gives."""
        balanced, left_over = balanced_start(self.problem)
        if not self.problem.effects and self.problem.dataset.torques is None:  # which the balance does not have
            self.way.missing_score = left_over
        starts = torch.stack([self.problem.space.start, balanced])
        return starts[int(self._look(self.way.pieces, starts).score.nan_to_num(torch.inf).argmin())]

    def _without_effects_too(self, x: torch.Tensor) -> list[torch.Tensor]:
        """A start, and the same without the effects: a richer model also begins at the one that it contains."""
        added = [label for label in self.problem.space.labels if "." in label]
        return [x, at_prior(self.problem, x, added)] if added else [x]

    def _scan(self, x: torch.Tensor) -> torch.Tensor | None:
        """The best end of the first descents with frequencies of combs that explain more."""
        effects = effect_cfgs(self.problem.env_cfg.sim2real.effects)
        return scanned(self.problem.space, self.way.pieces, x, effects, self.problem.joint_names)

    def _make_optimizer(self) -> CMAESOptimizer:
        """The search; a hybrid's is made when it begins."""
        if self.optimizer is None:
            problem = with_structures(self.problem, None, self._around)  # those of a run that is resumed
            self.optimizer = make_optimizer(problem, self.settings, self.processes, self._around)
        return self.optimizer

    def _search_within(self, budget: int, x: torch.Tensor) -> list[torch.Tensor]:
        """Starts by a search of the pieces around a normalised vector (size,), with a budget of simulations."""
        if not len(self._around):
            self._around = self.problem.space.to_physical(x)
        optimizer = self._make_optimizer()
        generations = max(_FEWEST_GENERATIONS, budget // optimizer.population_size)
        optimizer.cfg = replace(optimizer.cfg, max_iteration=min(optimizer.cfg.max_iteration, generations))
        self.progress.say("far above the noise: searching (Ctrl-C keeps what is found)")
        starts = self._without_effects_too(self._search(optimizer))
        self.progress.say("fitting from the best of the search")
        return starts

    def _write_checkpoint(self) -> None:
        self.folder.write_checkpoint(
            self.optimizer, self._around, self.descents, self._search_stop, self.steps, self._looks, self.history
        )

    def _write_mean(self, optimizer: CMAESOptimizer) -> None:
        self.folder.write_mean(self.history.iterations, optimizer.space.to_physical(optimizer.mean))

    def _search(self, optimizer: CMAESOptimizer) -> torch.Tensor:
        """Run CMA-ES as far as an interrupted run had not; returns the best."""
        self._searched = True
        begun, loop = optimizer.history, self.problem.loop_dt if self.problem.assumes_loop_rate else None
        known = self.settings, self._around, begun, optimizer.line_generation, optimizer.cfg.max_iteration, loop
        self.processes.agree(known, at_leisure=True)
        self.progress.say(f"{self._search_name}: {optimizer.population_size} candidates in a generation")
        search(optimizer, self.searcher.rollout(optimizer.num_shown), self._after_generation)
        optimizer.close()
        self._search_stop = optimizer.stop_reasons
        self._write_mean(optimizer)
        self._write_process()
        return self._best_of(optimizer)

    def _best_of(self, optimizer: CMAESOptimizer) -> torch.Tensor:
        """The best vector of a search, normalised as the problem has it, (size,)."""
        return self.problem.space.to_normalised(optimizer.space.to_physical(optimizer.best))

    def _after_generation(self, optimizer: CMAESOptimizer) -> None:
        cfg, history = optimizer.cfg, self.history
        history.search_best.append(optimizer.best_score)
        history.search_mean.append(float(optimizer.generation_scores.sum(axis=1).mean()))
        history.search_steps.append(self.steps)
        history.search_time_s.append(self.progress.elapsed)
        self.log.log_generation(optimizer)
        spread = float(optimizer.spread.max())
        best = f"best candidate {self._in_words(optimizer.best_score).removeprefix('error ')}"
        self.progress.show(self._search_name, optimizer.generation, cfg.max_iteration, best, spread, self.steps)
        self._keep_process(optimizer)
        if optimizer.generation % cfg.save_interval == 0:
            self._write_mean(optimizer)
            self._write_process()
        self._write_checkpoint()

    def _keep_process(self, optimizer: CMAESOptimizer) -> None:
        if optimizer.cfg.save_optimization_process:
            self._saved["params"].append(optimizer.candidates)
            self._saved["scores"].append(torch.as_tensor(optimizer.generation_scores.sum(axis=1)))

    def _write_process(self) -> None:
        if self._saved["params"]:
            self.folder.write_progress({name: torch.stack(values) for name, values in self._saved.items()})

    def _after_iteration(self, descents: Sequence[Descent]) -> None:
        number, now = max((i, d) for i, d in enumerate(descents, start=1) if i == 1 or d.iteration)
        best, on_pieces = min(d.score for d in descents), now.stage.endswith(PIECES)
        cfg = self.way.cfg.on_pieces if on_pieces else self.way.cfg.on_whole
        if not on_pieces:
            self.refuse_divergence(best)
            self.history.refine_best.append(best)
            self.history.refine_steps.append(self.steps)
            self.history.refine_time_s.append(self.progress.elapsed)
            self.log.log_refinement(now.iteration, best)
        name = "fit on pieces" if on_pieces else "fit on whole recordings"
        name += f" from start {number}" if number > 1 else ""
        error = self._in_words(now.score)
        if on_pieces:  # they begin where the robot was, so their error is smaller than that of recordings
            error = error.replace("error", "error of pieces", 1)
        self.progress.show(name, now.iteration, cfg.max_iteration, error, None, self.steps)
        self.folder.write_mean(self.history.iterations, self.problem.space.to_physical(self._best_so_far()))
        self._write_checkpoint()

    @property
    def _search_name(self) -> str:
        """What the progress calls the search, with its physics step where that is another than the fit's."""
        step = self.problem.for_search().physics_dt
        return "search" if step == self.problem.physics_dt else f"search with a physics step of {1e3 * step:.4g} ms"

    def _in_words(self, score: float) -> str:
        """A score of positions [rad²] as the error of all joints [mrad]; another one as it is."""
        if self.settings.has_own_objective or self.problem.dataset.torques is not None:
            return f"score {score:.3e}"
        error = 1e3 * (score / len(self.problem.joint_names)) ** 0.5
        return units_for(f"error {error:.3g} mrad", self.problem.joint_types)

    def refuse_divergence(self, score: float) -> None:
        """Refuse a best candidate that diverges."""
        if not np.isfinite(score):
            raise ValueError(
                f"The best candidate's simulation diverges, so there is no result; {self.folder.path} holds the "
                "settings only. Lower the bounds of the delay, or check the gains that were in force."
            )

    def _best_so_far(self) -> torch.Tensor:
        for stage in (WHOLE, PIECES):
            known = [d for d in self.descents if d.stage.endswith(stage) and np.isfinite(d.score)]
            if known:
                return min(known, key=lambda d: d.score).x
        if self.optimizer is not None and self.optimizer.generation:
            return self._best_of(self.optimizer)
        return self.problem.space.start


def _ms(way: WayDown) -> str:
    return f"{1e3 * way.problem.physics_dt:g} ms"


def with_structures(problem: Problem, start: Mapping[str, Any] | None, around: torch.Tensor | None = None) -> Problem:
    """The problem with the structures of its effects held where a fit begins.

    Args:
        start: Parameters that it begins at; ``None``: at the space's start.
        around: The same as a physical vector (size,), if that is known.
    """
    if not (structures := problem.structures):
        return problem
    if around is None:
        around = problem.space.to_physical(problem.space.start if start is None else as_vector(problem, dict(start)))
    own = {label: float(around[problem.space.labels.index(label)]) for label in structures}
    nearest = {label: min((abs(v - own[label]), v) for v in values)[1] for label, values in structures.items()}
    return problem.holding(nearest)
