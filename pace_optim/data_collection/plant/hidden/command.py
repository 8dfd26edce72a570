"""Effects on the way of a command, and in the controller."""

from __future__ import annotations

import numpy as np

from pace_optim.data_collection.plant.state import Drives

from .effect import Draw, HiddenEffect, draws_of, hidden


@hidden
class CommandRateLimit(HiddenEffect):
    """The drive follows targets no faster than |dq*/dt| <= v_max (servo firmware)."""

    name = "command_rate_limit"
    draws = draws_of(v_max=Draw(unit="rad/s", low=0.8, high=6.0, log=True, role="inverse", null=np.inf))

    def prepare(self, drives: Drives) -> None:
        """Start at the first target."""
        self.last: np.ndarray | None = None

    def command(self, target: np.ndarray, dt: float) -> np.ndarray:
        """Targets as the drive takes them [rad]."""
        if self.last is None:
            self.last = target
        reach = self.v_max * dt
        self.last = np.clip(target, self.last - reach, self.last + reach)
        return self.last


@hidden
class CommandAccelerationLimit(HiddenEffect):
    """The drive's own target speeds up and brakes with a at most, and comes to rest where it is asked to be."""

    name = "command_acceleration_limit"
    draws = draws_of(a=Draw(unit="rad/s^2", low=8.0, high=80.0, log=True, role="inverse", null=np.inf))

    def prepare(self, drives: Drives) -> None:
        """Start at the first target, at rest."""
        self.last: np.ndarray | None = None
        self.limited = np.isfinite(self.a)
        self.most = np.where(self.limited, self.a, 1.0)

    def command(self, target: np.ndarray, dt: float) -> np.ndarray:
        """Targets as the drive takes them [rad]: full throttle, or full brake once only the way to stop is left."""
        if self.last is None:
            self.last, self.pace = target.copy(), np.zeros_like(target)
        parts = 25
        h = dt / parts
        for _ in range(parts):
            left = target - self.last
            way = np.where(left >= 0, 1.0, -1.0)
            towards = self.pace * way
            brakes = (towards > 0) & (towards**2 / (2 * self.most) >= np.abs(left))
            faster = self.pace + np.where(brakes, -way, way) * self.most * h
            near = (np.abs(left) <= 0.5 * self.most * h * h + np.abs(self.pace) * h) & (
                np.abs(self.pace) <= 2 * self.most * h
            )
            self.pace = np.where(near, 0.0, faster)
            self.last = np.where(near, target, self.last + h * self.pace)
        return np.where(self.limited, self.last, target)


@hidden
class OtherDelay(HiddenEffect):
    """The path that the base delay does not delay is late by T: the torque if the base delays targets, or reverse."""

    name = "other_delay"
    draws = draws_of(delay=Draw(unit="s", low=0.002, high=0.008))

    def prepare(self, drives: Drives) -> None:
        """Add the delay to the other path."""
        if drives.delay_mode == "command":
            drives.effort_delay = drives.effort_delay + self.delay
        else:
            drives.command_delay = drives.command_delay + self.delay


@hidden
class ProportionalGain(HiddenEffect):
    """g kp."""

    name = "proportional_gain"
    draws = draws_of(gain=Draw(unit="1", low=0.08, high=0.35, signed=True, factor=True, null=1.0))

    def prepare(self, drives: Drives) -> None:
        """Change the gain."""
        drives.stiffness = drives.stiffness * self.gain


@hidden
class DerivativeGain(HiddenEffect):
    """g kd."""

    name = "derivative_gain"
    draws = draws_of(gain=Draw(unit="1", low=0.15, high=0.5, signed=True, factor=True, null=1.0))

    def prepare(self, drives: Drives) -> None:
        """Change the gain."""
        drives.damping = drives.damping * self.gain


@hidden
class VelocityFilter(HiddenEffect):
    """The controller's speed is low-passed: T u' + u = v, sampled at the control rate (exact for a held input)."""

    name = "velocity_filter"
    draws = draws_of(time_constant=Draw(unit="s", low=0.004, high=0.025))

    def prepare(self, drives: Drives) -> None:
        """Start at rest."""
        self.filtered: np.ndarray | float = 0.0

    def speed_feedback(self, speed: np.ndarray, dt: float) -> np.ndarray:
        """The filtered speed [rad/s]."""
        share = -np.expm1(-dt / np.maximum(self.time_constant, 1e-9))
        self.filtered = self.filtered + share * (speed - self.filtered)
        return np.asarray(self.filtered)


@hidden
class IntegralGain(HiddenEffect):
    """An undocumented integrator: torque += ki ∫ error dt, the integral's torque within ± limit."""

    name = "integral_gain"
    draws = draws_of(
        ki=Draw(unit="N m/(rad s)", low=40.0, high=200.0, torque=True),
        limit=Draw(unit="N m", low=3.0, high=10.0, torque=True, role="shape"),
    )

    def prepare(self, drives: Drives) -> None:
        """Start at nothing."""
        self.sum: np.ndarray | float = 0.0

    def controller(self, torque: np.ndarray, error: np.ndarray, dt: float) -> np.ndarray:
        """Torque with the integral's part [N m]."""
        self.sum = np.clip(self.sum + self.ki * error * dt, -self.limit, self.limit)
        return torque + self.sum
