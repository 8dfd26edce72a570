"""A slow triangle: friction at creep, and gravity without inertia."""

import numpy as np

from pace_actuators.joint_units import SLIDE_LENGTH

from .registry import register_excitation
from .trajectory import Motion, Trajectory

_SPEED = 0.15  # [rad/s], of slides a tenth of it [m/s]


def triangle_signal(motion: Motion) -> np.ndarray:
    """A triangle of 0.15 rad/s at every joint (slides: 15 mm/s), (T, n), within ±1.

    Where the whole range would take longer than the duration allows, it is narrower: every joint goes up and down at
    least once.
    """
    amplitude = np.abs(motion.scale)
    speed = _SPEED * np.where(np.isin(motion.cfg.joint_order, motion.cfg.slide_joints), SLIDE_LENGTH, 1.0)
    reachable = np.minimum(amplitude, speed * motion.duration / 4)
    height = np.divide(reachable, amplitude, out=np.zeros_like(amplitude), where=amplitude > 0)
    period = 4 * np.maximum(reachable, 1e-9) / speed
    cycles = motion.time[:, None] / period
    triangle = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * cycles))
    return height * triangle


@register_excitation("ramp", "slow triangle, 0.15 rad/s")
def ramp(motion: Motion) -> list[Trajectory]:
    """The triangle alone."""
    return [motion.trajectory("ramp", triangle_signal(motion))]
