"""The time base of a recording against the simulation's control grid: keep the samples, place them, or resample them.

Samples are kept exactly if their time stamps are those of the grid. A clock or a file format may add jitter
below 1 % of a step, rounding of the stamps (decimals, float32), and drift below a tenth of a sample.

Samples of a slower timer, at another rate, are placed beside the grid's nearest steps. The simulation is
interpolated to their instants: between slow samples only the simulation knows the motion.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

_UNITS = {"s": 1.0, "ms": 1e3, "µs": 1e6, "ns": 1e9}
_YEARS = (9e8, 4.2e9)  # Unix time of mid-1998 and of 2103 [s]
_STEPS = (1e-6, 100.0)  # of stamps that follow each other [s]
_LEAST_REPEATED = 0.2  # of the rows, where stamps are rounded to more than a step
_ROUNDED = 1.3  # times the resolution that stamps may be from even ones
_LASTING = 5  # rows that follow a clock that was set back, below what it had shown
_FEW = 0.02  # of the rows, where it goes back: more are rows in no order
_ZONE = re.compile(r"(?:Z|[+-]\d{2}:?\d{2})$", re.IGNORECASE)


def seconds_of(values: np.ndarray) -> tuple[np.ndarray, float, str]:
    """Return stamps as seconds, the clock's reading at zero, and what they were taken for.

    Args:
        values: Stamps, (T,): numbers, text (ISO 8601) or datetime64.

    Returns:
        Stamps, (T,) [s], from 0 where they are Unix time and as given elsewhere; Unix time at zero [s], or 0; the unit
        that was recognised, or "" where they were taken as they are.
    """
    if values.dtype.kind in "UST":
        values = _dates(values)
    if values.dtype.kind == "M":
        whole, missing = values.astype("datetime64[ns]").astype(np.int64), np.isnat(values)
        first = whole[~missing][:1]
        if not len(first):
            return np.full(len(values), np.nan), 0.0, "dates"
        return np.where(missing, np.nan, (whole - first) * 1e-9), float(first[0]) * 1e-9, "dates"
    unit = unix_unit(values)
    if unit is None:
        return values.astype(np.float64), 0.0, ""
    since = (values - values[:1]).astype(np.float64) / _UNITS[unit]
    return since, float(values[0]) / _UNITS[unit], f"Unix time in {unit}"


def unix_unit(values: np.ndarray) -> str | None:
    """The unit in which stamps are Unix time; None if they are not."""
    if values.ndim != 1 or len(values) < 2 or values.dtype.kind not in "iuf":
        return None
    at = float(np.median(values))
    step = float(np.median(np.diff(values.astype(np.float64))))
    for unit, per_second in _UNITS.items():
        if all(low <= x / per_second <= high for x, (low, high) in ((at, _YEARS), (step, _STEPS))):
            return unit
    return None


def unrounded(time: np.ndarray) -> tuple[np.ndarray, str]:
    """Stamps that were rounded to more than a step, evenly spaced again, and a note; others as they are.

    Rows of an even timer at t₀ + k Δ show the multiples of a resolution r > Δ, each several times. The line through
    them is the timer's, if no stamp is further than r from it.

    Args:
        time: Stamps in the order of the rows, (T,) [s].
    """
    step = np.diff(time)
    if len(time) < 3 or not np.isfinite(time).all() or np.any(step < 0) or np.mean(step == 0) < _LEAST_REPEATED:
        return time, ""
    distinct = step[step > 0]
    if not len(distinct):
        return time, ""
    resolution = float(np.median(distinct))
    row = np.arange(len(time))
    slope = float(np.polyfit(row, time - time[0], 1)[0])
    if slope <= 0 or np.ptp(time - time[0] - slope * row) > _ROUNDED * resolution:
        return time, ""
    note = (
        f"The time stamps are rounded to {1e3 * resolution:.3g} ms, and several rows share one: read as an even clock "
        f"of {1 / slope:.5g} Hz."
    )
    return time[0] + slope * row, note


def set_back(time: np.ndarray) -> np.ndarray:
    """Rows at which the clock was set back, (K,): those before and after show the same time twice.

    Single late rows, and rows in no order, do not count.

    Args:
        time: Stamps in the order of the rows, (T,) [s].
    """
    back = np.flatnonzero(np.diff(time) < 0) + 1
    if not len(back) or len(back) > max(3.0, _FEW * len(time)):
        return back[:0]
    shown = np.maximum.accumulate(time)
    return np.array([k for k in back if np.all(time[k : k + _LASTING] < shown[k - 1])], dtype=int)


def _dates(values: np.ndarray) -> np.ndarray:
    """Text as datetime64 in UTC; a zone that is written behind each is taken into account."""
    texts = [str(value).strip() for value in values.tolist()]
    filled = [text for text in texts if text]
    zones = {match.group() if (match := _ZONE.search(text)) and "T" in text.upper().replace(" ", "T") else ""
             for text in filled[:1] + filled[-1:]}  # fmt: skip
    zone = zones.pop() if zones else ""
    if zones or not all(text.endswith(zone) for text in filled):
        raise ValueError("the stamps are of different time zones; write all of them in one")
    bare = np.array([text[: len(text) - len(zone)].replace(" ", "T") for text in texts])
    return bare.astype("datetime64[ns]") - np.timedelta64(_minutes(zone), "m")


def _minutes(zone: str) -> int:
    """Minutes that a zone is ahead of UTC."""
    if zone.upper() in ("", "Z"):
        return 0
    digits = zone[1:].replace(":", "")
    return (1 if zone[0] == "+" else -1) * (60 * int(digits[:2]) + int(digits[2:]))


_UNEVEN = 4.0  # ratio of neighbouring steps above which the three-point slope would amplify noise


def interpolate_smooth(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate a smooth, noisy signal by cubics with continuous slope.

    Slopes come from the parabola through three neighbours, and from the outer two alone where one step is
    much shorter than the other, which bounds the amplification of noise. Straight lines, and cubics that
    flatten at extrema (PCHIP), leave an error at each turn of the motion. It looks like missing physics:
    1.5 mrad for 0.5 rad at 5 Hz sampled at 187 Hz, where these cubics leave 0.1 mrad.

    Args:
        time: Instants of the samples, (T,) [s].
        values: Samples, (T, n).
        at: Instants to interpolate at, (M,) [s], within `time`.
    """
    step = np.diff(time)[:, None]
    secant = np.diff(values, axis=0) / step
    before, after = step[:-1], step[1:]
    parabola = (after * secant[:-1] + before * secant[1:]) / (before + after)
    across = (before * secant[:-1] + after * secant[1:]) / (before + after)
    uneven = np.maximum(before, after) > _UNEVEN * np.minimum(before, after)
    slope = np.concatenate([secant[:1], np.where(uneven, across, parabola), secant[-1:]])

    left = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    width = step[left]
    s = ((at - time[left]) / (time[left + 1] - time[left]))[:, None]
    bend_left = slope[left] - secant[left]
    bend_right = slope[left + 1] - secant[left]
    line = values[left] + s * width * secant[left]
    return line + s * (1.0 - s) * width * ((1.0 - s) * bend_left - s * bend_right)


