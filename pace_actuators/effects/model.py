"""Effects on the rigid body that a joint moves.

They change no torque: they change the environment's model. Elsewhere, scale the mass and inertia of
the link, or turn its centre of mass about the joint's axis, in the robot's own model.
"""

from __future__ import annotations

from typing import Protocol

import torch

from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import register_effect


class LinkModel(Protocol):
    """What a simulator offers to effects on the link that a joint moves (with all that is fixed to the link)."""

    def scale_mass(self, factor: torch.Tensor) -> None:
        """Multiply its mass and inertia, centre of mass kept, by (rows,)."""

    def rotate_mass(self, angle: torch.Tensor) -> None:
        """Turn its mass about the joint's axis by (rows,) [rad], while its geometry stays."""


@register_effect
class Payload(Effect):
    """The link's mass and inertia are (1 + m) times what the model says, its centre of mass is where it was."""

    name = "payload"
    stage = "model"
    parameters = (
        EffectParameter(name="ratio", unit="1", lower=-0.6, upper=1.0, null=0.0, start=0.02, possible=(-1.0, 9.0)),
    )
    equation = "mass and inertia of the link times (1 + m)"
    part = "the link's mass, tools, cables"
    looks = "sag and inertia off together"
    source = "cables, covers and tools that the model does not have"
    probes = ({"ratio": 0.02},)
    twins = ("torque_gain",)
    scales = "mass of the link"
    separates = "a recording with a known added mass"

    def write_model(self, model: LinkModel, joint: int) -> None:
        """Write body_mass and body_inertia."""
        model.scale_mass(1 + self.ratio[:, joint])


@register_effect
class ComOffset(Effect):
    """The link's centre of mass is turned about the joint's axis by an angle."""

    name = "com_offset"
    stage = "model"
    joint_types = ("hinge",)
    parameters = (EffectParameter(name="angle", unit="rad", lower=-0.3, upper=0.3, null=0.0, start=0.01),)
    equation = "centre of mass turned about the joint's axis by α"
    part = "the link's centre of mass, the joint's zero"
    looks = "a lean that depends on the pose"
    source = "as payload"
    probes = ({"angle": 0.01},)
    absorbed_by = "encoder_bias"
    separates = "an absolute reference of the position"

    def write_model(self, model: LinkModel, joint: int) -> None:
        """Write body_ipos and body_iquat."""
        model.rotate_mass(self.angle[:, joint])
