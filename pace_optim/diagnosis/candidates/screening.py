"""Which effects could explain what is left: the score test through the simulation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from pace_actuators.effects import Effect, probe_points
from pace_optim.diagnosis.fitting.processes import spread
from pace_optim.diagnosis.fitting.side_by_side import SideBySide, Slot
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.model.model import BASE, start_values
from pace_optim.single_joint_model.problem import TwinProblem

_FOLDS = 5
_BLOCK_S = 0.2
_STRIDE = 2
_AT_BOUND = 1e-3
_RIDGE = 1e-9
_SEEN = 0.3
"""Part of an effect's amplitude: with less than this left, a base parameter takes it up."""
_WIDE = 0.1
"""Normalised step of that parameter: joints that stick make the error rough, and a narrow step sees the roughness."""


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


def screen(problem: TwinProblem, now: Fitted, effects: Sequence[type[Effect]], effort: torch.Tensor) -> list[Probe]:
    """Look at each effect at its probes.

    With e the error, J its derivatives by the parameters that the model has, and S the change that a probe makes, e is
    regressed on [J] and on [J, S], both cross-validated over interleaved blocks of a fifth of a second:

        score = 1 - SSE[J, S] / SSE[J]

    Args:
        problem: The joints simulated alone.
        now: The present model, fitted, with its Jacobian.
        effects: What is tried.
        effort: Typical torque of each joint, (n,) [N m].
    """
    each = spread(lambda own: _screened(problem, now, own, effort), effects, effects)
    return [probe for probes in each for probe in probes]


def _screened(
    problem: TwinProblem, now: Fitted, effects: Sequence[type[Effect]], effort: torch.Tensor
) -> list[list[Probe]]:
    """:func:`screen` in one process; the probes of each effect."""
    if now.error is None:
        raise ValueError("Screening needs a model that was fitted with keep_jacobian.")
    probes, changes, where = simulated_probes(problem, now, effects, effort)
    scores, sizes = _explained(now.error, free_columns(now), changes, _blocks(where, problem.control_dt))
    result: dict[type[Effect], list[Probe]] = {effect: [] for effect in effects}
    for (effect, own), score, size in zip(probes, scores, sizes, strict=True):
        allowed = now.model.may_get(effect) & ((size > 0) | effect.two_sided)
        probe = Probe(effect=effect, values=own, score=torch.where(allowed, score, 0.0), size=size)
        result[effect].append(probe)
    return list(result.values())


def absorbed_effects(
    problem: TwinProblem, now: Fitted, effects: Sequence[type[Effect]], effort: torch.Tensor
) -> dict[type[Effect], torch.Tensor]:
    """Effects that a base parameter takes up, and on which joints (n,): these recordings would not show them there.

    Args:
        problem: The joints simulated alone.
        now: The base model, fitted, with its Jacobian.
        effects: What is tried; only those count that name such a parameter.
        effort: Typical torque of each joint, (n,) [N m].
    """
    suspects = [effect for effect in effects if effect.absorbed_by]
    if not suspects:
        return {}
    takers = sorted({BASE.index(effect.absorbed_by) for effect in suspects})
    steps = torch.where(now.x > 0, -_WIDE, _WIDE)
    beside = now.x.repeat(len(takers), 1, 1)
    for row, taker in enumerate(takers):
        beside[row, :, taker] += steps[:, taker]
    probes, changes, _ = simulated_probes(problem, now, suspects, effort, beside)
    jacobian = free_columns(now)
    for taker, change in zip(takers, changes[: len(takers)], strict=True):
        at_bound = (jacobian[taker] == 0).all(dim=0).all(dim=0)  # there it takes up nothing
        jacobian[taker] = torch.where(at_bound, 0.0, change / steps[:, taker].to(change.dtype))
    result = {effect: now.model.free[:, BASE.index(effect.absorbed_by)].clone() for effect in suspects}
    for (effect, _), change in zip(probes, changes[len(takers) :], strict=True):
        for j in range(now.model.num_joints):
            columns, own = jacobian[..., j].flatten(1).double(), change[..., j].flatten().double()
            columns = columns / columns.norm(dim=1, keepdim=True).clamp(min=1e-12)
            seen = own - _solve(_bordered(columns, own), len(columns)) @ columns
            if float(seen.norm()) > _SEEN * float(own.norm()):
                result[effect][j] = False
    return {effect: joints for effect, joints in result.items() if bool(joints.any())}


