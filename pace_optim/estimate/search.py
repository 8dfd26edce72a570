"""The search: PACE's loop."""

from __future__ import annotations

from collections.abc import Callable

from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer
from pace_optim.problem.rollout import Rollout


def search(
    optimizer: CMAESOptimizer, rollout: Rollout, after_generation: Callable[[CMAESOptimizer], None] | None = None
) -> None:
    """Evolve until the optimizer has finished.

    Of several processes, the one that writes decides that.

    Args:
        after_generation: Called after each generation; it may call ``optimizer.stop``.
    """
    while not optimizer.processes.agree(optimizer.finished()):
        optimizer.ask()
        optimizer.update_simulator(rollout)
        for sim_dof_pos, real_dof_pos in rollout.at_once() if optimizer.reads_positions_alone else rollout:
            optimizer.tell(sim_dof_pos, real_dof_pos)
        optimizer.evolve()
        if after_generation is not None:
            after_generation(optimizer)
