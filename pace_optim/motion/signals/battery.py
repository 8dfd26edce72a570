"""Six short motions that together separate most physical effects."""

import numpy as np

from .chirp import chirp_signal
from .ramp import triangle_signal
from .registry import register_excitation
from .steps import steps_signal
from .trajectory import Motion, Trajectory

# The largest chirp takes the whole range of the robot's excitation; the others keep their proportion to its 0.8 rad.
_LARGEST = 0.8  # [rad]
_CHIRPS = {"chirp_small": 0.1, "chirp_medium": 0.4, "chirp_large": 0.8}  # [rad]
_STEPS = 0.6  # [rad]
_LEVELS = (0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0)
_MOVING = 0.4  # share of a level's time spent on the way to the next


@register_excitation(
    "battery", "chirps at three amplitudes, slow triangle, random steps, gravity staircase", duration=10.0
)
def battery(motion: Motion) -> list[Trajectory]:
    """Six trajectories, each of the duration asked for."""
    chirp = chirp_signal(motion)
    return [
        *(motion.trajectory(name, size / _LARGEST * chirp) for name, size in _CHIRPS.items()),
        motion.trajectory("triangle", triangle_signal(motion)),
        motion.trajectory("steps", steps_signal(motion, _STEPS / _LARGEST), has_jumps=True),
        motion.trajectory("staircase", staircase_signal(motion)),
    ]


def staircase_signal(motion: Motion) -> np.ndarray:
    """Levels up, down and back, each approached smoothly from both sides and held, (T,).

    At rest, the targets' distance from the positions is gravity plus friction over stiffness: the two directions of
    approach separate them.
    """
    place = motion.time / motion.duration * len(_LEVELS)
    level = np.minimum(place.astype(int), len(_LEVELS) - 1)
    following = np.append(np.arange(1, len(_LEVELS)), len(_LEVELS) - 1)
    progress = np.clip((place - level - (1 - _MOVING)) / _MOVING, 0.0, 1.0)
    smooth = 0.5 - 0.5 * np.cos(np.pi * progress)
    levels = np.asarray(_LEVELS)
    return levels[level] + smooth * (levels[following[level]] - levels[level])
