"""Effects in the motor: what becomes of the torque asked for."""

from __future__ import annotations

import numpy as np

from pace_optim.data_collection.plant.state import Drives, State

from .effect import Draw, HiddenEffect, draws_of, hidden


@hidden
class DriveBandwidth(HiddenEffect):
    """T τ' + τ = τ_cmd, exact over each step."""

    name = "drive_bandwidth"
    draws = draws_of(time_constant=Draw(unit="s", low=0.002, high=0.015))

    def prepare(self, drives: Drives) -> None:
        """Start at the first torque."""
        self.now: np.ndarray | None = None

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The torque's mean over the step [N m]."""
        if self.now is None:
            self.now = torque
        share = -np.expm1(-state.h / np.maximum(self.time_constant, 1e-9))
        following = self.now + share * (torque - self.now)
        mean = np.where(self.time_constant > 0, 0.5 * (self.now + following), torque)
        self.now = following
        return mean


@hidden
class TorqueGain(HiddenEffect):
    """τ -> g τ."""

    name = "torque_gain"
    draws = draws_of(gain=Draw(unit="1", low=0.06, high=0.3, signed=True, factor=True, null=1.0))
    drive_rank = 1

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The torque given [N m]."""
        return self.gain * torque


@hidden
class TorqueRipple(HiddenEffect):
    """+ a sin(N q) + b cos(N q)."""

    name = "torque_ripple"
    draws = draws_of(
        a=Draw(unit="N m", low=0.15, high=1.2, signed=True, torque=True),
        b=Draw(unit="N m", low=0.15, high=1.2, signed=True, torque=True),
        n=Draw(unit="1/rev", low=6, high=80, log=True, role="shape", integer=True),
    )
    drive_rank = 2

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The torque with its ripple [N m]."""
        angle = self.n * state.motor_pos
        return torque + self.a * np.sin(angle) + self.b * np.cos(angle)


@hidden
class TorqueLimit(HiddenEffect):
    """|τ_cmd| <= τ_max: the request is cut, before current loop and torque constant."""

    name = "torque_limit"
    draws = draws_of(tau_max=Draw(unit="N m", low=18.0, high=45.0, log=True, role="inverse", torque=True, null=np.inf))
    drive_rank = -1

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The request cut [N m]."""
        return np.clip(torque, -self.tau_max, self.tau_max)


@hidden
class TorqueSpeedLimit(HiddenEffect):
    """|τ| <= τ_stall (1 - |v| / v_0) where the motor drives; braking is not limited."""

    name = "torque_speed_limit"
    draws = draws_of(
        v_0=Draw(unit="rad/s", low=3.0, high=7.0, role="inverse", null=np.inf),
        tau_stall=Draw(unit="N m", low=30.0, high=90.0, role="inverse", torque=True, null=np.inf),
    )
    drive_rank = 3

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The torque that the voltage leaves [N m]."""
        v = state.motor_vel
        with np.errstate(invalid="ignore"):
            most = np.nan_to_num(self.tau_stall * np.maximum(1 - np.abs(v) / self.v_0, 0.0), nan=np.inf)
        return np.clip(torque, np.where(v <= 0.0, -most, -np.inf), np.where(v >= 0.0, most, np.inf))


@hidden
class ThermalDerating(HiddenEffect):
    """The winding warms with its loss, T θ' + θ = (τ / τ_ref)², and the torque falls by 1 / (1 + a θ)."""

    name = "thermal_derating"
    outside = True
    draws = draws_of(
        a=Draw(unit="1", low=0.15, high=0.5),
        reference=Draw(unit="N m", low=8.0, high=14.0, torque=True, role="shape", null=1.0),
        time_constant=Draw(unit="s", low=3.0, high=12.0, role="shape", null=1.0),
    )
    drive_rank = 1

    def prepare(self, drives: Drives) -> None:
        """Start cold."""
        self.warmth: np.ndarray | float = 0.0

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The torque that is left [N m]."""
        self.warmth = self.warmth + state.h / self.time_constant * ((torque / self.reference) ** 2 - self.warmth)
        return torque / (1 + self.a * self.warmth)


@hidden
class TorqueDeadBand(HiddenEffect):
    """The power stage loses what it is asked for near zero: |τ| falls by τ_d, and to nothing below it."""

    name = "torque_dead_band"
    outside = True
    draws = draws_of(tau_d=Draw(unit="N m", low=0.3, high=1.5, torque=True))
    drive_rank = 1

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The torque beyond the band [N m]."""
        return torque - np.clip(torque, -self.tau_d, self.tau_d)
