"""The law of a drive, read from the torque that its recording has: a regression, one joint at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pace_optim.recording import Recording

from .table import Table

SURE = 5.0
"""Standard deviations, and ..."""
APART = 0.05
"""... part of what is stated, by which a value must differ from it to contradict it."""
_ROUNDS = 3
_BELOW_THE_LIMIT = 0.98
"""Torques above this part of a limit say nothing of the law."""
_START_BELOW = 0.85
"""The same where the law is not known yet, and noise may lift a torque over it or not."""
_LEAST_AT_THE_LIMIT = 5
"""Samples that make a limit."""
_LEVELS = np.linspace(0.4, 1.0, 31)
"""Quantiles of the torque's size that are tried as its limit."""
_HALF = 0.5
"""Quantile of the torque's size below which one start takes it to be free, in case most of the rest is cut."""
_PLATEAU = 0.05
"""A limit that is one is held to within this part of it; one that is not depends on something, as on the speed."""


@dataclass(frozen=True, kw_only=True)
class MeasuredLaw:
    """τ = kp (q* - q) + kd (v* - v) + c τ_ff + τ_0 within ± limit, as the torque of one joint says it."""

    joint: str
    """The joint."""
    stiffness: float
    """kp [N m/rad]."""
    damping: float
    """kd [N m s/rad]."""
    feed_forward: float | None
    """Part c of the commanded torque that the drive takes; ``None`` where no torque was commanded."""
    offset: float
    """Constant torque τ_0 [N m]."""
    std: dict[str, float]
    """Standard deviations of these, by field; one that was not sought has none."""
    delay: float
    """How much later a command is in the torque than the position that is [control steps]."""
    feedback_lag: float
    """How old the position in the torque is [control steps]; < 0 where a log has a torque before its position."""
    resolution: float
    """What the delay can be told to [control steps]: commands count from one sample to the next."""
    limit: float | None
    """Where the torque was cut [N m]; ``None`` where it was not."""
    peak: float
    """Largest torque [N m]."""
    r_squared: float
    """Part of the torque's variance that the law explains, below the limit."""
    residual: float
    """Standard deviation of what it does not explain [N m]."""
    num_samples: int
    """Samples below the limit."""


