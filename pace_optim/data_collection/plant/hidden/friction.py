"""Friction beyond Coulomb and viscous. On the motor's side where the transmission gives."""

from __future__ import annotations

import numpy as np

from pace_optim.data_collection.plant.state import Drives, State

from .effect import Draw, HiddenEffect, draws_of, hidden


@hidden
class StribeckFriction(HiddenEffect):
    """F(v) = F_c + F_s exp(-(v / v_s)²)."""

    name = "stribeck_friction"
    draws = draws_of(
        f_s=Draw(unit="N m", low=0.3, high=2.0, torque=True),
        v_s=Draw(unit="rad/s", low=0.03, high=0.5, log=True, role="shape", null=1.0),
    )

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Both levels are higher at creep."""
        more = self.f_s * np.exp(-((state.motor_vel / self.v_s) ** 2))
        return forward + more, backward + more


@hidden
class DynamicFriction(HiddenEffect):
    """The friction of the base model at rest, a share r of it while sliding."""

    name = "dynamic_friction"
    draws = draws_of(r=Draw(unit="1", low=0.3, high=0.8, null=1.0))

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Both levels fall once the joint creeps faster than 0.02 rad/s."""
        share = self.r + (1 - self.r) * np.exp(-((state.motor_vel / 0.02) ** 2))
        return forward * share, backward * share


@hidden
class LoadDependentFriction(HiddenEffect):
    """F = F_c + k_l |τ - τ_g|, τ the drive's torque, τ_g = -bias that of gravity and load on the joint.

    At rest under a load the two oppose each other, and the gears carry both.
    """

    name = "load_dependent_friction"
    draws = draws_of(k_l=Draw(unit="1", low=0.03, high=0.2))

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Both levels grow with the load."""
        more = self.k_l * np.abs(state.torque + state.bias)
        return forward + more, backward + more


@hidden
class FrictionAsymmetry(HiddenEffect):
    """F_c + a forward, F_c - a backward, neither below zero."""

    name = "friction_asymmetry"
    draws = draws_of(a=Draw(unit="N m", low=0.1, high=0.6, signed=True, torque=True))

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Levels apart by 2 a."""
        return np.maximum(forward + self.a, 0.0), np.maximum(backward - self.a, 0.0)


@hidden
class QuadraticFriction(HiddenEffect):
    """Torque - b₂ v |v|."""

    name = "quadratic_friction"
    draws = draws_of(b_2=Draw(unit="N m s^2/rad^2", low=0.15, high=1.2, torque=True))

    def motor_torque(self, state: State) -> np.ndarray:
        """The drag [N m]."""
        return -self.b_2 * state.motor_vel * np.abs(state.motor_vel)


@hidden
class PreslidingFriction(HiddenEffect):
    """Dahl's bristle in place of the sharp stick: z' = v - σ₀ |v| z / F, torque -σ₀ z.

    Exact over a step of constant v. Viscous friction stays as it is. Source: Dahl, "A solid friction model", 1968.
    """

    name = "presliding_friction"
    draws = draws_of(
        sigma_0=Draw(unit="N m/rad", low=8.0, high=150.0, log=True, role="inverse", torque=True, null=np.inf)
    )

    def prepare(self, drives: Drives) -> None:
        """Start with straight bristles."""
        self.z: np.ndarray | float = 0.0
        self.level = np.zeros_like(drives.friction)
        self.soft = np.isfinite(self.sigma_0)
        self.sigma = np.where(self.soft, self.sigma_0, 1.0)

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Take the level over from the sharp law."""
        self.level = np.where(state.motor_vel > 0, forward, backward)
        return np.where(self.soft, 0.0, forward), np.where(self.soft, 0.0, backward)

    def motor_torque(self, state: State) -> np.ndarray:
        """The bristles' torque, mean over the step [N m]."""
        way = state.motor_vel * state.h
        rate = self.sigma * np.abs(way) / np.maximum(self.level, 1e-9)
        decay = np.exp(-rate)
        share = np.where(rate > 1e-9, -np.expm1(-rate) / np.maximum(rate, 1e-12), 1.0)
        following = self.z * decay + way * share
        mean = 0.5 * (self.z + following)
        self.z = following
        return np.where(self.soft, -self.sigma * mean, 0.0)


