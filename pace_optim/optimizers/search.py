"""The search: PACE's loop, its checkpoints, and when refining is worth more than searching."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from pace_optim.optimizers.cmaes_optimizer import CMAESOptimizer
from pace_optim.optimizers.jacobian import Colouring
from pace_optim.optimizers.least_squares import LeastSquaresCfg, least_squares
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.processes import Processes
from pace_optim.problem.rollout import Rollout

_PROBE_ITERATIONS = 4
_PROBE_EVERY = 3


def search(
    optimizer: CMAESOptimizer, rollout: Rollout, after_generation: Callable[[CMAESOptimizer], None] | None = None
) -> None:
    """Evolve until the optimizer has finished.

    Args:
        optimizer: Proposes candidates.
        rollout: Simulates them.
        after_generation: Called after each generation; it may call ``optimizer.stop``.
    """
    while not optimizer.finished():
        optimizer.ask()
        optimizer.update_simulator(rollout)
        for sim_dof_pos, real_dof_pos in rollout:
            optimizer.tell(sim_dof_pos, real_dof_pos)
        optimizer.evolve()
        if after_generation is not None:
            after_generation(optimizer)


def agree_to_stop(optimizer: CMAESOptimizer, processes: Processes) -> None:
    """Stop where the process that writes has stopped: it may know more than the scores say."""
    reasons = processes.agree(optimizer.stop_reasons)
    if reasons and processes.count > 1:
        optimizer.stop(reasons[0])


class RefiningPays:
    """Stops a search as soon as least squares lowers the score more per simulation than the search does.

    Every few generations a few iterations of least squares are tried from the best candidate. The search stops when

        log(score before / score after) / simulations

    of that trial is above the same figure of the search's own last generations.
    """

    def __init__(self, evaluator: Evaluator, colouring: Colouring):
        """Keep what a trial needs."""
        self._evaluator = evaluator
        self._colouring = colouring
        self.refined: torch.Tensor | None = None
        """Where the last trial ended, normalised (size,)."""

    def __call__(self, optimizer: CMAESOptimizer) -> None:
        """Look at the search after a generation; stop it where refining pays."""
        if optimizer.generation % _PROBE_EVERY:
            return
        simulations = self._evaluator.simulations
        cfg = LeastSquaresCfg(max_iteration=_PROBE_ITERATIONS)
        trial = least_squares(self._evaluator, self._colouring, [optimizer.best], cfg)[0]
        refining = _gain(trial.scores[0], trial.score) / (self._evaluator.simulations - simulations)
        best = optimizer.best_scores[-1 - _PROBE_EVERY :]
        searching = _gain(best[0], best[-1]) / ((len(best) - 1) * optimizer.population_size)
        if refining > searching:
            self.refined = trial.x
            optimizer.stop("refining is worth more than searching")


def _gain(before: float, after: float) -> float:
    """How far the score fell, log(before / after)."""
    return math.log(max(before, 1e-300) / max(after, 1e-300))