def interpolate_linear(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate a signal that may jump, (T, n), by straight lines."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def interpolate_nearest(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (T, …) of the samples that are nearest to some instants."""
    after = np.searchsorted(time, at).clip(1, len(time) - 1)
    return values[after - (at - time[after - 1] < time[after] - at)]


def held(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (T, …) in force at some instants; before the first, the first."""
    return values[np.clip(np.searchsorted(time, at, side="right") - 1, 0, None)]


def hold_on_grid(time: np.ndarray, values: np.ndarray, step: float, count: int) -> np.ndarray:
    """Return the zero-order hold of `values`, averaged over each of `count` steps of a grid that starts at 0.

    A step without a new value gets the held value. With a new value, the average keeps the instant of the
    change to a fraction of a step. The value at the step's start would delay commands by half a step on
    average, and a fit would add that to the drive's delay.

    Args:
        time: Instants at which values are issued, (T,) [s], from 0.
        values: Values, (T, n).
        step: Spacing of the grid [s].
    """
    edge = step * np.arange(count + 1)
    first = np.searchsorted(time, edge[:-1], side="right") - 1
    last = np.searchsorted(time, edge[1:], side="left") - 1
    area = np.zeros_like(values)
    area[1:] = np.cumsum(values[:-1] * np.diff(time)[:, None], axis=0)
    at = np.searchsorted(time, edge, side="right") - 1
    area_at_edge = area[at] + values[at] * (edge - time[at])[:, None]
    average = np.diff(area_at_edge, axis=0) / step
    return np.where((last > first)[:, None], average, values[first])


_JITTER = 0.01  # of a step: moves a joint at 10 rad/s by 0.25 mrad at 400 Hz, below any encoder's noise
_DRIFT = 0.1  # of a sample, over the whole recording
_RATE = 1e-3  # relative error of the mean step
_EVEN = 0.05  # of a step: a timer that runs at another rate
_MAX_STEP = 0.05  # [s]
_LATE = 1.1  # a timer of that step may run late by so much
_MAX_GAP = 0.5  # [s]


@dataclass(frozen=True, kw_only=True)
class TimeBase:
    """What a recording's time stamps are, and how they go onto the control grid."""

    sample_stride: int
    """Control steps per sample on the grid."""
    num_samples: int
    """Samples on the grid."""
    exact: bool
    """Whether the samples already lie on the grid."""
    sample_at: np.ndarray | None = None
    """The step of the grid that is nearest to each sample, (T,), where samples are placed; else ``None``."""
    notes: tuple[str, ...]
    """Rate, jitter, gaps, and what follows from them."""

    @property
    def num_steps(self) -> int:
        """Control steps up to and including the last sample."""
        return int(self.sample_steps[-1]) + 1

    @property
    def sample_steps(self) -> np.ndarray:
        """The step of the grid of each sample, (T,)."""
        return np.arange(self.num_samples) * self.sample_stride if self.sample_at is None else self.sample_at


def fit_time_base(time: np.ndarray, control_dt: float, source: str, may_place: bool = False) -> TimeBase:
    """Compare time stamps with the control grid.

    Args:
        time: Time stamps, (T,) [s], strictly increasing.
        control_dt: Control step of the simulation [s].
        source: Name of the recording, for messages.
        may_place: Whether even samples that do not lie on the grid may be placed beside it, where they are slower.
    """
    resolution = _resolution(time)
    time = time - time[0]
    step = np.diff(time)
    median = float(np.median(step))
    _check_usable(time, step, median, source)

    stride = max(1, round(median / control_dt))
    spacing = stride * control_dt
    mean = float(time[-1]) / (len(time) - 1)
    exact, off_by_one = _on_grid(time, step, mean, spacing, resolution)
    notes = [_rate_note(step, mean), *_gap_notes(time, step, median)]
    if off_by_one:
        notes.append(
            f"The time stamps span one step too many, as of linspace(0, T*dt, T): {mean * 1e3:.6g} ms a step "
            f"was read as {spacing * 1e3:g} ms."
        )
    nearest = np.round(time / control_dt).astype(int)
    if may_place and not exact and stride > 1 and np.abs(step - mean).max() <= _EVEN * mean:
        notes.append(
            "Samples keep their instants: the simulation is interpolated to them. Commands are held and averaged over "
            f"each control step of {control_dt * 1e3:g} ms."
        )
        return TimeBase(sample_stride=stride, num_samples=len(time), exact=False, sample_at=nearest, notes=tuple(notes))
    if not exact:
        notes.append(
            f"Resampled to {spacing * 1e3:g} ms ({1 / spacing:g} Hz): positions and speeds by cubics, "
            "each torque that is measured next, commands held and averaged over each control step of "
            f"{control_dt * 1e3:g} ms."
        )
    if not exact and median < 0.95 * control_dt:
        notes.append(
            f"The recording ({1 / median:.4g} Hz) is finer than the control step ({1 / control_dt:.4g} Hz), "
            "so information is lost. Use a smaller control step: --control_dt with a model file, else sim.dt."
        )
    num_samples = len(time) if exact else int(np.floor(time[-1] / spacing + 1e-6)) + 1
    return TimeBase(sample_stride=stride, num_samples=num_samples, exact=exact, notes=tuple(notes))


def _check_usable(time: np.ndarray, step: np.ndarray, median: float, source: str) -> None:
    if median > _LATE * _MAX_STEP:
        raise ValueError(
            f"{source}: found one sample every {median:.3g} s ({1 / median:.3g} Hz); expected at least "
            f"{1 / _MAX_STEP:g} Hz, below which joint dynamics do not show. Record faster, or check that "
            "time is in seconds."
        )
    if step.max() > _MAX_GAP:
        gap = int(np.argmax(step))
        raise ValueError(
            f"{source}: found a gap of {step[gap]:.3g} s after sample {gap} ({time[gap]:.3f} s from the "
            f"start); expected none above {_MAX_GAP:g} s. Cut the file there into two recordings."
        )


def _on_grid(time: np.ndarray, step: np.ndarray, mean: float, spacing: float, resolution: float) -> tuple[bool, bool]:
    """Return whether the stamps are those of the grid, and whether only after a fencepost error is mended."""
    count = len(time)
    deviation = time - spacing * np.arange(count)
    from_rounding = resolution <= spacing / 2 and np.ptp(deviation) <= resolution * 1.001
    jitter = np.abs(step - mean).max()
    even = jitter <= max(_JITTER * spacing, min(resolution, _DRIFT * spacing))
    true_rate = abs(mean / spacing - 1.0) <= _RATE and np.abs(deviation).max() <= _DRIFT * spacing
    off_by_one = bool(even and abs(time[-1] - count * spacing) <= _JITTER * spacing)
    return bool(from_rounding or (even and true_rate) or off_by_one), off_by_one


def _resolution(time: np.ndarray) -> float:
    """Smallest difference that the stamps can express: decimals written, or float32 [s]."""
    for digits in range(2, 7):
        scaled = (time - time[0]) * 10.0**digits
        if np.abs(scaled - np.round(scaled)).max() < 1e-3:
            return 10.0**-digits
    if np.all(time == time.astype(np.float32)):
        return float(np.spacing(np.float32(np.abs(time).max())))
    return 0.0


def _rate_note(step: np.ndarray, mean: float) -> str:
    rate = f"{len(step) + 1} samples at {1 / mean:.4g} Hz over {mean * len(step):.4g} s; steps of {mean * 1e3:.4g} ms"
    if float(np.ptp(step)) < 1e-6 * mean:
        return f"{rate}, even."
    return f"{rate}, std {step.std() * 1e3:.2g} ms, longest {step.max() * 1e3:.4g} ms."


def _gap_notes(time: np.ndarray, step: np.ndarray, median: float) -> list[str]:
    gaps = np.flatnonzero(step > 3.0 * median)
    if not len(gaps):
        return []
    worst = gaps[np.argmax(step[gaps])]
    return [
        f"{len(gaps)} gap(s) longer than three steps, the longest of {step[worst] * 1e3:.4g} ms "
        f"{time[worst]:.3f} s from the start; positions there are interpolated."
    ]
