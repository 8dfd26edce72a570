"""Exact Coulomb friction: impulses within their bounds, or no motion."""

from __future__ import annotations

import numpy as np

_SWEEPS = 40
_TOLERANCE = 1e-9  # of a sweep's largest change of speed [rad/s]


def friction_impulse(
    v: np.ndarray, A: np.ndarray, lower: np.ndarray, upper: np.ndarray, blocks: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Speeds after friction, and its impulses.

    Per joint the set-valued law: impulse λ in [lower, upper], v > 0 only at the lower, v < 0 only at the upper bound,
    where v = v_free + A λ. One joint has the closed form λ = clip(-v / A); several that are coupled are swept over
    (projected Gauss-Seidel), all kinematic trees at once.

    Args:
        v: Speeds without friction, (R, N) [rad/s].
        A: Inverse of the inertia, (R, K, B, B) for K trees of B coordinates [1/(kg m^2)].
        lower: Smallest impulse, (R, N) [N m s]; 0 for a coordinate without friction.
        upper: Largest impulse, (R, N) [N m s].
        blocks: Coordinates of each tree, (K, B).
        start: Impulses to start from, (R, N) [N m s].

    Returns:
        Speeds and impulses, each (R, N).
    """
    if blocks.size == 1:
        impulse = np.minimum(np.maximum(-v / A[:, 0, 0], lower), upper)
        return v + A[:, 0, 0] * impulse, impulse
    w = v[:, blocks]
    low, high = lower[:, blocks], upper[:, blocks]
    impulse = np.minimum(np.maximum(start[:, blocks], low), high)
    w = w + np.matmul(A, impulse[..., None])[..., 0]
    size = blocks.shape[1]
    diagonal = A[..., np.arange(size), np.arange(size)]
    for _ in range(_SWEEPS):
        largest = 0.0
        for j in range(size):
            new = np.minimum(np.maximum(impulse[..., j] - w[..., j] / diagonal[..., j], low[..., j]), high[..., j])
            change = new - impulse[..., j]
            impulse[..., j] = new
            w += A[..., j] * change[..., None]
            largest = max(largest, float(np.abs(change * diagonal[..., j]).max()))
        if largest < _TOLERANCE:
            break
    result, impulses = np.empty_like(v), np.empty_like(v)
    result[:, blocks], impulses[:, blocks] = w, impulse
    return result, impulses
