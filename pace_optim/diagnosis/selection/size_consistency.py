"""Whether an effect has the same size in every recording: a proxy mostly does not."""

from __future__ import annotations

import torch

from pace_actuators.effects import Effect
from pace_optim.joints.fits.fitted import Fitted

_RIDGE = 1e-9


def unevenness(now: Fitted) -> torch.Tensor:
    """What each effect could explain of a joint's squared training error if its size differed between recordings.

    With e the error, J its derivatives by the other parameters, and S_r those by the effect's on recording r alone,

        unevenness = 1 - SSE[J, S_1, ..., S_R] / SSE[J, S_1 + ... + S_R]

    to first order: nothing is simulated. Parameters at a bound do not count.

    Args:
        now: A model, fitted, with its Jacobian.

    Returns:
        (effects, n); zero where a joint does not have the effect. Halves of two recordings, or quarters of one, stand
        for recordings: of two sizes nothing says which is right.

    Raises:
        ValueError: If there is no Jacobian.
    """
    result = torch.zeros(now.model.has.shape, dtype=torch.float64)
    if not bool(now.model.has.any()):
        return result
    columns = now.free_jacobian
    if now.error is None:
        raise ValueError("The sizes in each recording need a model that was fitted with keep_jacobian.")
    columns, errors = _in_parts(columns), _in_parts(now.error)
    for i, effect in enumerate(now.model.effects):
        own = torch.arange(now.model.size)[now.model.columns(effect)].tolist()
        others = [p for p in range(now.model.size) if p not in own]
        for j in now.model.has[i].nonzero()[:, 0].tolist():
            jacobian, error = columns[..., j].double(), errors[..., j].double().flatten()
            alone = torch.diag_embed(jacobian[own]).permute(0, 3, 1, 2)  # (own, R, K, R)
            together = torch.cat([jacobian[others].flatten(1), alone.flatten(2).flatten(0, 1)])
            result[i, j] = 1 - _left(together, error) / max(_left(jacobian.flatten(1), error), 1e-300)
    return result


def sizes_apart(now: Fitted, effect: type[Effect], joint: int) -> torch.Tensor:
    """An effect's sizes on a joint if each recording had its own, to first order, physical (R, parameters).

    Parts stand for one or two recordings, as in :func:`unevenness`.
    """
    columns = now.model.columns(effect)
    jacobian, error = _in_parts(now.free_jacobian)[..., joint].double(), now.error
    if error is None:
        raise ValueError("The sizes in each recording need a model that was fitted with keep_jacobian.")
    alone = torch.diag_embed(jacobian[columns]).permute(0, 3, 1, 2)  # (own, R, K, R)
    others = torch.cat([jacobian[: columns.start], jacobian[columns.stop :]])
    both = torch.cat([alone.flatten(2).flatten(0, 1), others.flatten(1)])
    moves = -_solved(both, _in_parts(error)[..., joint].double().flatten())
    own = moves[: alone.shape[0] * alone.shape[1]].reshape(alone.shape[:2]).T
    x = now.x[joint].repeat(len(own), 1)
    x[:, columns] = (x[:, columns] + own).clamp(-1.0, 1.0)
    whole = now.x.repeat(len(own), 1, 1)
    whole[:, joint] = x
    return torch.stack([now.model.to_physical(each)[joint, columns] for each in whole])


def _in_parts(values: torch.Tensor) -> torch.Tensor:
    """Values (…, K, R, n), recordings cut in halves as long as there are no more than two."""
    while values.shape[-2] <= 2:
        *_, samples, _, _ = values.shape
        half = samples // 2
        values = torch.cat([values[..., :half, :, :], values[..., half : 2 * half, :, :]], dim=-2)
    return values


def _left(columns: torch.Tensor, error: torch.Tensor) -> float:
    """Sum of squares of an error (K,) that columns (p, K) leave."""
    return float((error - _solved(columns, error) @ columns).square().sum())


def _solved(columns: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """Factors (p,) of columns (p, K) that explain most of an error (K,); 0 of columns that are zero."""
    norm = columns.norm(dim=1, keepdim=True)
    norm[norm == 0] = torch.inf
    columns = columns / norm
    gram = columns @ columns.T + _RIDGE * torch.eye(len(columns), dtype=columns.dtype)
    return torch.linalg.solve(gram, columns @ error) / norm[:, 0]
