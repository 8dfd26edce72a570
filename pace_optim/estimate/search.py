"""The search: PACE's loop."""

from __future__ import annotations

from collections.abc import Callable

from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer
from pace_optim.problem.rollout import Rollout
from pace_optim.terminal.processes import Processes


def search(
    optimizer: CMAESOptimizer, rollout: Rollout, after_generation: Callable[[CMAESOptimizer], None] | None = None
) -> None:
    """Evolve until the optimizer has finished.

    Args:
        after_generation: Called after each generation; it may call ``optimizer.stop``.
    """
    while not optimizer.finished():
        optimizer.ask()
        optimizer.update_simulator(rollout)
        for sim_dof_pos, real_dof_pos in rollout.at_once() if optimizer.reads_positions_alone else rollout:
            optimizer.tell(sim_dof_pos, real_dof_pos)
        optimizer.evolve()
        if after_generation is not None:
            after_generation(optimizer)


def agree_to_stop(optimizer: CMAESOptimizer, processes: Processes) -> None:
    """Stop where the process that writes has stopped: it may know more than the scores say."""
    reasons = processes.agree(optimizer.stop_reasons)
    if reasons and processes.count > 1:
        optimizer.stop(reasons[0])
