"""What is looked at before a run has a folder: whether a candidate can be simulated, and whether there is memory."""

from __future__ import annotations

from pace_actuators.memory import check_memory
from pace_envs.simulation import bytes_per_env
from pace_optim.problem.problem import Problem

_TRIED_STEPS = 4
"""Control steps that a candidate is tried out for."""

_BYTES_PER_VALUE = 100
"""Memory of a search for each parameter of a candidate: its scores, its ranks and copies of it [bytes]."""


def try_out(problem: Problem) -> None:
    """Simulate one candidate on each recording for some steps: what cannot be applied fails before anything is kept.

    Raises:
        ValueError: If the motion is not finite; an effect that makes it so alone is named.
    """
    if _stays_finite(problem):
        return
    guilty = [label for label in problem.effects if not _stays_finite(problem.with_effects([label]))]
    raise ValueError(
        f"The simulation is not finite within {_TRIED_STEPS} steps from the start"
        + (f" with the effect {guilty[0]}. Correct the effect." if guilty else ". Check the model, gains and bounds.")
    )


def check_size(problem: Problem, simulated: int, num_envs: int) -> None:
    """Refuse a search for which there is no memory, before the run has a folder.

    Args:
        problem: What is fitted.
        simulated: How many simulations the search makes at once.
        num_envs: How many were asked for.

    Raises:
        ValueError: If there is too little.
    """
    env = problem.make_env(1)
    each = bytes_per_env(env.sim.model) + _BYTES_PER_VALUE * problem.space.size
    env.close()
    check_memory(simulated * each, f"--num_envs {num_envs}", "Take fewer: a search gains little beyond 4096.")


def _stays_finite(problem: Problem) -> bool:
    rollout = problem.evaluator().rollout(1)
    rollout.start(problem.space.to_physical(problem.space.start[None]))
    finite = all(bool(position.isfinite().all()) for position in rollout.simulated(_TRIED_STEPS))
    rollout.env.close()
    return finite
