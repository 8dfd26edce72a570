"""PACE's reference motion."""

import numpy as np

from .registry import register_excitation
from .trajectory import Motion, Trajectory


def chirp_signal(motion: Motion) -> np.ndarray:
    """A sine whose frequency rises linearly, (T,).

    s(t) = sin(2π (f₀ t + (f₁ - f₀) t² / (2 D)))
    """
    t, low, high = motion.time, motion.min_frequency, motion.max_frequency
    return np.sin(2 * np.pi * (low * t + (high - low) / (2 * motion.duration) * t**2))


@register_excitation("chirp", "one sine for all joints, its frequency rising linearly (PACE's reference)")
def chirp(motion: Motion) -> list[Trajectory]:
    """Target = (s + bias) · direction · scale."""
    return [motion.trajectory("chirp", chirp_signal(motion))]
