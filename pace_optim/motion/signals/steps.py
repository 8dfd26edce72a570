"""Random steps."""

import numpy as np

from .registry import register_excitation
from .trajectory import Motion, Trajectory

_HOLD = (0.5, 1.0)  # [s]


def steps_signal(motion: Motion, amplitude: float = 1.0) -> np.ndarray:
    """Levels drawn evenly from ±amplitude, each held 0.5 to 1 s, (T, n); every joint steps at other times.

    The first level is 0, so that the motion starts where it stands.
    """
    columns = []
    for _ in range(motion.num_joints):
        count = int(np.ceil(motion.duration / _HOLD[0])) + 1
        starts = np.cumsum(motion.rng.uniform(*_HOLD, count))
        levels = motion.rng.uniform(-amplitude, amplitude, count)
        columns.append(np.concatenate([[0.0], levels])[np.searchsorted(starts, motion.time, side="right")])
    return np.stack(columns, axis=1)


@register_excitation("steps", "random steps, each held 0.5 to 1 s")
def steps(motion: Motion) -> list[Trajectory]:
    """Steps over the whole range of the robot's excitation."""
    return [motion.trajectory("steps", steps_signal(motion), has_jumps=True)]
