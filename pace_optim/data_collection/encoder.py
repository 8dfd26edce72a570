"""What an encoder makes of a position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoder:
    """Noise, then rounding to the encoder's steps.

    reading = round((q + e) / h) h,    e ~ N(0, noise²),  h = 2π / 2^bits
    """

    noise: float
    """Standard deviation [rad]."""
    bits: int | None
    """2^bits steps per turn; ``None`` does not round."""
    rng: np.random.Generator
    """Source of the noise."""

    @property
    def is_exact(self) -> bool:
        """Whether every reading is the position itself."""
        return self.noise == 0 and self.bits is None

    def read(self, position: np.ndarray) -> np.ndarray:
        """Readings of positions [rad], same shape."""
        if self.noise:
            position = position + self.rng.normal(0.0, self.noise, position.shape)
        if self.bits is not None:
            step = 2 * np.pi / 2**self.bits
            position = np.round(position / step) * step
        return position
