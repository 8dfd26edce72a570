"""Whether an effect has the same size in every recording: what is really there does, what stands in for it does not."""

from __future__ import annotations

import torch

from pace_optim.diagnosis.descent import Fitted

_FEWEST = 3
"""Recordings, from which sizes can be compared."""
_RIDGE = 1e-9


def unevenness(now: Fitted) -> torch.Tensor:
    """What each effect could explain of a joint's squared training error if its size differed between recordings.

    With e the error, J its derivatives by the other parameters, and S_r those by the effect's on recording r alone,

        unevenness = 1 - SSE[J, S_1, ..., S_R] / SSE[J, S_1 + ... + S_R]

    to first order: nothing is simulated, and e has been fitted, so that the latter is the sum of its squares.

    Args:
        now: A model, fitted, with its Jacobian.

    Returns:
        (effects, n); zero where a joint does not have the effect or has it with the other joints' value, and where
        there are fewer than three recordings.

    Raises:
        ValueError: If there is no Jacobian.
    """
    if now.jacobian is None or now.error is None:
        raise ValueError("The sizes in each recording need a model that was fitted with keep_jacobian.")
    result = torch.zeros(now.model.has.shape, dtype=torch.float64)
    recordings = now.error.shape[1]
    if recordings < _FEWEST:
        return result
    for i, effect in enumerate(now.model.effects):
        own = torch.arange(now.model.size)[now.model.columns(effect)].tolist()
        others = [p for p in range(now.model.size) if p not in own]
        for j in now.model.has[i].nonzero()[:, 0].tolist():
            jacobian, error = now.jacobian[..., j].double(), now.error[..., j].double()
            alone = torch.diag_embed(jacobian[own]).permute(0, 3, 1, 2)  # (own, R, K, R)
            columns = torch.cat([jacobian[others].flatten(1), alone.flatten(2).flatten(0, 1)])
            result[i, j] = _explained(columns, error.flatten())
    return result


def _explained(columns: torch.Tensor, error: torch.Tensor) -> float:
    """Part of the square of an error (K,) that columns (p, K) explain."""
    columns = columns[columns.norm(dim=1) > 0]
    columns = columns / columns.norm(dim=1, keepdim=True)
    gram = columns @ columns.T + _RIDGE * torch.eye(len(columns), dtype=columns.dtype)
    left = error - torch.linalg.solve(gram, columns @ error) @ columns
    return 1.0 - float(left.square().sum() / error.square().sum().clamp(min=1e-300))
