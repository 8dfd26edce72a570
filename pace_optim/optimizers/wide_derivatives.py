"""Derivatives over wide steps, where the motion is rough: over small ones they are those of what rattles.

Links that rattle against their stops make the motion chaotic: a change of a parameter by a millionth changes it there
as much as one by a hundredth, if only by fractions of the error. Derivatives over small steps are then those of the
chaos, thousands of times too large, and a combination of parameters that the motion hardly shows drowns in it even over
steps of a hundredth. Derivatives are taken along the principal directions of JᵀJ instead, each over a step that changes
the motion by as much as the error that is left: what rattles is a small part of every change then.
"""

from __future__ import annotations

import torch

from pace_optim.optimizers.jacobian import Colouring, Jacobian
from pace_optim.problem.evaluator import Residuals

_FIRST = 1e-2
"""Normalised step along each parameter before directions are known."""
_SHORTEST, _LONGEST = 1e-5, 0.5
"""How far the parameter that moves most moves along a direction, normalised."""
_AT_BOUND = 1e-3
"""A normalised entry this close to a bound is moved alone."""


def probe(x: torch.Tensor) -> torch.Tensor:
    """How far the vector that tells whether the motion is rough lies from x, normalised (size,)."""
    return torch.where(x > 0, -_FIRST, _FIRST).to(x.dtype)


def is_rough(there: Jacobian, probed: torch.Tensor, move: torch.Tensor) -> bool:
    """Whether derivatives say less than nothing of what a wide step changes.

    Args:
        there: Derivatives over small steps.
        probed: Error after the wide step, (K, R, n) [rad].
        move: That step, normalised (size,).
    """
    change = probed - there.residuals.error[0]
    return float((change - there.times(move)).square().sum()) > float(change.square().sum())


def first_directions(size: int) -> torch.Tensor:
    """Steps along each parameter, (size, size)."""
    return _FIRST * torch.eye(size, dtype=torch.float64)


def principal_directions(there: Jacobian, x: torch.Tensor) -> torch.Tensor:
    """Steps that each change the motion by as much as the error that is left, one for each entry, (size, size).

    Those of a tree's own entries are the principal directions of their part of JᵀJ; those of entries that move all
    trees, what these change although the others make up for it.

    Args:
        there: Derivatives, as they are known.
        x: Where they are taken, normalised (size,).
    """
    hessian, _ = there.normal_equations()
    score, joints = float(there.residuals.score[0]), there.colouring.joints
    result = torch.zeros_like(hessian)
    inner = [i for i in range(len(x)) if float(hessian[i, i]) > 0 and 1 - abs(float(x[i])) > _AT_BOUND]
    for i in set(range(len(x))) - set(inner):
        if joints[i]:  # an entry without joints is fixed
            result[i, i] = 1.0 if float(hessian[i, i]) <= 0 else (score / float(hessian[i, i])) ** 0.5
    trees = {joints[i] for i in inner}
    shared = [i for i in inner if any(set(tree) < set(joints[i]) for tree in trees)]
    own = [i for i in inner if i not in shared]
    for tree in trees:
        at = torch.tensor([i for i in own if joints[i] == tree], dtype=torch.long)
        result[at[:, None], at] = _principal(hessian[at[:, None], at], score)
    if shared:
        at, others = torch.tensor(shared), torch.tensor(own)
        made_up = -torch.linalg.pinv(hessian[others[:, None], others], hermitian=True) @ hessian[others[:, None], at]
        left = _principal(hessian[at[:, None], at] + hessian[at[:, None], others] @ made_up, score)
        result[at[:, None], at], result[at[:, None], others] = left, left @ made_up.T
    furthest = result.abs().amax(dim=1, keepdim=True).clamp(min=1e-300)
    return result * (furthest.clamp(_SHORTEST, _LONGEST) / furthest)


def _principal(hessian: torch.Tensor, score: float) -> torch.Tensor:
    """Steps along the eigenvectors of a part of JᵀJ, scaled to a unit diagonal, (m, m)."""
    scale = hessian.diagonal().clamp(min=1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(hessian * scale[:, None] * scale)
    return (vectors * scale[:, None]).T * (score / values.clamp(min=1e-12)).sqrt()[:, None]


def moved_along(x: torch.Tensor, directions: torch.Tensor, colouring: Colouring) -> tuple[torch.Tensor, torch.Tensor]:
    """The vectors whose residuals give the Jacobian at x over directions.

    Args:
        x: Normalised vector, (size,).
        directions: One for each entry, (size, size).
        colouring: Which entries' go together.

    Returns:
        Normalised vectors (colours, size), and the steps (size, size): to the side that has more room, and as far as
        there is room.
    """
    ahead = _room(x, directions)
    back = _room(x, -directions)
    steps = directions * torch.where(ahead >= back, ahead, -back)[:, None]
    vectors = torch.stack([x + steps[list(entries)].sum(dim=0) for entries in colouring.colours])
    return vectors.clamp(-1.0, 1.0), steps


def _room(x: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """The part of each step, at most 1, that stays within the bounds, (size,)."""
    to_bound = (torch.where(directions > 0, 1.0, -1.0) - x) / directions
    return torch.where(directions == 0, torch.inf, to_bound).amin(dim=1).clamp(0.0, 1.0)


def jacobian_over(residuals: Residuals, steps: torch.Tensor, colouring: Colouring) -> Jacobian:
    """The Jacobian from the residuals of x (row 0) and of :func:`moved_along` (the rows after it), J = S⁻¹ Δr."""
    change = residuals.error[1 : 1 + len(colouring.colours)] - residuals.error[:1]
    columns = torch.zeros_like(change)
    row_of = {entry: c for c, entries in enumerate(colouring.colours) for entry in entries}
    for joint in range(change.shape[-1]):
        entries = [entry for entry in row_of if joint in colouring.joints[entry]]
        rows, at = [row_of[entry] for entry in entries], torch.tensor(entries)
        changes = change[rows, ..., joint]
        columns[rows, ..., joint] = torch.linalg.solve(steps[at[:, None], at], changes.flatten(1)).view(changes.shape)
    return Jacobian(residuals=residuals.rows(0, 1), columns=columns, colouring=colouring, is_wide=True)
