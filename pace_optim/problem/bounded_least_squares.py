"""Linear least squares within bounds."""

from __future__ import annotations

import numpy as np


def bounded_least_squares(
    table: np.ndarray, values: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, float]:
    """Coefficients of which most are free: what leaves its bounds furthest is held there, one after another.

    Args:
        table: (N, m).
        values: (N,).
        lower: (m,).
        upper: (m,).

    Returns:
        The coefficients, (m,), and the sum of squares that they leave.
    """
    scale = np.sqrt(np.square(table).mean(axis=0)) + 1e-12
    table = table / scale
    square, target = table.T @ table, table.T @ values
    square[np.diag_indices_from(square)] += 1e-9 * len(values)
    low, high = lower * scale, upper * scale
    found, free = np.zeros(len(scale)), np.ones(len(scale), dtype=bool)
    while free.any():
        found[free] = np.linalg.solve(square[np.ix_(free, free)], (target - square[:, ~free] @ found[~free])[free])
        beyond = np.where(free, np.maximum(low - found, found - high), 0.0)
        worst = int(beyond.argmax())
        if beyond[worst] <= 0:
            break
        found[worst], free[worst] = np.clip(found[worst], low[worst], high[worst]), False
    return found / scale, float(np.square(values - table @ found).sum())
