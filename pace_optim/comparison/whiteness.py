"""Whether what is left is white: noise, of which nothing can be said from the sample before."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

_LAGS = 20
_DRAWN = 40


def whiteness(error: np.ndarray, dt: float) -> dict[str, Any]:
    """Autocorrelation of an error, and what follows from it.

        ρ_l = Σ e_k e_{k+l} / Σ e_k²
        Q = K (K + 2) Σ_l ρ_l² / (K − l), l = 1 … 20   (Ljung and Box 1978)

    With tens of thousands of samples Q refuses even what is white for every purpose, so that sizes are given beside it:
    ``predictable`` is ρ₁², the share of the variance that the sample before explains, and ``correlation_time`` is
    dt (1 + 2 Σ ρ_l), up to the first ρ_l below zero: dt for white noise.

    Args:
        error: (K,) [rad].
        dt: Sample time [s].
    """
    rho = autocorrelation(error)
    lags = min(_LAGS, len(rho) - 1)
    l = np.arange(1, lags + 1)
    q = len(error) * (len(error) + 2) * float(np.sum(rho[1 : lags + 1] ** 2 / (len(error) - l)))
    below = np.flatnonzero(rho < 0)
    end = int(below[0]) if len(below) else len(rho)
    drawn = np.unique(np.round(np.geomspace(1, len(rho), _DRAWN)).astype(int) - 1)
    return {
        "lag_1": float(rho[1]),
        "predictable": float(rho[1] ** 2),
        "correlation_time": dt * (1 + 2 * float(rho[1:end].sum())),
        "ljung_box": {"q": q, "lags": lags, "p": float(stats.chi2.sf(q, lags))},
        "lag": drawn * dt,
        "autocorrelation": rho[drawn],
    }


def autocorrelation(error: np.ndarray) -> np.ndarray:
    """ρ_l for lags up to half of the samples, the mean taken away; 1, 0, 0, … of a constant."""
    rest = error - error.mean()
    size = 1 << (2 * len(rest) - 1).bit_length()
    product = np.fft.irfft(np.abs(np.fft.rfft(rest, size)) ** 2, size)[: max(2, len(rest) // 2)]
    if product[0] <= 0:
        return np.eye(1, len(product))[0]
    return product / product[0]
