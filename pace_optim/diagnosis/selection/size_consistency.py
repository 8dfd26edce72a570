"""Whether an effect has the same size in every recording: a proxy mostly does not."""

from __future__ import annotations

import torch

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
        (effects, n); zero where a joint does not have the effect. Halves of recordings stand for recordings where
        there are one or two: of two sizes nothing says which is right.

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


def _in_parts(values: torch.Tensor) -> torch.Tensor:
    """Values (…, K, R, n) with halves of recordings in place of them, as long as there are no more than two."""
    while values.shape[-2] <= 2:
        *_, samples, _, _ = values.shape
        half = samples // 2
        values = torch.cat([values[..., :half, :, :], values[..., half : 2 * half, :, :]], dim=-2)
    return values


def _left(columns: torch.Tensor, error: torch.Tensor) -> float:
    """Sum of squares of an error (K,) that columns (p, K) leave."""
    columns = columns[columns.norm(dim=1) > 0]
    columns = columns / columns.norm(dim=1, keepdim=True)
    gram = columns @ columns.T + _RIDGE * torch.eye(len(columns), dtype=columns.dtype)
    return float((error - torch.linalg.solve(gram, columns @ error) @ columns).square().sum())