@hidden
class CreepingFriction(HiddenEffect):
    """F tanh(v / v_s) in place of the set-valued law: no speed is low enough to stick."""

    name = "creeping_friction"
    draws = draws_of(v_s=Draw(unit="rad/s", low=0.01, high=0.15, log=True))

    def prepare(self, drives: Drives) -> None:
        """Where friction is smooth."""
        self.level = np.zeros_like(drives.friction)
        self.smooth = self.v_s > 0
        self.scale = np.where(self.smooth, self.v_s, 1.0)

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Take the level over from the sharp law."""
        self.level = np.where(state.motor_vel > 0, forward, backward)
        return np.where(self.smooth, 0.0, forward), np.where(self.smooth, 0.0, backward)

    def motor_torque(self, state: State) -> np.ndarray:
        """The smooth friction [N m]."""
        return np.where(self.smooth, -self.level * np.tanh(state.motor_vel / self.scale), 0.0)


@hidden
class FrictionDrift(HiddenEffect):
    """d and F_c times 1 + δ (1 - e^(-t/T)), t the time within the session."""

    name = "friction_drift"
    draws = draws_of(
        delta=Draw(unit="1", low=0.15, high=0.6, signed=True),
        time_constant=Draw(unit="s", low=10.0, high=60.0, role="shape", null=1.0),
    )

    def prepare(self, drives: Drives) -> None:
        """Keep the base viscous friction."""
        self.viscous = drives.viscous_friction

    def _change(self, state: State) -> np.ndarray:
        return -self.delta * np.expm1(-state.time / self.time_constant)

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Both levels drift."""
        factor = 1 + self._change(state)
        return forward * factor, backward * factor

    def motor_torque(self, state: State) -> np.ndarray:
        """What the drift adds to viscous friction [N m]."""
        return -self._change(state) * self.viscous * state.motor_vel


@hidden
class FrictionMap(HiddenEffect):
    """Coulomb friction with bumps over the position: + Σ_i h_i exp(-((q - q_i) / w)²), places drawn by `pattern`."""

    name = "friction_map"
    outside = True
    draws = draws_of(
        height=Draw(unit="N m", low=0.8, high=2.5, torque=True),
        width=Draw(unit="rad", low=0.04, high=0.15, role="shape", null=1.0),
        pattern=Draw(unit="seed", low=0, high=1e6, role="shape", integer=True),
    )

    def prepare(self, drives: Drives) -> None:
        """Draw eight bumps within ±1.3 rad."""
        rows, joints = drives.friction.shape
        self.places, self.sizes = np.zeros((rows, joints, 8)), np.zeros((rows, joints, 8))
        for r in range(rows):
            for j in range(joints):
                rng = np.random.default_rng([int(self.pattern[r, j]), j])
                self.places[r, j], self.sizes[r, j] = rng.uniform(-1.3, 1.3, 8), rng.uniform(0.3, 1.0, 8)

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Both levels have the bumps."""
        distance = (state.motor_pos[..., None] - self.places) / self.width[..., None]
        more = self.height * (self.sizes * np.exp(-(distance**2))).sum(axis=-1)
        return forward + more, backward + more


@hidden
class SealFriction(HiddenEffect):
    """Coulomb and viscous friction jump where a seal leaves its seat: q > place."""

    name = "seal_friction"
    outside = True
    draws = draws_of(
        coulomb=Draw(unit="N m", low=0.6, high=2.0, torque=True),
        viscous=Draw(unit="N m s/rad", low=0.3, high=1.5, torque=True),
        place=Draw(unit="rad", low=0.02, high=0.25, signed=True, role="shape"),
    )

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Both levels jump."""
        more = np.where(state.motor_pos > self.place, self.coulomb, 0.0)
        return forward + more, backward + more

    def motor_torque(self, state: State) -> np.ndarray:
        """The seal's viscous part [N m]."""
        return np.where(state.motor_pos > self.place, -self.viscous * state.motor_vel, 0.0)
