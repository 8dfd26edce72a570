"""Which effects could explain the residual: a score test through the simulation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from pace_actuators.effects import PROBED_EFFORT, Effect, comb_grid, probe_points
from pace_optim.diagnosis.diagnosis_cfg import CandidatesCfg
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import COLUMN, JointModel
from pace_optim.joints.fits.side_by_side import Slot
from pace_optim.joints.simulation.problem import TwinProblem

_RIDGE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Probe:
    """One effect at small values, and what it would explain of each joint's error."""

    effect: type[Effect]
    values: torch.Tensor
    """Physical values, (n, parameters)."""
    score: torch.Tensor
    """Part of the joint's squared error that it explains beyond the base model, cross-validated, (n,)."""
    size: torch.Tensor
    """Multiple of the probe that fits best, (n,)."""


def screen(
    fits: Fits,
    problem: TwinProblem,
    now: Fitted,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    cfg: CandidatesCfg,
) -> list[Probe]:
    """Look at each effect at its probes.

    With e the error, J its derivatives by the parameters that the model has, and S the change that a probe makes, e is
    regressed on [J] and on [J, S], both cross-validated over interleaved blocks of a fifth of a second:

        score = 1 - SSE[J, S] / SSE[J]

    Args:
        fits: Fits models.
        problem: The joints simulated alone.
        now: The present model, fitted, with its Jacobian.
        effects: What is tried.
        effort: Typical torque of each joint, (n,) [N m].
        cfg: How it is cross-validated.

    Raises:
        ValueError: If the model was fitted without its Jacobian.
    """
    error, middle = now.error, _middle(problem)
    if error is None:
        raise ValueError("Screening needs a model that was fitted with keep_jacobian.")

    def explained(
        own: Sequence[tuple[type[Effect], torch.Tensor]], parts: int = 1
    ) -> tuple[torch.Tensor, torch.Tensor]:
        changes, where = simulated_changes(fits, problem, now, own)
        steps = where.any(dim=1).nonzero()[:, 0][:: fits.cfg.stride]
        fold = torch.where(where[steps], _folds(steps * problem.control_dt, where.shape[1], cfg), -1)
        return _explained(error, now.free_jacobian, changes.unflatten(0, (-1, parts)), fold, cfg.folds)

    def look_at(own: Sequence[type[Effect]]) -> list[list[Probe]]:
        result: dict[type[Effect], list[Probe]] = {effect: [] for effect in own}
        points = [
            each for effect in own if effect.comb is None for each in probe_values(effect, effort, now.model, middle)
        ]
        if points:
            scores, sizes = explained(points)
            for (effect, values), score, size in zip(points, scores, sizes[:, 0], strict=True):
                allowed = now.model.allowed_joints(effect) & ((size > 0) | effect.two_sided)
                probe = Probe(effect=effect, values=values, score=torch.where(allowed, score, 0.0), size=size)
                result[effect].append(probe)
        for effect in (each for each in own if each.comb is not None):
            result[effect] = _comb_probes(effect, problem, now, effort, explained, cfg)
        return list(result.values())

    each = fits.shared_out(look_at, effects, effects)
    return [probe for probes in each for probe in probes]


def absorbed_effects(
    fits: Fits,
    problem: TwinProblem,
    now: Fitted,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    cfg: CandidatesCfg,
) -> dict[type[Effect], torch.Tensor]:
    """Effects that a base parameter absorbs, and on which joints (n,): these recordings would not show them there.

    Args:
        fits: Fits models.
        problem: The joints simulated alone.
        now: The base model, fitted, with its Jacobian.
        effects: What is tried; only those count that name such a parameter.
        effort: Typical torque of each joint, (n,) [N m].
        cfg: How much of it must be left.
    """
    suspects = [effect for effect in effects if effect.absorbed_by]
    if not suspects:
        return {}
    takers = sorted({COLUMN[effect.absorbed_by] for effect in suspects})
    steps = torch.where(now.x > 0, -cfg.seen_step, cfg.seen_step)
    beside = now.x.repeat(len(takers), 1, 1)
    for row, taker in enumerate(takers):
        beside[row, :, taker] += steps[:, taker]
    middle = _middle(problem)
    probes = [each for effect in suspects for each in probe_values(effect, effort, now.model, middle)]
    changes, _ = simulated_changes(fits, problem, now, probes, beside)
    jacobian = now.free_jacobian
    for taker, change in zip(takers, changes[: len(takers)], strict=True):
        at_bound = (jacobian[taker] == 0).all(dim=0).all(dim=0)  # there it absorbs nothing
        jacobian[taker] = torch.where(at_bound, 0.0, change / steps[:, taker].to(change.dtype))
    result = {effect: now.model.free[:, COLUMN[effect.absorbed_by]].clone() for effect in suspects}
    for (effect, _), change in zip(probes, changes[len(takers) :], strict=True):
        for j in range(now.model.num_joints):
            columns, own = jacobian[..., j].flatten(1).double(), change[..., j].flatten().double()
            columns = columns / columns.norm(dim=1, keepdim=True).clamp(min=1e-12)
            seen = own - _solve(_gram(torch.cat([columns, own[None]]))) @ columns
            if float(seen.norm()) > cfg.seen * float(own.norm()):
                result[effect][j] = False
    return {effect: joints for effect, joints in result.items() if bool(joints.any())}


