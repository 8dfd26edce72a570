"""Derivatives of the residuals by finite differences, coloured by kinematic tree and as wide as the noise asks.

A simulation is noisy too: where links rattle or stick, a change of a parameter by a millionth changes the
motion as much as one by a hundredth. The noise η is measured at each look by a second difference (ECnoise of Moré and
Wild, SIAM J. Sci. Comput. 33, 2011, of order 2):

    η² = mean |r(x) − 2 r(x + p) + r(x + 2p)|² / 6

Steps are taken along the principal directions d of H = JᵀJ, as it was known before, each of a length s at which the
motion changes by ten times the noise, and at most by the error that is left:

    s = min(10 η, √score) / √(dᵀ H d),   10⁻⁵ ≤ s ≤ ½ min(1, 4 η / √score)

A smooth simulation has no noise, and gets the narrow steps: over wide ones the motion bends. Where links rattle, what
rattles is a small part of each change, also along a combination of parameters that hardly moves anything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from pace_optim.estimate.levenberg_marquardt import NO_INFLUENCE
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import Colouring

NARROW = 1e-5
"""Normalised step of smooth simulations: as small as rounding allows."""
_LITTLE = 0.1
"""Such a step moves no more than this part of the error: bounds that are far too wide make it shorter."""
_LONGEST = 0.5
"""Longest normalised step, where the noise is the error's ..."""
_FULL_REACH = 4.0
"""... fourth part or more; below, in proportion to its share."""
TIMES_NOISE = 10.0
"""Times the noise that a step changes the motion by."""
_AT_BOUND = 1e-3
"""A normalised entry this close to a bound is moved alone."""
NOISE_ROWS = 2
"""Vectors beside those of the derivatives, from which the noise follows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stencil:
    """Vectors around x whose residuals give the derivatives and the noise there."""

    vectors: torch.Tensor
    """Normalised, one for each colour and :data:`NOISE_ROWS` for the noise, (colours + 2, size)."""
    steps: torch.Tensor
    """The step that belongs to each entry, (size, size); zero for fixed entries."""
    colouring: Colouring

    def jacobian(self, residuals: Residuals) -> Jacobian:
        """The Jacobian from the residuals of x (row 0) and of the vectors (the rows after it), J = S⁻¹ Δr."""
        colouring = self.colouring
        change = residuals.error[1 : 1 + len(colouring.colours)] - residuals.error[:1]
        columns = torch.zeros_like(change)
        for joint in range(change.shape[-1]):
            entries = colouring.moving([joint])
            rows, at = [colouring.row_of[entry] for entry in entries], torch.tensor(entries)
            length = self.steps[at[:, None], at].norm(dim=1).clamp(min=1e-300)
            changes = change[rows, ..., joint].flatten(1) / length[:, None]
            known = changes.isfinite().all(dim=1, keepdim=True)  # a vector may diverge: its direction is left out
            steps = torch.where(known, self.steps[at[:, None], at] / length[:, None], 0.0)
            inverse = torch.linalg.pinv(steps)  # of lower rank where one diverges, or has no room between the bounds
            columns[rows, ..., joint] = (inverse @ torch.where(known, changes, 0.0)).view(-1, *change.shape[1:-1])
        return Jacobian(residuals=residuals.rows(0, 1), columns=columns, colouring=colouring)

    def noise(self, residuals: Residuals) -> float:
        """The simulation's own noise, √(mean over samples of Σ_joints) [rad], from the same rows; 0 if they diverge."""
        near, far = residuals.error[1 + len(self.colouring.colours) :][:NOISE_ROWS]
        second = residuals.error[0] - 2 * near + far
        noise = float((second.square().sum() / residuals.where.sum() / 6).sqrt())
        return noise if math.isfinite(noise) else 0.0


def stencil(
    x: torch.Tensor,
    colouring: Colouring,
    hessian: torch.Tensor | None = None,
    noise: float = 0.0,
    score: float = 0.0,
    first: float = 1e-2,
) -> Stencil:
    """Where to look around x.

    Args:
        hessian: JᵀJ as it is known, (size, size), of which the principal directions are; ``None``: each entry alone.
        noise: The simulation's own noise, as :meth:`Stencil.noise` has it [rad].
        score: The score at x [rad²].
        first: Normalised step along each entry where no principal directions are known.
    """
    narrow = torch.full((len(x),), NARROW, dtype=torch.float64)
    if hessian is None:
        directions = torch.eye(len(x), dtype=torch.float64)
        reach = torch.full((len(x),), first, dtype=torch.float64)
    else:
        little = _LITTLE * score**0.5
        narrow = narrow.minimum(little / hessian.diagonal().clamp(min=1e-300).sqrt()) if score > 0 else narrow
        directions = _principal_directions(hessian, x, colouring)
        change = ((directions @ hessian) * directions).sum(dim=1).clamp(min=1e-300).sqrt()
        longest = _LONGEST * min(1.0, _FULL_REACH * noise / max(score**0.5, 1e-300))
        least = (little / change).clamp(max=NARROW) if score > 0 else narrow
        reach = (min(TIMES_NOISE * noise, score**0.5) / change).clamp(max=max(NARROW, longest)).maximum(least)
    free = torch.tensor([bool(joints) for joints in colouring.joints])
    steps = _inside(x, directions * torch.where(free, reach, 0.0)[:, None])
    vectors = [x + steps[list(entries)].sum(dim=0) for entries in colouring.colours]
    aside = torch.where(free, torch.where(x > 0, -narrow, narrow), 0.0).to(x.dtype)
    every = torch.stack([*vectors, x + aside, x + 2 * aside]).clamp(-1.0, 1.0)
    return Stencil(vectors=every, steps=steps, colouring=colouring)