def _bordered(columns: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Gram matrix of some columns and, last, a target."""
    together = torch.cat([columns, target[None]])
    return together @ together.T


def simulated_probes(
    problem: TwinProblem,
    now: Fitted,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    beside: torch.Tensor | None = None,
) -> tuple[list[tuple[type[Effect], torch.Tensor]], torch.Tensor, torch.Tensor]:
    """All probes with their values, what they change (probes, K, R, n), and where the samples are (T, R).

    ``beside``, (b, n, P) normalised, are more values of the model itself; what those change comes first.
    """
    model = now.model
    physical = model.to_physical(now.x)
    own = now.x[None] if beside is None else torch.cat([now.x[None], beside])
    slots, values = [Slot(model=model, rows=len(own))], [model.to_physical(own)]
    probes: list[tuple[type[Effect], torch.Tensor]] = []
    for effect in effects:
        points = [_probe_values(effect, point, effort) for point in probe_points(effect)]
        extended = [model.extended(physical, effect, model.may_get(effect), each) for each in points]
        slots.append(Slot(model=extended[0][0], rows=len(points)))
        values.append(torch.stack([each for _, each in extended]))
        probes += [(effect, each) for each in points]
    batch = SideBySide(problem, slots, training=True)
    errors = batch.simulate(values, batch.dataset.train, _STRIDE)
    return probes, errors[1:] - errors[:1], batch.dataset.train


def _probe_values(effect: type[Effect], point: dict[str, float], effort: torch.Tensor) -> torch.Tensor:
    """A probe's physical values on each joint, (n, parameters): small torques for small drives."""
    values = start_values(effect, point).repeat(len(effort), 1)
    for k, parameter in enumerate(effect.parameters):
        if parameter.unit == "N m" and parameter.null == 0.0:
            values[:, k] *= (effort / _USUAL_EFFORT).clamp(max=1.0)
    return values


_USUAL_EFFORT = 5.0
"""Torque for which the probes' torques are meant [N m]."""


def starts_of(probe: Probe) -> torch.Tensor:
    """Where a refit starts: the probe, its amplitude multiplied by what fits best, (n, parameters)."""
    values = probe.values.clone()
    factor = probe.size.clamp(-20.0, 20.0)
    factor = torch.where(factor.abs() < 0.2, torch.sign(factor) * 0.2, factor)
    for k, p in enumerate(probe.effect.parameters):
        if p.null == 0.0:
            values[:, k] = (values[:, k] * factor).clamp(p.lower, p.upper)
        elif p.scale == "log" and p.null is not None and math.isfinite(p.null):  # a factor: its logarithm is the size
            values[:, k] = (p.null * (values[:, k] / p.null) ** factor).clamp(p.lower, p.upper)
    return values


def _blocks(where: torch.Tensor, control_dt: float) -> torch.Tensor:
    """Fold of each kept sample, (K, R); -1 where there is none."""
    steps = where.any(dim=1).nonzero()[:, 0][::_STRIDE]
    second = (steps * control_dt / _BLOCK_S).long()
    fold = (second[:, None] + torch.arange(where.shape[1])) % _FOLDS
    return torch.where(where[steps], fold, -1)


def free_columns(now: Fitted) -> torch.Tensor:
    """The Jacobian (P, K, R, n), without entries that sit at a bound."""
    if now.jacobian is None:
        raise ValueError("This needs a model that was fitted with keep_jacobian.")
    columns = now.jacobian.clone()
    fixed = (now.x.abs() > 1 - _AT_BOUND) | ~now.model.free
    for j, p in fixed.nonzero().tolist():
        columns[p, ..., j] = 0.0
    return columns


def _explained(
    error: torch.Tensor, jacobian: torch.Tensor, changes: torch.Tensor, fold: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Score and coefficient of every change, (probes, n) each.

    Args:
        error: (K, R, n).
        jacobian: (P, K, R, n).
        changes: (probes, K, R, n).
        fold: (K, R).
    """
    n, size = error.shape[-1], len(jacobian)
    scores = torch.zeros(len(changes), n, dtype=torch.float64)
    sizes = torch.zeros_like(scores)
    for j in range(n):
        per_fold = []
        columns = torch.cat([jacobian[..., j], error[None, ..., j]])
        scale = columns.flatten(1).norm(dim=1).clamp(min=1e-12)
        columns = columns / scale[:, None, None]
        probes = changes[..., j]
        amplitude = probes.flatten(1).norm(dim=1).clamp(min=1e-12)
        probes = probes / amplitude[:, None, None]
        for f in range(_FOLDS):
            at = fold == f
            a, s = columns[:, at], probes[:, at]
            per_fold.append(((a @ a.T).double(), (s @ a.T).double(), s.square().sum(dim=1, dtype=torch.float64)))
        base = _cross_validated([g for g, _, _ in per_fold], size)
        for i in range(len(changes)):
            if float(amplitude[i]) < 1e-9:
                continue
            grams = []
            for g, s, square in per_fold:
                whole = torch.empty(size + 2, size + 2, dtype=torch.float64)
                order = [*range(size), size + 1]
                whole[torch.tensor(order)[:, None], torch.tensor(order)] = g
                whole[size, order] = whole[order, size] = s[i]
                whole[size, size] = square[i]
                grams.append(whole)
            total = _cross_validated(grams, size + 1)
            scores[i, j] = 1 - total / base
            beta = _solve(torch.stack(grams).sum(dim=0), size + 1)
            sizes[i, j] = -float(beta[size] * scale[size] / amplitude[i])
    return scores, sizes


def _cross_validated(grams: list[torch.Tensor], size: int) -> float:
    """Squared error of regressing the last column on the first ``size``, each fold by the others."""
    whole, total = torch.stack(grams).sum(dim=0), 0.0
    for gram in grams:
        beta = _solve(whole - gram, size)
        a, b, c = gram[:size, :size], gram[:size, -1], gram[-1, -1]
        total += float(c - 2 * beta @ b + beta @ a @ beta)
    return max(total, 1e-30)


def _solve(gram: torch.Tensor, size: int) -> torch.Tensor:
    a = gram[:size, :size] + _RIDGE * torch.eye(size, dtype=torch.float64)
    return torch.linalg.solve(a, gram[:size, -1])
