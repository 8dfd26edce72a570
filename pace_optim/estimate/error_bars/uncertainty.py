"""How well each parameter is known: error bars that know of the residuals' autocorrelation."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import signal

from pace_optim.estimate.derivatives import Jacobian
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import Colouring, ParameterSpace
from pace_optim.recording.dataset import Torques

AT_BOUND = 1e-3
"""A normalised entry this close to -1 or 1 is at its bound, unless its error bar excludes the bound."""
NO_INFLUENCE = 1e-6
"""A parameter whose whole range moves the joints by less than this (RMS) has no influence [rad]."""
WEAK_STD = 0.05
"""A direction known no better than this part of the bound range is confounded."""
SEEN = 1e-12
"""A direction of JᵀJ, scaled to a unit diagonal, with less than this moves nothing but rounding errors."""
_NOTHING = 1e-10
"""One with less than this moves nothing that counts."""
_NOTHING_KNOWN = 1e6
"""Variance of a direction that moves nothing, of the prior's."""
_WEAK_SHARE = 0.3
SURE = 2.0
"""Standard deviations that separate two values."""
HARDLY_KNOWN = 1 / (2 * SURE)
"""A standard deviation above this part of the bound range leaves a parameter open: every value is like the middle."""
ANYWHERE = 1 / 3
"""Variance of a value that may be anywhere between its bounds, normalised to -1 and 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainty:
    """What the recording says about the parameters, in the order of the space's labels."""

    std: np.ndarray
    """Standard deviation in physical units, (size,); NaN where a parameter is at its bound or has no influence."""
    correlation: np.ndarray
    """(size, size); NaN rows where ``std`` is NaN."""
    at_bound: tuple[str, ...]
    """Labels of parameters at a bound."""
    no_influence: tuple[str, ...]
    """Labels of parameters that do not move the joints."""
    indistinguishable: tuple[tuple[str, ...], ...]
    """Sets of labels that the recording cannot separate."""
    by_chance: tuple[str, ...] = ()
    """Labels of those at a bound that could be anywhere between their bounds."""
    combinations: tuple[tuple[str, ...], ...] = ()
    """Those of them of which a combination moves nothing at all."""
    step: np.ndarray | None = None
    """The part of each value that comes from the steps of physics and drives, (size,); ``std`` and ``correlation``
    then include it."""

    def without_error_bars(self) -> Uncertainty:
        """The same without error bars, where they mean nothing."""
        nothing = np.full_like(self.std, np.nan)
        return replace(self, std=nothing, correlation=np.full_like(self.correlation, np.nan), step=None)

    def with_step(self, share: np.ndarray) -> Uncertainty:
        """The same with the part of each value that comes from a step, (size,): an error of one size for all."""
        std = np.hypot(self.std, share)
        scale = np.where(std > 0, std, 1.0)
        covariance = self.correlation * np.outer(self.std, self.std) + np.outer(share, share)
        step = share if self.step is None else np.hypot(self.step, share)
        return replace(self, std=std, correlation=covariance / np.outer(scale, scale), step=step)


def estimate_uncertainty(
    jacobian: Jacobian,
    space: ParameterSpace,
    x: torch.Tensor,
    initial: torch.Tensor | None = None,
    initial_joints: Sequence[tuple[int, ...]] = (),
    held: Sequence[str] = (),
    middle: np.ndarray | None = None,
) -> Uncertainty:
    """Error bars at an optimum.

    With J the Jacobian, H = JᵀJ and Σ the covariance of the residuals, the estimate's covariance is

        C = H⁻¹ (Jᵀ Σ J) H⁻¹

    (Huber's sandwich; Hansen 1982 for autocorrelated errors). Σ is taken as stationary for each joint of each
    recording, its autocovariance estimated from the residuals and tapered where it is lost in the noise. A prior of
    precision P adds σ² P to H and σ⁴ P to the middle, so that what moves nothing keeps its prior's error bar. A
    simulation starts at the first measured position: that sample's noise moves all that follows, and is added to Σ.
    Of a walking robot's swings, Σ is known (:mod:`pace_optim.estimate.error_bars.assessment`).

    Args:
        initial: Derivatives of the residuals by the first positions of ``initial_joints``, (sets, K, R, n).
        initial_joints: Joints whose first position was moved together.
        held: Labels of what is held where it is; it has no error bar, and the others have those beside it.
        middle: JᵀΣJ where Σ is known, normalised (size, size); ``None``: from the residuals.
    """
    samples = int(jacobian.residuals.where.sum())
    hessian, _ = jacobian.normal_equations()
    middle = _middle(jacobian) if middle is None else middle
    if (prior := jacobian.residuals.prior) is not None:
        middle += prior.noise * prior.hessian.numpy()
    if initial is not None:
        middle += _from_first_sample(jacobian, initial, initial_joints)
    return uncertainty_of(hessian.numpy() * samples, middle, samples, jacobian.colouring, space, x, held)


