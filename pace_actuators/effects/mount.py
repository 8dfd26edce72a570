"""What the robot is mounted on gives way.

The base turns by φ about a joint's axis, on a spring k and a damper c with the inertia J:

    (J + I) φ̈ + I q̈ + g(q) + K φ + k φ + c φ̇ = 0        link: - I φ̈ - K φ beside what it felt

with I the inertia of what the joint carries, g the torque of its weight, K = dg/dq. Both are solved together: with T =
J + I + h c/2 + h² (k + K)/4 (Newmark's average acceleration), φ̈ = (rest - I q̈)/T, so that the joint's inertia falls by
I²/T, which is taken from the rotor inertia that the simulator carries, and the rest is a torque. On a robot, each joint
feels the base turn about its own axis under its own reaction. Where joints follow each other, no more is taken than the
rotor inertia, so that the mass matrix stays positive: a mount lighter than I²/J_a - I counts as that heavy.

Source: two-inertia system; EFFECTS of PACE on MuJoCo.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter, off
from pace_actuators.effects.registry import register_effect


@register_effect
class MountCompliance(Effect):
    """The base stands on a spring and a damper: k, c and the mount's inertia, about each joint's axis."""

    name = "mount_compliance"
    stage = "transmission"
    shared = True
    is_stiff = True
    reads_link = True
    changes_armature = True
    reads_load = True
    two_sided = False
    memory: ClassVar[Mapping[str, float]] = {
        "_angle": 0.0,
        "_speed": 0.0,
        "_joint_speed": 0.0,
        "_rest": 0.0,
        "_link": 0.0,
        "_total": 1.0,
    }
    _angle: torch.Tensor
    _speed: torch.Tensor
    _joint_speed: torch.Tensor
    _rest: torch.Tensor
    _link: torch.Tensor
    _total: torch.Tensor
    parameters = (
        EffectParameter(
            name="stiffness",
            unit="N m/rad",
            lower=100.0,
            upper=2e4,
            null=float("inf"),
            start=2000.0,
            scale="log",
            meaning="k",
            follows_loop=True,
        ),
        EffectParameter(
            name="damping",
            unit="N m s/rad",
            lower=0.0,
            upper=30.0,
            null=None,
            start=3.0,
            meaning="c",
            follows_loop=True,
        ),
        EffectParameter(
            name="inertia",
            unit="kg m^2",
            lower=0.05,
            upper=10.0,
            null=None,
            start=0.8,
            scale="log",
            meaning="J",
            follows_loop=True,
        ),
    )
    equation = "J d²φ/dt² + c dφ/dt + k φ = - reaction of the joint; the link feels - I d²φ/dt² and gravity turned by φ"
    part = "stand, clamps, screws of the base"
    looks = "a resonance common to several joints"
    source = "two-inertia system"
    probes = tuple({"stiffness": k, "inertia": j} for k in (4000.0, 1000.0, 400.0) for j in (0.4, 1.5))
    separates = "higher frequencies, and the mount held by hand"

    def prepare(self) -> None:
        """Where it acts."""
        self._on = ~off(self.stiffness)
        self._k = torch.where(self._on, self.stiffness, 0.0)

    def advance(self, s: DriveState) -> None:
        """The base's step, now that the joint's speed after it is known; it begins at rest under its load."""
        moved = (self._rest * self.dt - self._link * (s.joint_vel - self._joint_speed)) / self._total
        self._angle = self._angle + self.dt * (self._speed + 0.5 * moved)
        self._speed = self._speed + moved
        new = self.take_new_rows()
        if new is not None:
            settled = s.load_effort / (self._k + s.load_stiffness).clamp(min=1.0)
            self._angle = torch.where(new, settled, self._angle)
            self._speed = torch.where(new, 0.0, self._speed)

    def transmission(self, s: DriveState) -> None:
        """What the link feels of the base."""
        h, link, weight = self.dt, s.link_inertia, s.load_stiffness
        total = link + self.inertia + 0.5 * h * self.damping + 0.25 * h**2 * (self._k + weight)
        spare = s.armature + s.spare_inertia
        total = torch.maximum(total, link**2 / spare.clamp(min=1e-9))
        ahead = self._angle + 0.5 * h * self._speed
        rest = s.load_effort - (self._k + weight) * ahead - self.damping * self._speed
        self._rest, self._link, self._total = rest, link.clone(), total
        self._joint_speed = s.joint_vel.clone()
        share = link / total
        s.effort += torch.where(self._on, -weight * self._angle - share * rest, 0.0)
        s.armature -= torch.where(self._on, share * link, 0.0)
