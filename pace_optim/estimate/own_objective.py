"""An objective of the user's own: the class that a fit names, and what it says of any candidates."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import torch

from pace_actuators.own_code import CodeRecord, import_named, import_recorded, loaded_module, split_reference
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.problem.evaluator import Evaluator, Residuals
from pace_optim.problem.problem import Problem
from pace_optim.problem.rollout import Rollout

_FEWEST = 4
"""Candidates of the smallest population."""
_WIDEST = 512
"""Environments of a rollout at most."""
_PARTS = 400
"""Parts in time of all samples, at most, whose errors are kept separate."""
_LONG = 5
"""Samples of such a part at least."""


def optimizer_class(text: str) -> type[CMAESOptimizer]:
    """The class that a fit names as ``module:Class`` or ``path/to/file.py:Class``, imported where it has to be."""
    module, name = split_reference(text)
    try:
        found = loaded_module(module) or import_named(module)
    except ValueError as error:
        raise ValueError(f"--optimizer {text}: {error}") from None
    return _class_of(found, name, text)


def use_recorded_optimizer(text: str, code: CodeRecord, where: str) -> None:
    """Make the class of an earlier run known, if its code is what the run's record says.

    Args:
        text: As for :func:`optimizer_class`.
        where: The file that names it, for messages.
    """
    module, name = split_reference(text)
    if module == "__main__":
        if not hasattr(sys.modules[module], name):
            raise ValueError(f"{where} was made by a script that has {name}. Resume it from that script.")
        return
    import_recorded(module, code, where, f"--optimizer {text}")


def _class_of(module: ModuleType, name: str, text: str) -> type[CMAESOptimizer]:
    kind = getattr(module, name, None)
    if not (isinstance(kind, type) and issubclass(kind, CMAESOptimizer)):
        own = [
            key
            for key, value in vars(module).items()
            if isinstance(value, type) and issubclass(value, CMAESOptimizer) and value is not CMAESOptimizer
        ]
        raise ValueError(
            f"--optimizer {text}: expected a subclass of CMAESOptimizer. {module.__name__} has "
            f"{', '.join(own) or 'none: write class MyOptimizer(CMAESOptimizer)'}."
        )
    for method, arguments in (("tell", "sim_dof_pos, real_dof_pos"), ("update_simulator", "rollout")):
        try:
            inspect.signature(getattr(kind, method)).bind(None, *arguments.split(", "))
        except TypeError:
            raise ValueError(
                f"--optimizer {text}: {method}{inspect.signature(getattr(kind, method))} does not take what it is "
                f"given. Write def {method}(self, {arguments}); the robot is rollout.robot. A custom parameter is a "
                "Parameter in PaceCfg.extra_parameters."
            ) from None
    return kind


class Objective:
    """What an optimizer's ``tell`` says of candidates that are not its own.

    Attributes:
        joins_joints: Whether its error is one per environment; the joints cannot be searched apart then.
    """

    def __init__(self, kind: type[CMAESOptimizer], problem: Problem):
        """Try it on the first sample."""
        self.kind, self.problem = kind, problem
        evaluator = problem.training_evaluator()
        at = problem.space.to_physical(problem.space.start)
        optimizer, rollout = self._start(evaluator, at[None], evaluator.dataset.train)
        optimizer.tell(*next(iter(rollout)))
        told = optimizer.score_of_each()
        if optimizer.joins_joints is None:
            raise ValueError(f"{self.name}.tell adds no error. Write self.scores += …, or self.add_score(…).")
        if not bool(told.isfinite().all()):
            raise ValueError(f"{self.name}.tell adds an error that is no finite number at the first sample.")
        self.joins_joints = optimizer.joins_joints

    @property
    def name(self) -> str:
        """Of the class."""
        return self.kind.__name__

    def errors(self, evaluator: Evaluator, physical: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        """The score of candidates, in parts in time; the sum over the parts is the score.

        Args:
            physical: Physical parameters, (m, size).
            where: Which samples count, (T, R) bool.

        Returns:
            (m, parts).
        """
        widest = max(_FEWEST, _WIDEST // evaluator.dataset.num_recordings)
        return torch.cat([self._errors(evaluator, part, where) for part in physical.split(widest)])

    def residuals(self, evaluator: Evaluator, physical: torch.Tensor) -> Residuals:
        """Errors of the positions of one candidate (size,) on all samples, simulated as the optimizer does."""
        data = evaluator.dataset
        step = data.sampled.any(dim=1).nonzero()[:, 0]
        kept, count, n = data.sampled[step], data.num_recordings, len(self.problem.joint_names)
        errors: list[torch.Tensor] = []

        def look(optimizer: CMAESOptimizer, sim_dof_pos: torch.Tensor, real_dof_pos: torch.Tensor) -> None:
            error = sim_dof_pos - optimizer.sim_params[:, optimizer.bias_idx] - real_dof_pos
            errors.append(error[:count].to("cpu", torch.float64))

        self._run(evaluator, physical[None], data.sampled, look)
        error = torch.stack(errors).view(1, len(step), count, n) * kept[None, :, :, None]
        return Residuals(error=error, where=kept, step=step)

    def _errors(self, evaluator: Evaluator, physical: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        steps = where.any(dim=1).nonzero()[:, 0]
        parts = max(1, min(_PARTS, len(steps) // _LONG))
        ends = {int(steps[(len(steps) * (part + 1)) // parts - 1]) for part in range(parts)}
        sums: list[torch.Tensor] = []

        def look(optimizer: CMAESOptimizer, sim_dof_pos: torch.Tensor, real_dof_pos: torch.Tensor) -> None:
            optimizer.tell(sim_dof_pos, real_dof_pos)
            if optimizer.rollout is not None and optimizer.rollout.step in ends:
                sums.append(optimizer.score_of_each())

        self._run(evaluator, physical, where, look)
        total = torch.stack(sums, dim=1)[: len(physical)]
        return total.diff(dim=1, prepend=torch.zeros(len(total), 1, dtype=total.dtype))

    def _run(
        self, evaluator: Evaluator, physical: torch.Tensor, where: torch.Tensor, look: Callable[..., None]
    ) -> None:
        optimizer, rollout = self._start(evaluator, physical, where)
        for sim_dof_pos, real_dof_pos in rollout:
            look(optimizer, sim_dof_pos, real_dof_pos)
        optimizer.close()

    def _start(
        self, evaluator: Evaluator, physical: torch.Tensor, where: torch.Tensor
    ) -> tuple[CMAESOptimizer, Rollout]:
        """The optimizer with these candidates, repeated to its smallest population, and their rollout."""
        m = max(_FEWEST, len(physical))
        cfg = replace(CMAESOptimizerCfg.of(self.problem.env_cfg.sim2real), per_tree=False)
        optimizer = build(self.kind, self.problem, m, cfg)
        optimizer.candidates = torch.cat([physical, physical[-1:].expand(m - len(physical), -1)])
        optimizer.where = where
        rollout = evaluator.rollout(m)
        optimizer.update_simulator(rollout)
        return optimizer, rollout


def build(kind: type[CMAESOptimizer], problem: Problem, population_size: int, cfg: Any, **options: Any) -> Any:
    """An optimizer of a class that may have another constructor."""
    given = (problem.space, population_size, cfg)
    try:
        inspect.signature(kind).bind(*given, **options)
    except TypeError as error:
        raise ValueError(
            f"{kind.__name__}.__init__ does not take what it is given ({error}). Write def __init__(self, *args, "
            "**kwargs), and super().__init__(*args, **kwargs) in it."
        ) from None
    return kind(*given, **options)


def optimizer_modules(optimizer: str) -> Sequence[str]:
    """The module of an optimizer of the user's own; none of ours."""
    module, _ = split_reference(optimizer)
    return [module] if module else []
