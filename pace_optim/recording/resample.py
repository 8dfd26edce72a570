"""Put series on another time grid: measured signals by interpolation, commands by their hold."""

from __future__ import annotations

import numpy as np

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