def _comb_probes(
    effect: type[Effect],
    problem: TwinProblem,
    now: Fitted,
    effort: torch.Tensor,
    explained: Callable[..., tuple[torch.Tensor, torch.Tensor]],
    cfg: CandidatesCfg,
) -> list[Probe]:
    """Of all frequencies of a comb those that explain most, each with the sine and the cosine that do, best first.

    Neighbouring points of the grid are of one valley: the better one is kept.
    """
    assert effect.comb is not None
    data, n = problem.dataset, now.model.num_joints
    seen = data.measured[data.train]
    grids = [comb_grid(effect, float(span)) for span in seen.amax(dim=0) - seen.amin(dim=0)]
    count = max(map(len, grids))
    frequency = torch.stack([torch.cat([own, own[-1:].expand(count - len(own))]) for own in grids], dim=1)
    names = [p.name for p in effect.parameters]
    place, *amplitudes = (names.index(name) for name in effect.comb)
    (_, first), (_, second) = probe_values(effect, effort, now.model, _middle(problem))
    scores, sizes = [], []
    for part in frequency.split(cfg.at_once):
        pairs = [(effect, each.index_fill(1, torch.tensor([place]), 0.0)) for _ in part for each in (first, second)]
        for k, (_, values) in enumerate(pairs):
            values[:, place] = part[k // 2]
        score, size = explained(pairs, 2)
        scores.append(score)
        sizes.append(size)
    score, size = torch.cat(scores), torch.cat(sizes)
    beside = torch.maximum(score.roll(1, dims=0), score.roll(-1, dims=0))
    peaks = torch.where(score >= beside, score, -1.0)
    best = peaks.argsort(dim=0, descending=True)[: cfg.valleys]
    probes, joints = [], torch.arange(n)
    allowed = now.model.allowed_joints(effect)
    for row in best:
        values = first.clone()
        values[:, place] = frequency[row, joints]
        for k, (column, probe) in enumerate(zip(amplitudes, (first, second), strict=True)):
            values[:, column] = size[row, k, joints] * probe[:, column]
        own = torch.where(allowed, score[row, joints], 0.0)
        probes.append(Probe(effect=effect, values=values, score=own, size=torch.ones(n, dtype=torch.float64)))
    return probes


def simulated_changes(
    fits: Fits,
    problem: TwinProblem,
    now: Fitted,
    points: Sequence[tuple[type[Effect], torch.Tensor]],
    beside: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """What effects at values (n, parameters) change, (points, K, R, n), and where the samples are (T, R).

    ``beside``, (b, n, P) normalised, are more values of the model itself; what those change comes first. Points of one
    effect follow each other.
    """
    model, physical = now.model, now.physical
    own = now.x[None] if beside is None else torch.cat([now.x[None], beside])
    slots, values = [Slot(model=model, rows=len(own))], [model.to_physical(own)]
    for effect, each in itertools.groupby(points, key=lambda point: point[0]):
        extended = [model.extended(physical, effect, model.allowed_joints(effect), point) for _, point in each]
        slots.append(Slot(model=extended[0][0], rows=len(extended)))
        values.append(torch.stack([each for _, each in extended]))
    batch = fits.batch(problem, slots, training=True)
    errors = batch.simulate(values, batch.dataset.train, fits.cfg.stride).cpu()
    return errors[1:] - errors[:1], batch.dataset.train


def _middle(problem: TwinProblem) -> torch.Tensor:
    """Of the range in which each joint was measured, (n,) [rad]."""
    seen = problem.dataset.measured[problem.dataset.sampled]
    return 0.5 * (seen.amax(dim=0) + seen.amin(dim=0))


def probe_values(
    effect: type[Effect], effort: torch.Tensor, model: JointModel, middle: torch.Tensor
) -> list[tuple[type[Effect], torch.Tensor]]:
    """An effect's probes on a model's joints with a typical torque, (n,) [N m]: physical values, (n, parameters) each.

    Torques are small for small drives. Positions are counted from the middle of each joint's motion, (n,) [rad].
    """
    small = (effort / PROBED_EFFORT).clamp(max=1.0)[:, None]
    torques = torch.tensor([p.unit == "N m" and p.null == 0.0 for p in effect.parameters])
    size = torch.where(torques, small, 1.0)
    positions = torch.tensor([float(p.is_position) for p in effect.parameters]) * middle[:, None]
    return [(effect, size * model.at_point(effect, point) + positions) for point in probe_points(effect)]


def starts_of(probe: Probe, cfg: CandidatesCfg) -> torch.Tensor:
    """Where a refit starts: the probe, its amplitude multiplied by what fits best, (n, parameters)."""
    values = probe.values.clone()
    least, most = cfg.multiple
    factor = probe.size.clamp(-most, most)
    factor = torch.where(factor.abs() < least, torch.sign(factor) * least, factor)
    for k, p in enumerate(probe.effect.parameters):
        if p.null == 0.0:
            values[:, k] = (values[:, k] * factor).clamp(p.lower, p.upper)
        elif p.scale == "log" and p.null is not None and math.isfinite(p.null):  # a factor: its logarithm is the size
            values[:, k] = (p.null * (values[:, k] / p.null) ** factor).clamp(p.lower, p.upper)
    return values


def _folds(time: torch.Tensor, recordings: int, cfg: CandidatesCfg) -> torch.Tensor:
    """Fold of each sample, (K, R), in blocks that alternate, by the time of each, (K,) [s]."""
    return ((time / cfg.fold_s).long()[:, None] + torch.arange(recordings)) % cfg.folds


def _explained(
    error: torch.Tensor, jacobian: torch.Tensor, changes: torch.Tensor, fold: torch.Tensor, folds: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Score, (probes, n), and coefficients, (probes, parts, n), of every change.

    Args:
        error: (K, R, n).
        jacobian: (P, K, R, n).
        changes: (probes, parts, K, R, n): parts are regressed on together.
        fold: Of each sample, (K, R).
        folds: How many there are.
    """
    n, size, (count, parts) = error.shape[-1], len(jacobian), changes.shape[:2]
    scores = torch.zeros(count, n, dtype=torch.float64)
    sizes = torch.zeros(count, parts, n, dtype=torch.float64)
    for j in range(n):
        columns = torch.cat([jacobian[..., j], changes[..., j].flatten(0, 1), error[None, ..., j]])
        scale = columns.flatten(1).norm(dim=1).clamp(min=1e-12)
        columns = columns / scale[:, None, None]
        grams = torch.stack([_gram(columns[:, fold == f]) for f in range(folds)])
        own = [*range(size), len(columns) - 1]
        base = _cross_validated(grams[:, own][:, :, own])
        for i in range(count):
            added = [*range(size + i * parts, size + (i + 1) * parts)]
            if float(scale[added].min()) < 1e-9:
                continue
            own = [*range(size), *added, len(columns) - 1]
            with_it = grams[:, own][:, :, own]
            scores[i, j] = 1 - _cross_validated(with_it) / base
            sizes[i, :, j] = -_solve(with_it.sum(dim=0))[size:] * scale[-1] / scale[added]
    return scores, sizes


def _gram(columns: torch.Tensor) -> torch.Tensor:
    """Products of columns (m, N), (m, m); in float32 they would depend on how many columns there are."""
    columns = columns.double()
    return columns @ columns.T


def _cross_validated(grams: torch.Tensor) -> float:
    """Squared error of regressing the last column on the others, each fold by the others, of (folds, m, m)."""
    whole, total = grams.sum(dim=0), 0.0
    for gram in grams:
        beta = torch.cat([_solve(whole - gram), torch.tensor([-1.0], dtype=gram.dtype)])
        total += float(beta @ gram @ beta)
    return max(total, 1e-30)


def _solve(gram: torch.Tensor) -> torch.Tensor:
    """Coefficients of the last column by the others, of their Gram matrix."""
    a = gram[:-1, :-1] + _RIDGE * torch.eye(len(gram) - 1, dtype=gram.dtype)
    return torch.linalg.solve(a, gram[:-1, -1])