def read_law(recording: Recording, joint: int, longest_delay: float) -> MeasuredLaw | None:
    """The law that a joint's measured torque follows best; ``None`` where there is no torque to follow one.

    Args:
        recording: On the control grid (:func:`pace_optim.recording.conform_recording`).
        joint: Its column.
        longest_delay: Up to where the delay of commands is sought [control steps].
    """
    table = Table.of(recording, joint, longest_delay)
    if table is None:
        return None
    size = np.abs(table.torque)
    starts = [np.ones(len(size), dtype=bool), size < _START_BELOW * np.quantile(size, _HALF)]
    found = [_settled(table, below) for below in starts if below.sum() >= len(size) // 10]
    fit, limit = min(found, key=lambda each: _error(table, each[0].columns, each[0].below, each[1] or np.inf))
    return _law(recording.joint_names[joint], table, fit, limit)


def _settled(table: Table, below: np.ndarray) -> tuple[_Fit, float | None]:
    """Lags and limit that agree with each other, from samples that may be below the limit."""
    limit = None
    for _ in range(_ROUNDS):
        limit, new = _limit(table, _best_lags(table, below))
        if np.array_equal(new, below):
            break
        below = new
    return _best_lags(table, below), limit


def has_offset(law: MeasuredLaw) -> bool:
    """Whether a drive gives a constant torque of its own."""
    return abs(law.offset) > max(SURE * law.std["offset"], APART * law.peak)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """A linear fit at chosen lags."""

    table: Table
    below: np.ndarray
    """Samples that it was fitted to, (K,) bool."""
    names: tuple[str, ...]
    """Its coefficients."""
    terms: np.ndarray
    """Their columns as combinations of the table's, (m, p)."""
    command_lag: float
    """[control steps]."""
    feedback_lag: float
    """[control steps]."""

    @cached_property
    def columns(self) -> np.ndarray:
        """(K, p)."""
        return self.table.columns @ self.terms

    @cached_property
    def coefficients(self) -> np.ndarray:
        """(p,)."""
        return np.linalg.lstsq(self.columns[self.below], self.table.torque[self.below], rcond=None)[0]

    @property
    def predicted(self) -> np.ndarray:
        """Torque without a limit, (K,) [N m]."""
        return self.columns @ self.coefficients

    def std(self) -> np.ndarray:
        """Standard deviations of the coefficients, (p,): residuals that go on from sample to sample count less."""
        own = self.columns[self.below]
        residual = np.where(self.below, self.table.torque - self.predicted, 0.0)
        pairs = self.table.follows & self.below[1:] & self.below[:-1]
        variance = float(residual[self.below] @ residual[self.below]) / max(1, len(own) - len(self.names))
        alike = float((residual[1:] * residual[:-1])[pairs].mean()) / variance if variance and pairs.any() else 0.0
        rho = min(max(alike, 0.0), 0.99)
        covariance = np.linalg.pinv(own.T @ own) * variance * (1 + rho) / (1 - rho)
        return np.sqrt(np.diag(covariance))


class _Moments:
    """Sums of products of the table's columns, from which a fit at any lags costs next to nothing."""

    def __init__(self, table: Table, below: np.ndarray):
        self.table, self.below = table, below
        scale = np.abs(table.columns).max(axis=0)
        self._scale = np.where(scale > 0, scale, 1.0)
        columns, torque = table.columns[below] / self._scale, table.torque[below]
        self._gram, self._moment, self._square = columns.T @ columns, columns.T @ torque, float(torque @ torque)

    def error(self, terms: np.ndarray) -> float:
        """Sum of squares that a fit leaves [N² m²]."""
        scaled = terms * self._scale[:, None]
        moment = scaled.T @ self._moment
        return self._square - float(moment @ np.linalg.lstsq(scaled.T @ self._gram @ scaled, moment, rcond=None)[0])


def _terms(table: Table, command_lag: float, feedback: int, speed: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
    """Coefficients and their columns, where commands are so many control steps late: a mix of two whole ones."""
    at = (command_lag - table.command_lags[0]) / (table.command_lags[1] - table.command_lags[0])
    whole = int(np.clip(np.floor(at), 0, len(table.command_lags) - 2))
    weights = (1 - (at - whole), at - whole)
    found: dict[str, np.ndarray] = {}

    def term(name: str, commanded: str | None, fed_back: int | None) -> None:
        column = np.zeros(table.columns.shape[1])
        if commanded is not None:
            column[table.commands[commanded][whole : whole + 2]] = weights
        if fed_back is not None:
            column[fed_back] = -1.0
        found[name] = column

    has = table.commands.keys()
    if "position" in has:
        term("stiffness", "position", int(table.position[feedback]))
    term("damping", "velocity" if "velocity" in has else None, int(speed[feedback]))
    if "effort" in has:
        term("feed_forward", "effort", None)
    term("offset", None, None)
    found["offset"][-1] = 1.0
    return tuple(found), np.stack(list(found.values()), axis=1)


def _best_lags(table: Table, below: np.ndarray) -> _Fit:
    """The lags of commands and feedback at which the law leaves least: whole ones, then between them.

    Feedback is that of the torque's own sample unless another explains more than chance does (the information criterion
    of Bayes).
    """
    moments = _Moments(table, below)
    lags = table.command_lags[:-1]
    tried = [
        (moments.error(_terms(table, lag, f, speed)[1]), lag, f, s)
        for s, speed in enumerate(table.speeds)
        for f in range(len(table.feedback_lags))
        for lag in lags
    ]
    of_now = min(each for each in tried if table.feedback_lags[each[2]] == 0)
    best = min(tried)
    least = np.finfo(float).tiny  # of a sum of squares that may be zero
    evidence = below.sum() * (np.log(max(of_now[0], least)) - np.log(max(best[0], least)))
    _, lag, f, s = best if evidence > np.log(below.sum()) else of_now
    step = lags[1] - lags[0]
    finer = _minimum(lambda at: moments.error(_terms(table, at, f, table.speeds[s])[1]), lag - step, lag + step)
    names, terms = _terms(table, finer, f, table.speeds[s])
    return _Fit(
        table=table,
        below=below,
        names=names,
        terms=terms,
        command_lag=float(finer),
        feedback_lag=float(table.feedback_lags[f]),
    )


def _minimum(error, low: float, high: float) -> float:  # type: ignore[no-untyped-def]
    """Where a function of one number is least between two, by ternary search; it may have a kink there."""
    for _ in range(30):
        third = (high - low) / 3
        if error(low + third) <= error(high - third):
            high -= third
        else:
            low += third
    return (low + high) / 2


def _limit(table: Table, fit: _Fit) -> tuple[float | None, np.ndarray]:
    """Where the torque is cut, if it is, and which samples the law has below that: noise must not choose them."""
    size, every = np.abs(table.torque), np.ones(len(table.torque), dtype=bool)
    found = [(_error(table, fit.columns, every, np.inf), np.inf, every)]
    for level in np.unique(np.quantile(size, _LEVELS)):
        below = size < _START_BELOW * level
        if below.sum() >= len(size) // 10:
            found.append((_error(table, fit.columns, below, level), float(level), below))
    _, limit, below = min(found, key=lambda each: each[0])
    if not np.isfinite(limit):
        return None, every
    for _ in range(_ROUNDS):
        predicted = np.abs(fit.columns @ np.linalg.lstsq(fit.columns[below], table.torque[below], rcond=None)[0])
        spread = float(np.std(size[below] - predicted[below]))
        cut = predicted > limit + 3 * spread
        if cut.sum() < _LEAST_AT_THE_LIMIT:
            return None, every
        limit = float(np.median(size[cut]))
        below = predicted < _BELOW_THE_LIMIT * limit
    if np.median(np.abs(size[cut] - limit)) > _PLATEAU * limit + spread:
        return None, below
    return limit, below


def _error(table: Table, columns: np.ndarray, below: np.ndarray, limit: float) -> float:
    """Mean square that a law within a limit leaves on every sample [N² m²]."""
    coefficients = np.linalg.lstsq(columns[below], table.torque[below], rcond=None)[0]
    return float(np.mean((np.clip(columns @ coefficients, -limit, limit) - table.torque) ** 2))


def _law(joint: str, table: Table, fit: _Fit, limit: float | None) -> MeasuredLaw:
    value = dict(zip(fit.names, fit.coefficients.tolist(), strict=True))
    std = dict(zip(fit.names, fit.std().tolist(), strict=True))
    torque = table.torque[fit.below]
    left = torque - fit.predicted[fit.below]
    return MeasuredLaw(
        joint=joint,
        stiffness=value.get("stiffness", 0.0),
        damping=value.get("damping", 0.0),
        feed_forward=value.get("feed_forward"),
        offset=value["offset"],
        std=std,
        delay=fit.command_lag - fit.feedback_lag,
        feedback_lag=fit.feedback_lag,
        resolution=max(1.0, table.stride),
        limit=limit,
        peak=float(np.abs(table.torque).max()),
        r_squared=1.0 - float(left.var() / torque.var()) if torque.var() else 0.0,
        residual=float(left.std()),
        num_samples=int(fit.below.sum()),
    )
