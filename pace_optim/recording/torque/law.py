"""The law of a drive, read from the torque that its recording has: a regression, one joint at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pace_optim.recording import Recording
from pace_optim.recording.time_base import held, interpolate_smooth

_FEEDBACK_LAGS = np.arange(-1.0, 4.0)
"""Samples by which a log's torque may come later than the position or speed that it was made of."""
_BETWEEN = np.arange(-1.0, 3.5, 0.5)
"""The same where a log's samples are not those of the drive: their noise separates whole samples from others."""
_MOST_SAMPLES = 10_000
"""More say nothing new of six numbers."""
_LEAST_SAMPLES = 100
_MEMORY = 0.25
"""Time over which residuals may go on [s]."""
_IDLE = 1e-6
"""A joint whose position and commands change by less says nothing [rad, rad/s, N m]."""
_TOLERANCE = 1e-3
"""Part of a command's period by which stamps of one instant may differ."""
_SMOOTH = np.array([-2, -1, 0, 1, 2]) / 10
"""Speed in samples from five positions: the slope of a parabola through them."""
_SHARP = np.array([1, -8, 0, 8, -1]) / 12
"""The same of a quartic: less smooth, more exact where the motion is fast for the rate of the log."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Torque and candidates for its causes, at the samples that can be used."""

    torque: np.ndarray
    """(K,) [N m]."""
    columns: np.ndarray
    """(K, m)."""
    follows: np.ndarray
    """Whether a sample comes right after the one before, (K - 1,) bool."""
    stride: float
    """Control steps in a sample."""
    sampled: bool
    """Whether the samples are those of the drive."""
    phase: float | None
    """When the drive is taken to run [control steps]; ``None``: whenever there is a sample."""
    memory: int
    """Samples over which residuals may go on."""
    commands: dict[str, np.ndarray]
    """Columns of each commanded series ("position", "velocity", "effort") at each of ``command_lags``."""
    command_lags: np.ndarray
    """Evenly rising [control steps]."""
    position: np.ndarray
    """Columns of the position at each of ``feedback_lags``."""
    speeds: list[np.ndarray]
    """The same of the speed; more than one where it is taken from positions, in more than one way."""
    feedback_lags: np.ndarray
    """Evenly rising [control steps]."""

    @classmethod
    def of(
        cls,
        recording: Recording,
        j: int,
        longest_delay: float,
        phase: float | None = None,
        most: int = _MOST_SAMPLES,
        shift: float = 0.0,
    ) -> Table | None:
        """The table of a joint; ``None`` where its torque is not known, or too little of it.

        It is made of the samples as they were logged, which belong to the torques that came with them.

        Args:
            longest_delay: Longest delay of commands [control steps].
            phase: When the drive runs, once a control step, of a log that does not sample it [control steps].
            shift: By how much later its position and speed are taken [control steps].
        """
        log = recording if recording.logged is None else recording.logged
        if log.dof_effort is None:
            return None
        control_dt = float(recording.time[1] - recording.time[0]) / recording.sample_stride
        stride = float(np.median(np.diff(log.time))) / control_dt
        sampled = log is recording
        feedback = np.arange(3.0) if phase is not None else stride * (_FEEDBACK_LAGS if sampled else _BETWEEN)
        steps = np.ceil(longest_delay) + feedback[-1]
        lags = np.arange(-np.ceil(stride), steps + 1, 1.0 if sampled or phase is not None else 0.5)
        time, torque, position = log.time, log.dof_effort[:, j], log.dof_pos[:, j]
        given, speeds = _commands(recording, j), _speeds(log, j)
        before = int(np.ceil(steps / stride)) + 2
        usable = np.isfinite(torque) & np.all([np.isfinite(speed) for speed in speeds], axis=0)
        usable[:before] = usable[-3:] = False
        if log.torque_enable is not None:
            off = np.convolve(~log.torque_enable.astype(bool), np.ones(before))[: len(torque)]
            usable &= off == 0
        rows = np.flatnonzero(usable)
        rows = rows[:: max(1, len(rows) // most)]
        at = time[rows]
        if phase is not None:
            at = control_dt * (np.floor(at / control_dt - phase + 1e-6) + phase)
        if not given or len(rows) < _LEAST_SAMPLES or np.ptp(torque[rows]) == 0:
            return None
        told = any(np.ptp(values) > _IDLE for _, values in given.values())
        if not told and np.ptp(position[rows]) <= _IDLE:  # an idle joint's torque is no law's
            return None
        columns: list[np.ndarray] = []

        def add(new: list[np.ndarray]) -> np.ndarray:
            columns.extend(new)
            return np.arange(len(columns) - len(new), len(columns))

        def seen(series: np.ndarray) -> list[np.ndarray]:
            there = np.isfinite(series)  # the slope has no ends
            return [
                interpolate_smooth(time[there], series[there, None], at - (lag - shift) * control_dt)[:, 0]
                for lag in feedback
            ]

        return cls(
            torque=torque[rows],
            commands={name: add([_held(*c, at - lag * control_dt) for lag in lags]) for name, c in given.items()},
            command_lags=lags,
            position=add(seen(position)),
            speeds=[add(seen(speed)) for speed in speeds],
            feedback_lags=feedback,
            columns=np.stack([*columns, np.ones(len(rows))], axis=1),
            follows=np.diff(rows) == rows[1] - rows[0],
            stride=stride,
            sampled=sampled,
            phase=phase,
            memory=round(_MEMORY / (float(np.median(np.diff(time))) * float(rows[1] - rows[0]))),
        )


def _held(stamps: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Commands as they are in force at some times."""
    return held(stamps, values, at + _TOLERANCE * float(np.ptp(stamps[:2])))


def _commands(recording: Recording, j: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What is commanded of a joint, by kind: stamps and values; those kinds that there are."""
    there = {
        "position": recording.has_position_command[j],
        "velocity": recording.has_velocity_command[j],
        "effort": recording.has_effort_command[j],
    }
    log = recording.logged
    if log is None:
        series = recording.command, recording.command_vel, recording.command_effort
        dt = float(recording.time[1] - recording.time[0]) / recording.sample_stride
        stamps = dt * np.arange(max(len(s) for s in series if s is not None))
    else:
        series = log.des_dof_pos, log.des_dof_vel, log.des_dof_effort
        stamps = log.time if log.des_time is None else log.des_time
    return {
        name: (stamps, values[:, j])
        for (name, has), values in zip(there.items(), series, strict=True)
        if has and values is not None
    }


def _speeds(recording: Recording, j: int) -> list[np.ndarray]:
    """The measured speed, or the speed from positions in two ways, (T,) each [rad/s]; NaN at the ends."""
    if recording.dof_vel is not None and np.isfinite(recording.dof_vel[:, j]).any():
        return [recording.dof_vel[:, j]]
    dt = float(np.median(np.diff(recording.time)))
    results = []
    for weights in (_SMOOTH, _SHARP):
        speed = np.full(recording.num_samples, np.nan)
        speed[2:-2] = np.correlate(recording.dof_pos[:, j], weights) / dt
        results.append(speed)
    return results


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
_FEW = 2000
"""Samples that show when a drive runs."""
_PHASES = 8
_FINEST_PHASE = 0.01
"""Instants in a control step that are tried at first, and how near to each other they are at last [steps]."""
_FELT = 1e-3
"""Part of a torque that a term must be to be one of the law."""
_NEAR = 9
"""Lags of commands that are tried with separate lags of position and speed."""
_HALVINGS = 20
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
    speed_lag: float
    """How old the speed in it is [control steps]."""
    resolution: float
    """Resolution of the delay [control steps]: commands count from one sample to the next."""
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
        longest_delay: Up to where the delay of commands is sought [control steps].
    """
    table = Table.of(recording, joint, longest_delay, _phase(recording, joint, longest_delay))
    if table is None:
        return None
    size = np.abs(table.torque)
    starts = [np.ones(len(size), dtype=bool), size < _START_BELOW * np.quantile(size, _HALF)]
    found = [_settled(table, below) for below in starts if below.sum() >= len(size) // 10]
    fit, limit = min(found, key=lambda each: _error(table, each[0].columns, each[0].below, each[1] or np.inf))
    sides = [] if table.phase is None else [-_FINEST_PHASE, _FINEST_PHASE]
    moved = [Table.of(recording, joint, longest_delay, table.phase, shift=shift) for shift in sides]
    ends = [replace(fit, table=other).coefficients for other in moved if other is not None]
    between = 0.5 * (ends[1] - ends[0]) if len(ends) == 2 else np.zeros(len(fit.names))
    return _law(recording.joint_names[joint], fit, limit, np.hypot(fit.std(), between))


def _phase(recording: Recording, joint: int, longest_delay: float) -> float | None:
    """When in a control step a drive runs whose samples the log does not have; ``None``: with each sample."""
    if recording.logged is None:
        return None
    tried: list[tuple[float, float | None]] = []
    spacing, phases = 1.0 / _PHASES, [None, *np.arange(_PHASES) / _PHASES]
    while spacing > _FINEST_PHASE and phases:
        tried += [(_least_left(Table.of(recording, joint, longest_delay, each, _FEW)), each) for each in phases]
        _, best = min(tried, key=lambda each: each[0])
        spacing /= 2
        phases = [] if best is None else [(best - spacing) % 1, (best + spacing) % 1]
    return min(tried, key=lambda each: each[0])[1]


def _least_left(table: Table | None) -> float:
    """What a law without lags of feedback leaves of the smaller half of the torques, which no limit cuts [N² m²]."""
    if table is None:
        return np.inf
    size = np.abs(table.torque)
    below = size <= np.quantile(size, _HALF)
    moments = _Moments(table, below)
    lags = _refined(moments, _least(moments, [(0.0, 0.0)], table.command_lags[:-1], (("command",),)))
    return moments.error(lags) / float(below.sum())


def _settled(table: Table, below: np.ndarray) -> tuple[_Fit, float | None]:
    """Lags and limit that agree with each other, from samples that may be below the limit."""
    limit = None
    for _ in range(_ROUNDS):
        limit, new = _limit(table, _best_lags(table, below, of_their_own=False))
        if np.array_equal(new, below):
            break
        below = new
    return _best_lags(table, below), limit


def has_offset(law: MeasuredLaw) -> bool:
    """Whether a drive gives a constant torque by itself."""
    return abs(law.offset) > max(SURE * law.std["offset"], APART * law.peak)


@dataclass(frozen=True, kw_only=True)
class _Lags:
    """How old what a torque was made of is in it [control steps]."""

    command: float
    position: float
    speed: float
    variant: int
    """Which of the table's speeds it is."""
    free: tuple[tuple[str, ...], ...]
    """Those that were found, and not taken to be zero; of equal ones, both."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """A linear fit at chosen lags."""

    table: Table
    below: np.ndarray
    """Samples that it was fitted to, (K,) bool."""
    lags: _Lags

    @cached_property
    def terms(self) -> dict[str, np.ndarray]:
        """Columns as combinations of the table's, (m,), by coefficient."""
        return _terms(self.table, self.lags)

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients."""
        return tuple(self.terms)

    @cached_property
    def columns(self) -> np.ndarray:
        """(K, p)."""
        return self.table.columns @ np.stack(list(self.terms.values()), axis=1)

    @cached_property
    def coefficients(self) -> np.ndarray:
        """(p,)."""
        return np.linalg.lstsq(self.columns[self.below], self.table.torque[self.below], rcond=None)[0]

    @property
    def predicted(self) -> np.ndarray:
        """Torque without a limit, (K,) [N m]."""
        return self.columns @ self.coefficients

    def std(self) -> np.ndarray:
        """Standard deviations of the coefficients, (p,), with what the lags leave open.

        (J^T J)^-1 J^T S J (J^T J)^-1 with J the columns and the slopes of the prediction over the free lags, and S the
        products of residuals that are up to a quarter of a second apart, by Bartlett's window (Newey and West 1987):
        residuals that go on from sample to sample count as few.
        """
        whole = np.concatenate([self.columns, self._lag_slopes()], axis=1)
        scale = np.linalg.norm(whole[self.below], axis=0)
        whole = whole / np.where(scale > 0, scale, 1.0)
        residual = np.where(self.below, self.table.torque - self.predicted, 0.0)
        scores = whole * residual[:, None]
        middle = scores.T @ scores
        reach = min(self.table.memory, len(scores) // 10)
        for apart in range(1, reach + 1):
            cross = scores[apart:].T @ scores[:-apart]
            middle += (1 - apart / (reach + 1)) * (cross + cross.T)
        inverse = np.linalg.pinv(whole[self.below].T @ whole[self.below], rcond=1e-10, hermitian=True)
        own = slice(len(self.names))
        variance = np.maximum(np.diag(inverse @ middle @ inverse)[own], 0.0) / np.where(scale > 0, scale, 1.0)[own] ** 2
        return np.sqrt(variance + self._between_lags())

    def _between_lags(self) -> np.ndarray:
        """Variances of the coefficients from lags that a log at another rate cannot separate, (p,).

        A lag of position or speed is known to half of what lies between two of the table's.
        """
        table, spread = self.table, np.zeros(len(self.names))
        if table.sampled or table.phase is not None:
            return spread
        half = 0.5 * float(table.feedback_lags[1] - table.feedback_lags[0])
        for name in ("position", "speed"):
            ends = [
                replace(self, lags=replace(self.lags, **{name: getattr(self.lags, name) + side * half})).coefficients
                for side in (-1.0, 1.0)
            ]
            spread += (0.5 * (ends[1] - ends[0])) ** 2
        return spread

    def _lag_slopes(self) -> np.ndarray:
        """Slopes of the prediction over each free lag, (K, number)."""
        step = 0.25 * float(self.table.command_lags[1] - self.table.command_lags[0])
        result = [np.zeros((len(self.table.torque), 0))]
        for names in self.lags.free:
            moved = [{name: getattr(self.lags, name) + side * step for name in names} for side in (-1.0, 1.0)]
            ends = [_terms(self.table, replace(self.lags, **each)) for each in moved]
            change = sum((ends[1][n] - ends[0][n]) * c for n, c in zip(self.names, self.coefficients, strict=True))
            result.append((self.table.columns @ change)[:, None] / (2 * step))
        return np.concatenate(result, axis=1)


class _Moments:
    """Sums of products of the table's columns, from which a fit at any lags costs next to nothing."""

    def __init__(self, table: Table, below: np.ndarray):
        self.table, self.below = table, below
        scale = np.abs(table.columns).max(axis=0)
        self._scale = np.where(scale > 1e-9, scale, 1.0)
        columns, torque = table.columns[below] / self._scale, table.torque[below]
        self._gram, self._moment, self._square = columns.T @ columns, columns.T @ torque, float(torque @ torque)

    def errors(self, lags: Sequence[_Lags]) -> np.ndarray:
        """Sums of squares that fits at some lags leave, (B,) [N² m²]."""
        terms = np.stack([np.stack(list(_terms(self.table, each).values()), axis=1) for each in lags])
        scaled = terms * self._scale[:, None]
        moment = np.einsum("bmp,m->bp", scaled, self._moment)
        gram = np.swapaxes(scaled, 1, 2) @ (self._gram @ scaled)
        size = np.sqrt(np.maximum(np.einsum("bpp->bp", gram), 1e-30))
        gram = gram / (size[:, :, None] * size[:, None, :]) + 1e-12 * np.eye(gram.shape[1])
        solved = np.linalg.solve(gram, (moment / size)[:, :, None])[:, :, 0]
        return np.maximum(self._square - (moment / size * solved).sum(axis=1), 0.0)

    def error(self, lags: _Lags) -> float:
        """Sum of squares that a fit at some lags leaves [N² m²]."""
        return float(self.errors([lags])[0])


def _terms(table: Table, lags: _Lags) -> dict[str, np.ndarray]:
    """Coefficients and their columns as combinations of the table's, (m,) each.

    A lag between two of the table's is a mix of both.
    """
    found: dict[str, np.ndarray] = {}
    size = table.columns.shape[1]

    def mix(column: np.ndarray, places: np.ndarray, at: float, sign: float, grid: np.ndarray) -> None:
        where = float(np.clip((at - grid[0]) / (grid[1] - grid[0]), 0, len(grid) - 1))
        whole = min(int(where), len(grid) - 2)
        column[places[whole]] += sign * (1 - (where - whole))
        column[places[whole + 1]] += sign * (where - whole)

    def term(name: str, commanded: str | None, fed_back: np.ndarray | None = None, lag: float = 0.0) -> None:
        column = np.zeros(size)
        if commanded is not None:
            mix(column, table.commands[commanded], lags.command, 1.0, table.command_lags)
        if fed_back is not None:
            mix(column, fed_back, lag, -1.0, table.feedback_lags)
        found[name] = column

    has = table.commands.keys()
    if "position" in has:
        term("stiffness", "position", table.position, lags.position)
    term("damping", "velocity" if "velocity" in has else None, table.speeds[lags.variant], lags.speed)
    if "effort" in has:
        term("feed_forward", "effort")
    found["offset"] = np.zeros(size)
    found["offset"][-1] = 1.0
    return found


def _best_lags(table: Table, below: np.ndarray, of_their_own: bool = True) -> _Fit:
    """The lags at which the law leaves least, and no more of them than explain more than chance does.

    Position and speed are those of the torque's own sample (both lags 0), or as old as each other, or each has its own
    lag. Another lag must lower Bayes' criterion, in which residuals that go on from sample to sample count as few.
    No command is newer than the position that it is compared with, and no speed, which is made of positions, is newer.

    Args:
        below: Samples that may be below a limit, (K,) bool.
        of_their_own: Whether position and speed may be of different age.
    """
    moments = _Moments(table, below)
    grid = table.feedback_lags
    best = _refined(moments, _least(moments, [(0.0, 0.0)], table.command_lags[:-1], (("command",),)))
    count = below.sum() / _alike(_Fit(table=table, below=below, lags=best))

    def criterion(lags: _Lags) -> float:
        error = max(moments.error(lags), float(np.finfo(float).tiny))
        return float(count * np.log(error) + len(lags.free) * np.log(count))

    same = _least(moments, [(a, a) for a in grid], table.command_lags[:-1], (("command",), ("position", "speed")))
    best = min(best, _refined(moments, same), key=criterion)
    if of_their_own:
        lags = table.command_lags[:-1]
        near = lags[np.argsort(np.abs(lags - best.command), kind="stable")[:_NEAR]]
        later = grid[grid >= 0.0]
        positions = later if "position" in table.commands else [0.0]
        own = _least(
            moments,
            [(a, b) for a in positions for b in later if b >= a],
            near,
            (("command",), ("position",), ("speed",)),
        )
        best = min(best, _refined(moments, own), key=criterion)
    return _Fit(table=table, below=below, lags=best)


def _least(
    moments: _Moments, feedback: Sequence[tuple[float, float]], commands: np.ndarray, free: tuple[tuple[str, ...], ...]
) -> _Lags:
    """The best of lags that the table has, whose commands are not newer than their positions."""
    tried = [
        _Lags(command=float(command), position=float(position), speed=float(speed), variant=variant, free=free)
        for variant in range(len(moments.table.speeds))
        for command in commands
        for position, speed in feedback
        if command >= position - 1e-9
    ] or [_Lags(command=0.0, position=0.0, speed=0.0, variant=0, free=free)]
    return tried[int(moments.errors(tried).argmin())]


def _refined(moments: _Moments, lags: _Lags) -> _Lags:
    """The lag of commands between those of the table, by ternary search: it may have a kink where it is best.

    Positions and speeds keep lags of the table: between its samples noise is less, which would draw them there.
    """
    step = float(moments.table.command_lags[1] - moments.table.command_lags[0])
    low, high = max(lags.command - step, lags.position), lags.command + step
    for _ in range(_HALVINGS):
        third = (high - low) / 3
        first, second = moments.errors([replace(lags, command=x) for x in (low + third, high - third)])
        low, high = (low, high - third) if first <= second else (low + third, high)
    return replace(lags, command=(low + high) / 2)


def _alike(fit: _Fit) -> float:
    """How many samples say as much as one of residuals that did not go on: (1 + ρ) / (1 - ρ), ρ between neighbours."""
    residual = np.where(fit.below, fit.table.torque - fit.predicted, 0.0)
    pairs = fit.table.follows & fit.below[1:] & fit.below[:-1]
    variance = float(residual[fit.below] @ residual[fit.below]) / max(1, int(fit.below.sum()))
    rho = float((residual[1:] * residual[:-1])[pairs].mean()) / variance if variance and pairs.any() else 0.0
    rho = min(max(rho, 0.0), 0.99)
    return (1 + rho) / (1 - rho)


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


def _law(joint: str, fit: _Fit, limit: float | None, stds: np.ndarray) -> MeasuredLaw:
    table = fit.table
    value = dict(zip(fit.names, fit.coefficients.tolist(), strict=True))
    std = dict(zip(fit.names, stds.tolist(), strict=True))
    torque = table.torque[fit.below]
    share = np.std(fit.columns[fit.below][:, fit.names.index("damping")]) * abs(value["damping"]) / np.std(torque)
    if table.commands.keys() == {"effort"} and not (value["damping"] > SURE * std["damping"] and share > _FELT):
        del value["damping"], std["damping"]  # a torque drive has no damping unless it shows
    left = torque - fit.predicted[fit.below]
    return MeasuredLaw(
        joint=joint,
        stiffness=value.get("stiffness", 0.0),
        damping=value.get("damping", 0.0),
        feed_forward=value.get("feed_forward"),
        offset=value["offset"],
        std=std,
        delay=fit.lags.command - fit.lags.position,
        feedback_lag=fit.lags.position,
        speed_lag=fit.lags.speed,
        resolution=max(1.0, table.stride),
        limit=limit,
        peak=float(np.abs(table.torque).max()),
        r_squared=1.0 - float(left.var() / torque.var()) if torque.var() else 0.0,
        residual=float(left.std()),
        num_samples=int(fit.below.sum()),
    )
