"""Effects between motor and link, and torques on the link."""

from __future__ import annotations

import numpy as np

from pace_optim.data_collection.plant.state import Compliance, Drives, State

from .effect import Draw, HiddenEffect, draws_of, hidden

_STIFF = 1e4  # of a joint that has a gap but no stated stiffness [N m/rad]


@hidden
class TorqueOffset(HiddenEffect):
    """+ τ₀."""

    name = "torque_offset"
    draws = draws_of(tau_0=Draw(unit="N m", low=0.3, high=2.5, signed=True, torque=True))

    def joint_torque(self, state: State) -> np.ndarray:
        """The offset [N m]."""
        return self.tau_0


@hidden
class ParallelSpring(HiddenEffect):
    """- k (q - q₀): cables, hoses, balancing springs."""

    name = "parallel_spring"
    draws = draws_of(
        k=Draw(unit="N m/rad", low=0.8, high=10.0, torque=True),
        q_0=Draw(unit="rad", low=0.05, high=0.5, signed=True, role="shape"),
    )

    def joint_torque(self, state: State) -> np.ndarray:
        """The spring's torque [N m]."""
        return -self.k * (state.joint_pos - self.q_0)


def _put_between(drives: Drives, stiffness: np.ndarray, damping: np.ndarray, gap: np.ndarray, link: np.ndarray) -> None:
    """Put a spring between motor and link; of two on one joint the softer spring and the wider gap count."""
    here = np.isfinite(stiffness)
    old = drives.compliance
    if old is None:
        drives.compliance = Compliance(
            joints=here.any(axis=0),
            stiffness=np.where(here, stiffness, _STIFF),
            damping=np.where(here, damping, 0.0),
            gap=np.where(here, gap, 0.0),
            encoder_on_link=here & (link > 0.5),
        )
        return
    both = np.where(here, stiffness, np.inf)
    softer = both < old.stiffness
    drives.compliance = Compliance(
        joints=old.joints | here.any(axis=0),
        stiffness=np.where(softer, both, old.stiffness),
        damping=np.where(softer, damping, old.damping),
        gap=np.maximum(old.gap, np.where(here, gap, 0.0)),
        encoder_on_link=old.encoder_on_link | (here & (link > 0.5)),
    )


@hidden
class JointElasticity(HiddenEffect):
    """Motor (armature, friction) and link joined by k e + c ė, e = θ - q."""

    name = "joint_elasticity"
    draws = draws_of(
        k=Draw(unit="N m/rad", low=120.0, high=1500.0, log=True, role="inverse", torque=True, null=np.inf),
        c=Draw(unit="N m s/rad", low=0.1, high=1.0, role="shape", torque=True),
        encoder_on_link=Draw(unit="1", low=0.0, high=0.8, role="shape", integer=True),
    )

    def prepare(self, drives: Drives) -> None:
        """Put the spring in."""
        _put_between(drives, self.k, self.c, np.zeros_like(self.k), self.encoder_on_link)


@hidden
class Backlash(HiddenEffect):
    """As joint elasticity, stiff, with a dead zone of ± gap / 2 in e; flanks push and never pull."""

    name = "backlash"
    draws = draws_of(
        gap=Draw(unit="rad", low=0.004, high=0.03),
        k=Draw(unit="N m/rad", low=3000.0, high=8000.0, role="shape", torque=True, null=np.inf),
        c=Draw(unit="N m s/rad", low=2.0, high=8.0, role="shape", torque=True),
        encoder_on_link=Draw(unit="1", low=0.0, high=0.8, role="shape", integer=True),
    )

    def prepare(self, drives: Drives) -> None:
        """Put the loose coupling in."""
        _put_between(drives, self.k, self.c, self.gap, self.encoder_on_link)


@hidden
class MountCompliance(HiddenEffect):
    """The base turns on a spring k and a damper c, with an inertia, about each axis of rotation."""

    name = "mount_compliance"
    draws = draws_of(
        k=Draw(unit="N m/rad", low=300.0, high=4000.0, log=True, role="inverse", torque=True, null=np.inf),
        c=Draw(unit="N m s/rad", low=1.0, high=10.0, role="shape", torque=True),
        inertia=Draw(unit="kg m^2", low=0.3, high=2.0, log=True, role="shape", torque=True),
    )

    def prepare(self, drives: Drives) -> None:
        """Loosen the mount; a recording has one, taken from its softest joint's value."""
        if not np.isfinite(self.k).any():
            return
        softest = np.argmin(self.k, axis=1)[:, None]
        drives.model.mount_stiffness = np.take_along_axis(self.k, softest, axis=1)
        drives.model.mount_damping = np.take_along_axis(self.c, softest, axis=1)
        drives.model.mount_inertia = np.take_along_axis(self.inertia, softest, axis=1)


@hidden
class Payload(HiddenEffect):
    """Link mass and inertia times 1 + m, centre of mass kept; a recording's added mass is not scaled."""

    name = "payload"
    draws = draws_of(m=Draw(unit="1", low=0.08, high=0.4, signed=True))

    def prepare(self, drives: Drives) -> None:
        """Change the masses."""
        drives.model.mass_factor = drives.model.mass_factor * (1 + self.m)


@hidden
class ComOffset(HiddenEffect):
    """The link's masses are turned about the joint's axis."""

    name = "com_offset"
    draws = draws_of(angle=Draw(unit="rad", low=0.05, high=0.3, signed=True))

    def prepare(self, drives: Drives) -> None:
        """Turn the masses."""
        drives.model.com_angle = drives.model.com_angle + self.angle


@hidden
class ExternalDisturbance(HiddenEffect):
    """A periodic torque in time that no one commanded (a fan, a swinging cable): a sin(2π f t + φ), φ new each time."""

    name = "external_disturbance"
    outside = True
    draws = draws_of(
        a=Draw(unit="N m", low=0.3, high=1.5, torque=True),
        frequency=Draw(unit="Hz", low=0.4, high=6.0, log=True, role="shape"),
    )

    def prepare(self, drives: Drives) -> None:
        """Draw each recording's phase."""
        self.phase = drives.rng.uniform(0.0, 2 * np.pi, (len(self.a), 1))

    def joint_torque(self, state: State) -> np.ndarray:
        """The disturbance [N m]."""
        return self.a * np.sin(2 * np.pi * self.frequency * state.clock + self.phase)


@hidden
class HystereticCable(HiddenEffect):
    """A cable that bends: Bouc-Wen, torque -k x z, z' = v/x (1 - |z| (0.5 + 0.5 sg(v z))) (rate-independent).

    k is the stiffness after a turn, x the angle over which it turns round; k x is the largest torque.
    Source: Wen, "Method for random vibration of hysteretic systems", 1976.
    """

    name = "hysteretic_cable"
    outside = True
    draws = draws_of(
        k=Draw(unit="N m/rad", low=3.0, high=12.0, torque=True),
        x=Draw(unit="rad", low=0.15, high=0.5, role="shape", null=1.0),
    )

    def prepare(self, drives: Drives) -> None:
        """Start relaxed."""
        self.z: np.ndarray | float = 0.0

    def joint_torque(self, state: State) -> np.ndarray:
        """The cable's torque [N m]."""
        v = state.joint_vel
        slip = np.abs(self.z) * (0.5 + 0.5 * np.sign(v * self.z))
        self.z = np.clip(self.z + state.h * v / self.x * (1 - slip), -1.0, 1.0)
        return -self.k * self.x * self.z
