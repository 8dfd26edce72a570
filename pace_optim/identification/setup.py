"""What a fit begins with: its problem, and what searches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pace_actuators.memory import check_memory
from pace_envs.simulation import bytes_per_env
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.estimate.convergence import stop_rule
from pace_optim.estimate.own_objective import Objective, build, optimizer_class
from pace_optim.estimate.way_down import WayDownCfg
from pace_optim.identification.log_checks import checked
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.problem import Problem
from pace_optim.problem.recordings import tell_on_stderr
from pace_optim.run.open import problem_of
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.processes import Processes

_HYBRID_POPULATION = 48
"""Candidates per generation of the hybrid's search: enough for a tree's dozen parameters, cheap enough to end soon."""
_AROUND = 0.5
"""First standard deviation of a hybrid's search, in normalised parameters: a decade of a magnitude."""


def load_for_fit(settings: FitSettings, env_cfg: Any = None, tell: Callable[[str], None] = tell_on_stderr) -> Problem:
    """Read everything, refuse what cannot be fitted, and try the simulation out.

    Args:
        env_cfg: The configuration of a run's task; ``None`` loads that of the settings' task.
        tell: Gets how the recordings are understood, and warnings of them.
    """
    both = {Path(name).resolve() for name in settings.data} & {Path(name).resolve() for name in settings.validation}
    if both:
        raise ValueError(f"{both.pop()} is named by --data and --validation: what is trained on validates nothing.")
    problem = checked(problem_of(settings, env_cfg, tell), settings.trust_log, tell)
    if problem.dataset.num_recordings * 4 > settings.num_envs and settings.only_searches:
        raise ValueError(
            f"--num_envs {settings.num_envs} is too few for {problem.dataset.num_recordings} recordings: expected at "
            f"least {4 * problem.dataset.num_recordings}, 4 candidates on each recording."
        )
    if not bool((problem.space.upper > problem.space.lower).any()):
        raise ValueError("The bounds of every parameter are equal: there is nothing to identify. Widen bounds.")
    try_out(problem)
    search_settings(problem, settings)  # refuses stop rules and objectives that cannot be used
    if settings.device != "cpu":
        problem.for_search(settings.device).make_env(1).close()
    if settings.optimizer != "least_squares":  # which chooses how much it simulates at once
        simulated = search_population(problem, settings) * len(problem.dataset.trained())
        check_size(problem, simulated, settings.num_envs)
    return problem


def search_settings(problem: Problem, settings: FitSettings) -> CMAESOptimizerCfg:
    """The search's own settings: the robot's, with what a fit asks for."""
    asked = {name: getattr(settings, name) for name in ("max_iteration", "epsilon", "sigma")}
    cfg = CMAESOptimizerCfg.of(problem.env_cfg.sim2real)
    cfg = replace(
        cfg,
        per_tree=cfg.per_tree and not settings.joint_strategy,
        save_optimization_process=cfg.save_optimization_process or settings.save_optimization_process,
        stop=settings.stop or cfg.stop,
        **{name: value for name, value in asked.items() if value is not None},
    )
    for rule in cfg.stop:
        stop_rule(rule)
    if settings.has_own_objective and Objective(optimizer_class(settings.optimizer), problem).joins_joints:
        cfg = replace(cfg, per_tree=False)
    return cfg


def search_population(problem: Problem, settings: FitSettings) -> int:
    """Candidates in a generation; a hybrid takes all of ``num_envs`` on a GPU alone."""
    population = max(4, settings.num_envs // len(problem.dataset.trained()))
    is_small = settings.optimizer == "hybrid" and settings.device == "cpu"
    return min(population, _HYBRID_POPULATION) if is_small else population


def make_optimizer(
    problem: Problem, settings: FitSettings, processes: Processes, around: torch.Tensor | None = None
) -> CMAESOptimizer:
    """The search of a fit.

    Args:
        around: Physical parameters (size,) around which a hybrid searches what it searches by magnitude; the rest it
            searches from the start of the parameters. ``None``: PACE's search, all from there.
    """
    space, start, cfg = problem.space, problem.space.start, search_settings(problem, settings)
    if around is not None:
        space = space.by_magnitude()
        start = torch.where(space.is_logarithmic, space.to_normalised(around).clamp(-1.0, 1.0), space.start)
        cfg = replace(cfg, sigma=_AROUND if settings.sigma is None else settings.sigma)
    return build(
        optimizer_class(settings.optimizer) if settings.has_own_objective else CMAESOptimizer,
        replace(problem, space=space),
        search_population(problem, settings),
        cfg,
        trees=problem.trees,
        seed=settings.seed,
        start=start,
        processes=processes,
    )


def make_searcher(problem: Problem, settings: FitSettings) -> Evaluator:
    """What scores the candidates of a search: the hybrid's only has to find the valley, for which a part is enough."""
    problem = problem.for_search(settings.device)
    if settings.optimizer == "hybrid":
        problem = problem.on_pieces(WayDownCfg().share)
    return problem.training_evaluator()


_TRIED_STEPS = 4
"""Control steps that a candidate is tried out for."""

_BYTES_PER_VALUE = 100
"""Memory of a search for each parameter of a candidate: its scores, its ranks and copies of it [bytes]."""


def try_out(problem: Problem) -> None:
    """Simulate one candidate on each recording for some steps: what cannot be applied fails before anything is kept."""
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
        simulated: How many simulations the search makes at once.
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