def _principal_directions(hessian: torch.Tensor, x: torch.Tensor, colouring: Colouring) -> torch.Tensor:
    """A direction for each entry whose largest component is 1, (size, size).

    Those of a tree's own entries are the principal directions of their part of H; those of entries that several trees
    share, what these change although the others make up for it. An entry at a bound, without influence, or of a sensor
    is alone.
    """
    joints = colouring.joints
    least = NO_INFLUENCE * float(hessian.diagonal().max())
    inner = [i for i in range(len(x)) if float(hessian[i, i]) > least and 1 - abs(float(x[i])) > _AT_BOUND]
    inner = [i for i in inner if i not in colouring.sensors]
    result = torch.eye(len(x), dtype=torch.float64)
    trees = {joints[i] for i in inner}
    shared = [i for i in inner if any(set(tree) < set(joints[i]) for tree in trees)]
    own = [i for i in inner if i not in shared]
    for tree in trees:
        at = torch.tensor([i for i in own if joints[i] == tree], dtype=torch.long)
        result[at[:, None], at] = _eigenvectors(hessian[at[:, None], at])
    if shared:
        at, others = torch.tensor(shared), torch.tensor(own, dtype=torch.long)
        made_up = -torch.linalg.pinv(hessian[others[:, None], others], hermitian=True) @ hessian[others[:, None], at]
        left = _eigenvectors(hessian[at[:, None], at] + hessian[at[:, None], others] @ made_up)
        result[at[:, None], at], result[at[:, None], others] = left, left @ made_up.T
    return result / result.abs().amax(dim=1, keepdim=True)


def _eigenvectors(hessian: torch.Tensor) -> torch.Tensor:
    """Eigenvectors, row by row, of a part of H that is scaled to a unit diagonal, as steps of its entries, (m, m)."""
    scale = hessian.diagonal().clamp(min=1e-300).rsqrt()
    _, vectors = torch.linalg.eigh(hessian * scale[:, None] * scale)
    return (vectors * scale[:, None]).T


def _inside(x: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
    """Steps to the side that has more room between the bounds, and as far as there is room, (size, size)."""

    def room(steps: torch.Tensor) -> torch.Tensor:
        to_bound = (torch.where(steps > 0, 1.0, -1.0) - x) / steps
        return torch.where(steps == 0, torch.inf, to_bound).amin(dim=1).nan_to_num(nan=0.0).clamp(0.0, 1.0)

    ahead, back = room(steps), room(-steps)
    return steps * torch.where(ahead >= back, ahead, -back)[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Jacobian:
    """The residuals at x and derivatives there or near it, block by block."""

    residuals: Residuals
    """Of x alone, m = 1."""
    columns: torch.Tensor
    """Derivative by each colour's entries, (colours, K, R, n) [rad per normalised unit]."""
    colouring: Colouring

    def column(self, entry: int) -> torch.Tensor:
        """Derivative of the error by an entry, (K, R, n); zero for joints that the entry does not move."""
        result = torch.zeros_like(self.residuals.error[0])
        if entry in self.colouring.row_of:  # else its bounds are equal
            joints = list(self.colouring.joints[entry])
            result[..., joints] = self.columns[self.colouring.row_of[entry]][..., joints]
        return result

    def times(self, vector: torch.Tensor) -> torch.Tensor:
        """J v, (K, R, n) [rad], of a normalised change (size,) of the entries."""
        result = torch.zeros_like(self.residuals.error[0])
        for row, entries in zip(self.columns, self.colouring.colours, strict=True):
            for entry in entries:
                joints = list(self.colouring.joints[entry])
                result[..., joints] += float(vector[entry]) * row[..., joints]
        return result

    def transposed_times(self, series: torch.Tensor) -> torch.Tensor:
        """Jᵀ s, (size,), of a series like the residuals, (K, R, n) [rad], divided by the number of samples."""
        result = torch.zeros(len(self.colouring.joints), dtype=torch.float64)
        for row, entries in zip(self.columns, self.colouring.colours, strict=True):
            by_joint = (row * series).sum(dim=(0, 1))
            for entry in entries:
                result[entry] = by_joint[list(self.colouring.joints[entry])].sum()
        return result / self.residuals.where.sum()

    def gradient_at(self, x: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
        """Half of the score's derivative, (size,), at another vector (size,) with its error (K, R, n) [rad]."""
        gradient, prior = self.transposed_times(error), self.residuals.prior
        return gradient if prior is None else gradient + prior.gradient_at(x) / self.residuals.where.sum()

    def normal_equations(self) -> tuple[torch.Tensor, torch.Tensor]:
        """JᵀJ (size, size) and Jᵀr (size,) with the prior's, divided by the number of samples as the score is."""
        size = len(self.colouring.joints)
        hessian, gradient = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size, dtype=torch.float64)
        row_of = self.colouring.row_of
        for joint in range(self.columns.shape[-1]):
            entries = [entry for entry in range(size) if joint in self.colouring.joints[entry]]
            # products are rounded by layout: contiguous, they are the same whatever these are views of
            block = self.columns[[row_of[entry] for entry in entries], ..., joint].reshape(len(entries), -1)
            block, error = block.contiguous(), self.residuals.error[0, ..., joint].reshape(-1)
            error = error.clone(memory_format=torch.contiguous_format)
            at = torch.tensor(entries)
            hessian[at[:, None], at] += block @ block.T
            gradient[at] += block @ error
        if (prior := self.residuals.prior) is not None:
            hessian, gradient = hessian + prior.hessian, gradient + prior.gradient_at(prior.x[0])
        samples = self.residuals.where.sum()
        return hessian / samples, gradient / samples
