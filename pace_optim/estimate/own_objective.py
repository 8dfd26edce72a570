"""An objective of the user's own: the class that a fit names, what it says of any candidates, and error bars of it."""

from __future__ import annotations

import inspect
import itertools
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import torch

from pace_actuators.own_code import CodeRecord, import_named, import_recorded, loaded_module, split_reference
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.estimate.error_bars.uncertainty import AT_BOUND, Uncertainty, uncertainty_of
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


_STEP = 2e-3
"""Of the first derivatives, normalised to bounds of -1 and 1: a thousandth of each range."""
_RISE = 0.1
"""By how much of itself the objective is to rise over a step."""
_ROUNDS = 6
"""Times that steps are made longer or shorter for that, at most."""
_FIRST = 0.05
"""Length of the longest first step, normalised."""
_LEAST = 1e-9
"""A direction with less than this of the largest part of the gradients counts as one with this."""
_TOGETHER = 4
"""Parts in time that are taken as one independent block."""


def objective_error_bars(objective: Objective, evaluator: Evaluator, x: torch.Tensor) -> tuple[Uncertainty, float]:
    """Error bars at the minimum of an objective, and its value there.

    With S_b the part of the objective in the b-th part of the samples, g_b its gradient and H the second derivatives
    of their sum, the covariance is that of an M-estimator,

        C = H⁻¹ (Σ_b (g_b - ḡ)(g_b - ḡ)ᵀ) H⁻¹

    which needs no residuals (Huber 1967). Parts in time, not samples, are taken as independent. Differences are taken
    along directions that the objective hardly confounds, as far as it takes to see them: those that whiten Σ g_b g_bᵀ.

    The noise of the sample at which a simulation starts is not in them: of a second of recording they are up to half
    too small.

    Args:
        evaluator: Simulates what is trained on.
    """
    space, where = evaluator.space, evaluator.dataset.train

    def parts(vectors: torch.Tensor) -> np.ndarray:
        return objective.errors(evaluator, space.to_physical(vectors.clamp(-1, 1)), where).numpy()

    entries = np.eye(space.size)[(space.upper > space.lower).numpy()]
    centre = x.clamp(-1 + _STEP, 1 - _STEP)
    here, up, down = _differences(parts, centre, _STEP * entries)
    hessian = np.diag(((up + down - 2 * here).sum(axis=1) / _STEP**2).clip(0) @ entries)
    inside = (entries @ (1 - x.abs().numpy())) > AT_BOUND
    moving = entries[inside & (hessian.diagonal() @ entries.T > 0)]
    spread = np.zeros_like(hessian)
    if len(moving):
        gradient = moving @ entries.T @ (up - down) / (2 * _STEP)
        steps = _whitened(gradient) @ moving
        for _ in range(_ROUNDS):
            here, up, down = _differences(parts, x, steps)
            rise = 0.5 * (up + down - 2 * here).sum(axis=1)
            scale = np.sqrt(_RISE * here.sum() / rise.clip(1e-300)).clip(0.1, 10.0)
            if ((scale > 0.5) & (scale < 2)).all():
                break
            steps = steps * np.minimum(scale, 1 / np.abs(steps).max(axis=1))[:, None]
        pairs = list(itertools.combinations(range(len(steps)), 2))
        corners = [x + torch.as_tensor(steps[i] + steps[j]) for i, j in pairs]
        both = parts(torch.stack(corners)) if corners else np.zeros((0, up.shape[1]))
        curvature = np.diag((up + down - 2 * here).sum(axis=1))
        for (i, j), part in zip(pairs, both, strict=True):
            curvature[i, j] = curvature[j, i] = (part - up[i] - up[j] + here).sum()
        back = np.linalg.pinv(steps)  # entries from steps, and derivatives by entries from those along steps
        seen = back @ _not_negative(curvature) @ back.T
        at = moving.any(axis=0)
        hessian[np.ix_(at, at)] = seen[np.ix_(at, at)]
        slopes = _in_blocks(0.5 * (up - down))
        around = slopes - slopes.mean(axis=1, keepdims=True)
        spread = back @ around @ around.T @ back.T * (slopes.shape[1] / max(1, slopes.shape[1] - 1))
    samples, most = int(where.sum()), float(hessian.diagonal().max())
    scale = samples / (4 * most) if most > 0 else 1.0  # thresholds in radians are meant of what moves most
    uncertainty = uncertainty_of(scale * hessian, scale**2 * spread, samples, evaluator.colouring, space, x)
    return uncertainty, float(parts(x[None]).sum())


def _differences(
    parts: Callable[[torch.Tensor], np.ndarray], x: torch.Tensor, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The objective's parts at x, (parts,), and after each step and its opposite, (k, parts) each."""
    moved = torch.as_tensor(steps)
    found = parts(torch.cat([x[None], x + moved, x - moved]))
    return found[0], found[1 : 1 + len(steps)], found[1 + len(steps) :]


def _whitened(gradient: np.ndarray) -> np.ndarray:
    """Steps (k, k) along which gradients of parts (k, parts) do not go together, of a first guess of their lengths."""
    size = np.sqrt(np.square(gradient).sum(axis=1)).clip(1e-300)
    values, vectors = np.linalg.eigh(gradient @ gradient.T / np.outer(size, size))
    steps = vectors.T / np.sqrt(values.clip(_LEAST * values.max()))[:, None] / size
    return steps * (_FIRST / np.abs(steps).max())


def _in_blocks(parts: np.ndarray) -> np.ndarray:
    """Some neighbouring parts (k, parts) together."""
    count = max(2, parts.shape[1] // _TOGETHER)
    return np.stack([block.sum(axis=1) for block in np.array_split(parts, count, axis=1)], axis=1)


def _not_negative(matrix: np.ndarray) -> np.ndarray:
    """Without the negative eigenvalues of differences of a rough objective."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * values.clip(1e-3 * values.max())) @ vectors.T
