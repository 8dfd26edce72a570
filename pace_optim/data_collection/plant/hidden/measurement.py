"""Effects in the encoder and in the log."""

from __future__ import annotations

import numpy as np

from pace_optim.data_collection.plant.state import Drives

from .effect import Draw, HiddenEffect, draws_of, hidden


@hidden
class EncoderScale(HiddenEffect):
    """q_enc = (1 + e) q - bias."""

    name = "encoder_scale"
    draws = draws_of(e=Draw(unit="1", low=0.01, high=0.08, signed=True))

    def measure(self, position: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both are scaled."""
        return (1 + self.e) * position, (1 + self.e) * speed


@hidden
class EncoderEccentricity(HiddenEffect):
    """+ a sin q + b cos q."""

    name = "encoder_eccentricity"
    draws = draws_of(
        a=Draw(unit="rad", low=0.003, high=0.03, signed=True),
        b=Draw(unit="rad", low=0.003, high=0.03, signed=True),
    )

    def measure(self, position: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position and its rate."""
        sine, cosine = np.sin(position), np.cos(position)
        return position + self.a * sine + self.b * cosine, speed * (1 + self.a * cosine - self.b * sine)


@hidden
class MeasurementDelay(HiddenEffect):
    """The log is late by T, the loop is not."""

    name = "measurement_delay"
    draws = draws_of(delay=Draw(unit="s", low=0.002, high=0.012))

    def prepare(self, drives: Drives) -> None:
        """Delay the log."""
        drives.log_delay = drives.log_delay + self.delay


@hidden
class ClockSkew(HiddenEffect):
    """The log's clock is wrong: what it dates t was measured at (1 + s) t."""

    name = "clock_skew"
    draws = draws_of(s=Draw(unit="1", low=0.0005, high=0.004, signed=True))

    def prepare(self, drives: Drives) -> None:
        """Skew the log."""
        drives.log_skew = drives.log_skew + self.s
