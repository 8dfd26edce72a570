"""Which of several effects is there, where small amounts of many others may be there too."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.candidates.screening import simulated_probes
from pace_optim.diagnosis.diagnosis_cfg import CandidatesCfg
from pace_optim.single_joint_fits.fits import Fits
from pace_optim.single_joint_fits.fitted import Fitted
from pace_optim.single_joint_model.problem import TwinProblem

_LEAST, _MOST, _POINTS = 1e-6, 1e4, 81
"""Ratios λ that are tried, in parts of what a probe of unit size explains, evenly by their logarithm."""
_RIDGE = 1e-9


def log_evidence(
    fits: Fits,
    problem: TwinProblem,
    models: Mapping[type[Effect], Fitted],
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    cfg: CandidatesCfg,
) -> dict[type[Effect], torch.Tensor]:
    """Log evidence of models that differ in one effect, where all other effects may be there in small amounts.

    The error that a model leaves is not white: it has the forms of what else is missing. With e that error, free of
    what the model's own parameters explain to first order, and S_i the change that another effect i makes, scaled to
    unit RMS,

        e = Σ_i b_i S_i + ε,   b_i ~ N(0, ρ²),   ε ~ N(0, s²) for each of N independent samples.

    A model that lacks the main effect needs a large b for it, which makes ρ large for all. With λ = s² / (N ρ²), w the
    eigenvalues of <S_i S_j>, c = <S e> along them, and p parameters of the effect,

        q = <e²> - Σ c² / (w + λ),   log evidence = max_λ -½ (N log q + Σ log(1 + w / λ) + p log N)

    (MacKay 1992, Bayesian interpolation). Simulated in windows at the control step.

    Args:
        fits: Fits models.
        problem: The joints simulated alone.
        models: The models, fitted, by the effect in which they differ.
        effects: Everything that may be there.
        effort: Typical torque of each joint, (n,) [N m].
        cfg: When errors are independent.

    Returns:
        Of each joint, (n,).
    """
    coarse = problem.coarse()
    seen = fits.looked_at(coarse, [replace(fitted, tried=effect) for effect, fitted in models.items()])
    found = fits.shared_out(
        lambda own: [_of_model(fits, coarse, each, effects, effort, cfg) for each in own],
        seen,
        [each.tried for each in seen],
    )
    return dict(zip(models, found, strict=True))


def _of_model(
    fits: Fits,
    problem: TwinProblem,
    seen: Fitted,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    cfg: CandidatesCfg,
) -> torch.Tensor:
    """:func:`log_evidence` of one model."""
    if seen.error is None or seen.tried is None:
        raise ValueError("The evidence needs a model that was fitted with keep_jacobian, and the effect it is about.")
    others = [effect for effect in effects if bool(seen.model.allowed_joints(effect).any())]
    probes, changes, where = simulated_probes(fits, problem, seen, others, effort)
    count = Counter(effect for effect, _ in probes)
    parts = torch.tensor([1 / math.sqrt(count[effect]) for effect, _ in probes], dtype=torch.float64)
    independent = max(2.0, float(where.sum()) * problem.control_dt / cfg.independent_s)
    jacobian, numbers = seen.free_jacobian, len(seen.tried.parameters)
    result = torch.full((seen.model.num_joints,), -torch.inf, dtype=torch.float64)
    for j in range(seen.model.num_joints):
        may = torch.tensor([bool(seen.model.allowed_joints(effect)[j]) for effect, _ in probes], dtype=torch.float64)
        own, rest, error = jacobian[..., j].flatten(1), changes[..., j].flatten(1), seen.error[..., j].flatten()
        result[j] = _evidence(own, rest, error, parts * may, independent) - 0.5 * numbers * math.log(independent)
    return result


def _evidence(
    own: torch.Tensor, others: torch.Tensor, error: torch.Tensor, parts: torch.Tensor, independent: float
) -> float:
    """Log evidence of an error (K,), beside columns (p, K) that are free and others (m, K) that are small.

    Args:
        own: Derivatives by the model's own parameters.
        others: Changes that other effects make.
        error: What the model leaves.
        parts: RMS that each of the others is scaled to, (m,).
        independent: Number N of independent samples.
    """
    columns = torch.cat([own, others, error[None]]).double()
    gram = columns @ columns.T / max(1, int((error != 0).sum()))
    size = gram.diagonal().sqrt()
    scale = torch.cat([torch.ones(len(own)).to(gram), parts, size[-1:]]) / size.clamp(min=1e-12)
    gram = gram * scale[:, None] * scale
    a, b = gram[: len(own), : len(own)], gram[: len(own), len(own) :]
    a = a + _RIDGE * torch.eye(len(own), dtype=gram.dtype)
    left = gram[len(own) :, len(own) :] - b.T @ torch.linalg.solve(a, b)
    w, along = torch.linalg.eigh(left[:-1, :-1])
    w, c = w.clamp(min=0.0), along.T @ left[:-1, -1]
    ratio = torch.logspace(math.log10(_LEAST), math.log10(_MOST), _POINTS, dtype=gram.dtype)[:, None]
    q = (left[-1, -1] - (c**2 / (w + ratio)).sum(dim=1)).clamp(min=1e-12)
    evidence = -0.5 * (independent * q.log() + (1 + w / ratio).log().sum(dim=1))
    return float(evidence.max())