def uncertainty_of(
    hessian: np.ndarray,
    middle: np.ndarray,
    samples: int,
    colouring: Colouring,
    space: ParameterSpace,
    x: torch.Tensor,
    held: Sequence[str] = (),
) -> Uncertainty:
    """Error bars from the two matrices of the sandwich C = H⁻¹ (Jᵀ Σ J) H⁻¹.

    Args:
        hessian: H = JᵀJ, normalised (size, size) [rad²].
        middle: JᵀΣJ, normalised (size, size) [rad⁴].
        held: Labels of what is held where it is.
    """
    size = space.size
    whole_range = 2 * np.sqrt(np.clip(hessian.diagonal(), 0, None) / samples)
    position = x.numpy()
    fixed = (space.upper <= space.lower).numpy()
    silent = (whole_range < NO_INFLUENCE) & ~fixed
    fixed |= np.isin(space.labels, list(held))
    inside = 1 - np.abs(position)
    bound = (inside < AT_BOUND) & ~fixed
    if (near := bound & ~silent & (inside > 0)).any():
        free = np.flatnonzero(~(bound & ~near | silent | fixed))
        told = np.zeros(size, dtype=bool)
        told[free] = SURE * np.sqrt(_covariance(hessian, middle, samples, free).diagonal().clip(0)) < inside[free]
        bound &= ~(near & told)
    free = np.flatnonzero(~(bound | silent | fixed))
    by_chance = []
    for entry in np.flatnonzero(bound & ~silent):
        beside = np.sort(np.append(free, entry))
        variance = _covariance(hessian, middle, samples, beside).diagonal()[np.searchsorted(beside, entry)]
        by_chance += [space.labels[entry]] if variance > (2 * HARDLY_KNOWN) ** 2 else []
    std, correlation = np.full(size, np.nan), np.full((size, size), np.nan)
    groups: dict[tuple[str, ...], bool] = {}
    if len(free):
        h = hessian[np.ix_(free, free)]
        covariance = _covariance(hessian, middle, samples, free)
        normalised = np.sqrt(np.clip(covariance.diagonal(), 0, None))
        std[free] = normalised * space.slope(x).numpy()[free]
        outer = np.where(normalised > 0, normalised, 1.0)
        correlation[np.ix_(free, free)] = covariance / outer[:, None] / outer
        for members in _trees(colouring, free):
            weak = _weak_directions(h[np.ix_(members, members)], normalised[members], free[members], space)
            groups = weak | groups
    labels = space.labels
    return Uncertainty(
        std=std,
        correlation=correlation,
        at_bound=tuple(labels[i] for i in np.flatnonzero(bound)),
        by_chance=tuple(by_chance),
        no_influence=tuple(labels[i] for i in np.flatnonzero(silent)),
        indistinguishable=tuple(groups),
        combinations=tuple(group for group, nothing in groups.items() if nothing),
    )


def _covariance(hessian: np.ndarray, middle: np.ndarray, samples: int, free: np.ndarray) -> np.ndarray:
    """C = H⁻¹ (Jᵀ Σ J) H⁻¹ of some entries, the others held; a direction that moves nothing may be anywhere."""
    inverse, unseen = inverse_of(hessian[np.ix_(free, free)])
    covariance = inverse @ middle[np.ix_(free, free)] @ inverse * samples / max(1, samples - len(free))
    return covariance + ANYWHERE * unseen @ unseen.T


