"""Torques between the motor and the link."""

from __future__ import annotations

import math

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import register_effect


@register_effect
class TorqueOffset(Effect):
    """A constant torque on the joint: + τ₀."""

    name = "torque_offset"
    stage = "transmission"
    parameters = (EffectParameter(name="effort", unit="N m", lower=-4.0, upper=4.0, null=0.0, start=0.1),)
    equation = "τ + τ_0"
    part = "zero of the current sensor; a cable or spring that pulls"
    looks = "a constant lean"
    source = "offset of a current sensor, a pulling cable"
    probes = ({"effort": 0.1},)
    twins = ("friction_asymmetry",)
    separates = "another pose of the robot, and an absolute reference of the position"

    def transmission(self, s: DriveState) -> None:
        """Add it."""
        s.effort += self.effort


@register_effect
class ParallelSpring(Effect):
    """A spring beside the drive, such as a cable or a hose: - k (q - q₀).

    One that pushes away from its rest (k < 0) does so as at half a turn from there on: else it would throw a joint with
    a torque that grows without end.
    """

    name = "parallel_spring"
    stage = "transmission"
    parameters = (
        EffectParameter(
            name="stiffness",
            unit="N m/rad",
            lower=-2.0,
            upper=20.0,
            null=0.0,
            start=0.2,
            plausible=(0.0, math.inf),
        ),
        EffectParameter(
            name="rest", unit="rad", lower=-6.3, upper=6.3, null=None, start=0.0, meaning="q_0", is_position=True
        ),
    )
    equation = "τ - k (q - q_0)"
    part = "a spring, a cable or a hose on the joint"
    looks = "a lean proportional to the angle"
    source = "cables and hoses along a joint; balancing springs"
    probes = ({"rest": 0.0}, {"rest": 1.0}, {"rest": -1.0})
    separates = "a wide range of motion, and a known added mass"

    def transmission(self, s: DriveState) -> None:
        """Pull towards its rest position."""
        away = s.joint_pos - self.rest
        s.effort -= self.stiffness * torch.where(self.stiffness < 0, away.clamp(-math.pi, math.pi), away)
