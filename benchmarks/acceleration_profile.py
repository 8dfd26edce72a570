"""Is an acceleration limit chaotic? Its exact profile, and commands that differ by a millionth of a radian.

    python benchmarks/acceleration_profile.py

A held command q* is approached in the shortest time with |a| <= a_max: full throttle up to the curve
e + v |v| / (2 a_max) = 0, e = x - q*, then full brake. Both parts are parabolas, so a control step is exact, without a
step size. The commands are a chirp of 10 s at 400 Hz, and the same with independent errors of 1 µrad on each.
"""

from __future__ import annotations

import math

import numpy as np

CONTROL_DT, STEPS, ERROR = 0.0025, 4000, 1e-6


def control_step(x: float, v: float, target: float, limit: float) -> tuple[float, float]:
    """Position [rad] and speed [rad/s] one control step later, in closed form."""
    error, left = x - target, CONTROL_DT
    side = error + v * abs(v) / (2 * limit)
    throttle = -math.copysign(limit, side)
    peak = math.copysign(math.sqrt(max(0.0, (v * v - 2 * throttle * error) / 2)), throttle)
    for acceleration, time in ((throttle, max(0.0, (peak - v) / throttle)), (-throttle, abs(peak) / limit)):
        passed = min(left, time)
        x, v, left = x + v * passed + 0.5 * acceleration * passed**2, v + acceleration * passed, left - passed
    return (x, v) if left <= 0 else (target, 0.0)


def profile(commands: np.ndarray, limit: float) -> np.ndarray:
    """The target inside the drive after each control step, (T,) [rad], from rest at the first command."""
    x, v, result = float(commands[0]), 0.0, np.empty(len(commands))
    for k, target in enumerate(commands):
        x, v = control_step(x, v, float(target), limit)
        result[k] = x
    return result


def main() -> None:
    """Print the table."""
    time = CONTROL_DT * np.arange(STEPS)
    turns = 0.1 * time + 0.5 * 9.9 * time**2 / time[-1]
    errors = ERROR * np.random.default_rng(0).standard_normal(STEPS)
    print("| amplitude, limit | after 2 s | 4 s | 6 s | 8 s | all 10 s, RMS |\n|---|---|---|---|---|---|")
    for amplitude, limit in ((0.1, 10.0), (0.1, 70.0), (0.4, 10.0), (0.4, 25.0)):
        commands = amplitude * np.sin(2 * np.pi * turns)
        apart = 1e3 * np.abs(profile(commands + errors, limit) - profile(commands, limit))
        parts = [f"{apart[k - 200 : k + 200].max():.2g}" for k in (800, 1600, 2400, 3200)]
        cells = [f"{amplitude} rad, {limit:g} rad/s²", *parts, f"{np.sqrt(np.mean(apart**2)):.3g} mrad"]
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
