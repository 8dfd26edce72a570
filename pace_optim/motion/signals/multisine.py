"""Many sines at once, on a grid of frequencies that lets the response show what is not linear."""

import numpy as np

from .registry import register_excitation
from .trajectory import Motion, Trajectory

_PERIODS = 4
_DRAWS = 40
_FADE = 0.5  # [s]


@register_excitation(
    "multisine", "four periods of sines at odd harmonics, random phases, a third left out", duration=40.0
)
def multisine(motion: Motion) -> list[Trajectory]:
    """Equal amplitudes, each joint with separate phases, peak 1.

    The signal repeats four times (drop the first: it fades in over half a second, and the robot settles). Excited
    are odd multiples of 1/period in the band; of every three, a random one is left out. Then a response at left-out
    odd lines shows symmetric nonlinearity (friction, limits), at even lines one that depends on direction or position.
    """
    period = motion.duration / _PERIODS
    lines = excited_lines(motion, period)
    t = np.mod(motion.time, period)
    argument = 2 * np.pi * np.outer(t, lines) / period
    real, imaginary = np.cos(argument), np.sin(argument)
    columns = []
    for _ in range(motion.num_joints):
        phase = motion.rng.uniform(0.0, 2 * np.pi, (_DRAWS, len(lines)))
        candidates = real @ np.sin(phase).T + imaginary @ np.cos(phase).T  # sum of sin(argument + phase)
        candidates /= np.abs(candidates).max(axis=0)
        columns.append(candidates[:, np.argmax(np.square(candidates).sum(axis=0))])  # the fullest at peak 1
    fade = 0.5 - 0.5 * np.cos(np.pi * np.clip(motion.time / min(_FADE, period), 0.0, 1.0))
    return [motion.trajectory("multisine", np.stack(columns, axis=1) * fade[:, None])]


def excited_lines(motion: Motion, period: float) -> np.ndarray:
    """Excited harmonics of 1/period, odd integers."""
    last = int(np.floor(motion.max_frequency * period + 1e-9))
    odd = np.arange(1, last + 1, 2)
    odd = odd[odd >= motion.min_frequency * period - 1e-9]
    if len(odd) < 3:
        raise ValueError(
            f"A multisine of {motion.duration:g} s has {len(odd)} odd harmonics of 1/{period:g} s in the band "
            f"{motion.min_frequency:g} to {motion.max_frequency:g} Hz; expected at least 3. Make it longer, or "
            "widen the band."
        )
    groups = len(odd) // 3
    left_out = 3 * np.arange(groups) + motion.rng.integers(0, 3, groups)
    return np.delete(odd, left_out)