def inverse_of(hessian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H⁻¹ of parameters that move the joints, without the directions that move nothing, and those, (m, k)."""
    scale = 1 / np.sqrt(hessian.diagonal())
    values, vectors = _eigen(hessian * scale[:, None] * scale)
    seen = values > SEEN
    inverse = (vectors[seen].T / values[seen]) @ vectors[seen] * scale[:, None] * scale
    return inverse, np.linalg.qr(vectors[~seen].T * scale[:, None])[0]


def _middle(jacobian: Jacobian) -> np.ndarray:
    """JᵀΣJ, (size, size)."""
    residuals, colouring = jacobian.residuals, jacobian.colouring
    total = np.zeros((len(colouring.joints), len(colouring.joints)))
    for r in range(residuals.where.shape[1]):
        at = residuals.where[:, r]
        if not bool(at.any()):
            continue
        for joint in range(residuals.error.shape[-1]):
            own = colouring.moving([joint])
            columns = jacobian.columns[[colouring.row_of[entry] for entry in own]][:, at, r, joint].numpy()
            error = residuals.error[0, at, r, joint].numpy()
            total[np.ix_(own, own)] += columns @ filtered(columns, autocovariance(error)).T
    return total


def _from_first_sample(
    jacobian: Jacobian, initial: torch.Tensor, initial_joints: Sequence[tuple[int, ...]]
) -> np.ndarray:
    """JᵀSSᵀJ σ², S the derivative by a joint's first position and σ² the variance of its samples' white noise."""
    residuals, colouring = jacobian.residuals, jacobian.colouring
    total = np.zeros((len(colouring.joints), len(colouring.joints)))
    for tree in dict.fromkeys(_tree_of(joint, colouring) for joints in initial_joints for joint in joints):
        own = colouring.moving(tree)
        rows = [colouring.row_of[entry] for entry in own]
        sets = [(i, joint) for i, joints in enumerate(initial_joints) for joint in joints if joint in tree]
        for r in range(residuals.num_recordings):
            at = residuals.where[:, r]
            if int(at.sum()) < 2:
                continue
            effect = np.zeros((len(own), len(sets)))
            for column, joint in itertools.product(residuals.columns_of(r), tree):
                columns = jacobian.columns[rows, :, column, joint]
                effect += (columns @ initial[[i for i, _ in sets], :, column, joint].T).numpy()
            error = residuals.error[0, at, r][:, [joint for _, joint in sets]]
            effect *= (0.5 * error.diff(dim=0).square().mean(dim=0)).sqrt().numpy()
            total[np.ix_(own, own)] += effect @ effect.T
    return total


def _tree_of(joint: int, colouring: Colouring) -> tuple[int, ...]:
    """What a joint moves: the joints of the entries that move it and not all joints."""
    return min((moved for moved in colouring.joints if joint in moved), key=len, default=())


def autocovariance(error: np.ndarray) -> np.ndarray:
    """Autocovariance of a series about zero, lags 0 … L, tapered (Parzen) to zero where it is lost in the noise.

    Args:
        error: (T,).
    """
    count = len(error)
    full = signal.correlate(error, error, mode="full", method="fft")[count - 1 :] / count
    if full[0] <= 0:
        return np.zeros(1)
    quiet = np.abs(full / full[0]) < 2 / np.sqrt(count)
    run = 5
    lags = np.flatnonzero(np.convolve(quiet[: count // 4], np.ones(run), mode="valid") == run)
    last = int(lags[0]) if len(lags) else count // 4
    length = min(count // 4, 3 * last) if last > 1 else 1
    taper = signal.windows.parzen(2 * length + 1)[length:]
    return (full[: length + 1] * taper)[: max(1, length)]


def sandwich(columns: np.ndarray, error: np.ndarray, prior: float = np.inf) -> np.ndarray:
    """The covariance C = H⁻¹ (Jᵀ Σ J) H⁻¹ of the parameters of one joint, (P, P).

    A combination of parameters that does not move the joint is known by the prior alone, the others by both:
    (C⁻¹ + 1/p)⁻¹ = p - p² (C + p)⁻¹ with the prior's variance p.

    Args:
        columns: J, zero where a sample does not count, (P, K, R).
        error: (K, R).
        prior: Variance of each parameter before the recording; infinite: nothing is known.
    """
    flat = columns.reshape(len(columns), -1)
    scale = 1 / np.maximum(np.linalg.norm(flat, axis=1), 1e-300)
    flat, columns = flat * scale[:, None], columns * scale[:, None, None]
    values, vectors = _eigen(flat @ flat.T)
    seen = values > SEEN
    middle = np.zeros((len(flat), len(flat)))
    for r in range(error.shape[1]):
        middle += columns[..., r] @ filtered(columns[..., r], autocovariance(error[:, r])).T
    inverse = (vectors[seen].T / values[seen]) @ vectors[seen] * scale[:, None]
    covariance = inverse @ middle @ inverse.T
    if not np.isfinite(prior):
        return covariance
    unseen, _ = np.linalg.qr(vectors[~seen].T * scale[:, None])
    covariance += prior * _NOTHING_KNOWN * unseen @ unseen.T
    every = np.eye(len(flat))
    return prior * every - prior**2 * np.linalg.inv(covariance + prior * every)


def filtered(columns: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Σ applied to each row of (entries, T), Σ the Toeplitz matrix of an autocovariance."""
    kernel = np.concatenate([covariance[:0:-1], covariance])
    return signal.fftconvolve(columns, kernel[None, :], mode="same", axes=1) if len(kernel) > 1 else columns * kernel


def _trees(colouring: Colouring, free: np.ndarray) -> list[list[int]]:
    """Positions in ``free`` of the entries that move the same joints, each with those that move all joints."""
    joints = [colouring.joints[entry] for entry in free.tolist()]
    widest = max(len(moved) for moved in joints)
    parts = sorted({moved for moved in joints if len(moved) < widest}) or [joints[0]]
    return [[i for i, moved in enumerate(joints) if moved == part or len(moved) == widest] for part in parts]


def _weak_directions(
    hessian: np.ndarray, std: np.ndarray, entries: np.ndarray, space: ParameterSpace
) -> dict[tuple[str, ...], bool]:
    """Sets of parameters that move the joints almost alike and are, together, hardly known; whether nothing moves.

    A small eigenvalue of JᵀJ scaled to a unit diagonal is a combination of parameters that hardly moves the joints
    although each of its members does.

    Args:
        hessian: JᵀJ of some entries, (m, m).
        std: Their standard deviations, normalised (m,).
        entries: Where they are in the full vector, (m,).
    """
    groups: dict[tuple[str, ...], bool] = {}
    scale = 1 / np.sqrt(hessian.diagonal())
    for value, vector in zip(*_eigen(hessian * scale[:, None] * scale), strict=True):
        members = np.flatnonzero(np.abs(vector) > _WEAK_SHARE)
        hardly_known = bool((std[members] > 2 * WEAK_STD).any())
        nothing = bool(value < _NOTHING)
        if len(members) > 1 and (nothing or (value < 0.1 and hardly_known)):
            groups[tuple(space.labels[int(entries[i])] for i in members)] = nothing
    return groups


def _eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and, row by row, eigenvectors of a symmetric matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return values, vectors.T


def torque_noise(residuals: Residuals, torques: Torques) -> list[float]:
    """Standard deviation of the white noise that would hide as much of each joint's torque, (n,) [N m].

    With e what is left of a torque τ, and Σ the covariance of e by its autocovariance, a scale of the torque would have
    the variance τᵀΣτ / (τᵀτ)². White noise of the variance

        σ² = τᵀΣτ / τᵀτ

    leaves it the same. Errors that go on from sample to sample, as a filter makes them, count as the noise of few.
    """
    error, known = residuals.torque_errors(torques)
    measured, result = torques.measured[residuals.step], []
    for j in range(error.shape[-1]):
        spread = power = 0.0
        for r in range(error.shape[1]):
            at = known[:, r, j]
            if int(at.sum()) > 1:
                torque, left = measured[at, r, j].numpy(), error[at, r, j].numpy()
                spread += float(torque @ filtered(torque[None], autocovariance(left))[0])
                power += float(torque @ torque)
        result.append((max(spread, 0.0) / power) ** 0.5 if power > 0 else 0.0)
    return result
