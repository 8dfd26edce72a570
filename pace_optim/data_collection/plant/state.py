"""The plant's constants and state, one row per recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .rigid_body import ModelChange


@dataclass(kw_only=True, eq=False)
class Compliance:
    """A spring between motor and link, with a dead zone."""

    joints: np.ndarray
    """Which joints have one, (n,) bool."""
    stiffness: np.ndarray
    """k, (R, n) [N m/rad]."""
    damping: np.ndarray
    """c, (R, n) [N m s/rad]."""
    gap: np.ndarray
    """Whole width of the dead zone, (R, n) [rad]."""
    encoder_on_link: np.ndarray
    """Whether the encoder sees the link, (R, n) bool."""

    def torque(self, twist: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Torque on the link [N m].

        k e + c ė with e the twist beyond the dead zone; across a gap, flanks push and never pull.
        """
        beyond = twist - np.clip(twist, -0.5 * self.gap, 0.5 * self.gap)
        torque = self.stiffness * beyond + self.damping * rate
        pushing = np.where(beyond > 0, np.maximum(torque, 0.0), np.where(beyond < 0, np.minimum(torque, 0.0), 0.0))
        return np.where(self.gap > 0, pushing, torque)


@dataclass(kw_only=True, eq=False)
class Drives:
    """Constants of all joints and recordings; effects change them in `prepare`."""

    stiffness: np.ndarray
    """kp, (R, n) [N m/rad]."""
    damping: np.ndarray
    """kd, (R, n) [N m s/rad]."""
    saturation_effort: np.ndarray
    """Stall torque, (R, n) [N m]."""
    effort_limit: np.ndarray
    """Largest torque, (R, n) [N m]."""
    velocity_limit: np.ndarray
    """No-load speed, (R, n) [rad/s]."""
    armature: np.ndarray
    """(R, n) [kg m^2]."""
    viscous_friction: np.ndarray
    """(R, n) [N m s/rad]."""
    friction: np.ndarray
    """Coulomb friction, (R, n) [N m]."""
    encoder_bias: np.ndarray
    """(R, n) [rad]."""
    delay_mode: str
    """What the base delay delays."""
    command_delay: np.ndarray
    """Of the targets, (R, n) [s]."""
    effort_delay: np.ndarray
    """Of the controller's torque, (R, n) [s]."""
    log_delay: np.ndarray
    """Of the log alone, (R, n) [s]."""
    log_skew: np.ndarray
    """The log's instants are (1 + skew) t, (R, n)."""
    session_start: np.ndarray
    """When each recording starts, (R, 1) [s]."""
    rng: np.random.Generator
    """For what differs at random from recording to recording."""
    model: ModelChange
    """How the links differ from the model."""
    compliance: Compliance | None = None
    """Between motor and link; None for a rigid transmission."""


@dataclass(kw_only=True, eq=False)
class State:
    """What changes from step to step; `_mid` is at the middle of the step."""

    h: float
    """Length of the step [s]."""
    time: np.ndarray
    """Time within the session, (R, 1) [s]."""
    clock: float
    """Time within the recording [s]."""
    joint_pos: np.ndarray
    """Link positions at mid-step, (R, n) [rad]."""
    joint_vel: np.ndarray
    """Link speeds at mid-step, (R, n) [rad/s]."""
    motor_pos: np.ndarray
    """Motor positions at mid-step; the link's where the transmission is rigid."""
    motor_vel: np.ndarray
    """Motor speeds at mid-step."""
    torque: np.ndarray
    """The motor's torque in force, (R, n) [N m]."""
    bias: np.ndarray
    """Torque that holds the joint against gravity and its load's motion, (R, n) [N m]."""
