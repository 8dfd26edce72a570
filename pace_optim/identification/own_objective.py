"""What a fit of the user's own objective concludes: its minimum, with error bars of that objective."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import torch

from pace_actuators.drive_result import ALL
from pace_envs.task_source import EnvironmentRecord
from pace_optim.comparison.drive_loads import drive_loads
from pace_optim.estimate.error_bars.assessment import trajectories
from pace_optim.estimate.error_bars.far_from_noise import FAR_ABOVE_NOISE, times_noise
from pace_optim.estimate.error_bars.uncertainty import AT_BOUND, Uncertainty, uncertainty_of
from pace_optim.estimate.error_bars.undetermined import undetermined
from pace_optim.estimate.error_bars.warnings import by_effect, fit_warnings
from pace_optim.estimate.own_objective import Objective, optimizer_class
from pace_optim.identification.optimization import Optimization, Outcome
from pace_optim.run.result import FitResult, make_result, rmse_by_joint

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


def conclude_own(run: Optimization, record: EnvironmentRecord, outcome: Outcome) -> FitResult:
    """Evaluate the objective at its best candidate, with its error bars, and write it down.

    Positions are simulated and compared too: the errors of ``rmse`` are theirs. Nothing is refined, held at a prior or
    fitted again, since least squares minimise another objective.
    """
    problem, x, settings = run.problem, outcome.x, run.settings
    run.progress.say("error bars of the objective")
    objective = Objective(optimizer_class(settings.optimizer), problem)
    physical, data = problem.space.to_physical(x), problem.dataset
    every = objective.residuals(run.assessor, physical)
    run.refuse_divergence(float(every.score[0]))
    uncertainty, score = error_bars(run, objective, x)
    held_out = data.validation if bool(data.validation.any()) else None
    validation = None if held_out is None else float(objective.errors(run.assessor, physical[None], held_out).sum())
    run.folder.write_tensors("best_trajectory.pt", trajectories(problem, every))
    bias = physical[problem.space["encoder_bias"]].numpy()
    run.folder.write_json("drives.json", drive_loads(problem, run.assessor, bias))
    where = {"train": data.train[every.step], "validation": data.validation[every.step]}
    rmse = {name: rmse_by_joint(every, mask, problem.joint_names) for name, mask in where.items()}
    times = times_noise(problem, rmse["train"][ALL])
    far = times is not None and times >= FAR_ABOVE_NOISE
    open_ = [label for label in undetermined(problem, x, uncertainty) if label not in uncertainty.no_influence]
    result = make_result(
        problem,
        x,
        every,
        uncertainty,
        effects=problem.effects,
        environment=record.to_dict(),
        optimizer=settings.optimizer,
        objective={"train": score, "validation": validation},
        seed=settings.seed,
        generations=run.optimizer.generation if run.optimizer else 0,
        simulated_steps=run.steps,
        wall_time_s=run.progress.elapsed,
        stop_reasons=outcome.stop_reasons,
        times_noise=times,
        warnings=by_effect(
            [
                *_far(times if far else None),
                *fit_warnings(problem, physical, uncertainty, rmse, (), open_),
            ]
        ),
    )
    result.save(run.folder.path / "result.json")
    return result


def error_bars(run: Optimization, objective: Objective, x: torch.Tensor) -> tuple[Uncertainty, float]:
    """Error bars at the minimum of an objective, and its value there.

    With S_b the part of the objective in the b-th part of the samples, g_b its gradient and H the second derivatives
    of their sum, the covariance is that of an M-estimator,

        C = H⁻¹ (Σ_b (g_b - ḡ)(g_b - ḡ)ᵀ) H⁻¹

    which needs no residuals (Huber 1967). Parts in time, not samples, are taken as independent. Differences are taken
    along directions that the objective hardly confounds, as far as it takes to see them: those that whiten Σ g_b g_bᵀ.

    The noise of the sample at which a simulation starts is not in them: of a second of recording they are up to half
    too small.

    Args:
        x: The minimum, normalised (size,).
    """
    space, where = run.problem.space, run.evaluator.dataset.train

    def parts(vectors: torch.Tensor) -> np.ndarray:
        return objective.errors(run.evaluator, space.to_physical(vectors.clamp(-1, 1)), where).numpy()

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
    uncertainty = uncertainty_of(scale * hessian, scale**2 * spread, samples, run.colouring, space, x)
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


def _far(times: float | None) -> list[str]:
    if times is None:
        return []
    return [
        f"The positions of this minimum are {times:,.0f} times the measurement noise away from the recording: the "
        "objective differs from the position error. Compare with a fit without --optimizer. [W19]"
    ]
