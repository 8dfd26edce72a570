"""Curves of any form: a torque, or a friction, over one variable.

They are for what no effect with an equation explains. A curve says what is missing and not why, so that a diagnosis
does not look for it, but holds it against the effects that it found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import register_effect

_LARGEST = 10.0
"""Bound of a curve's values [N m]."""
_EVEN = tuple(-1 + 0.125 * i for i in range(17))
_FROM_ZERO = (0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8, 1.0)
_DENSE_AT_ZERO = (-1.0, -0.6, -0.3, -0.15, -0.07, -0.03, 0.0, 0.03, 0.07, 0.15, 0.3, 0.6, 1.0)


def _parameters(
    knots: tuple[float, ...], zero: float | None, reach: tuple[float, float, float], unit: str, center: float = 0.0
) -> tuple[EffectParameter, ...]:
    """A value at each knot but the one where the curve is zero, and where its knots are."""
    lower, start, upper = reach
    value = EffectParameter(name="effort", unit="N m", lower=-_LARGEST, upper=_LARGEST, null=0.0, start=0.05)
    values = [
        replace(value, name=f"effort_{i}", meaning=f"f at the knot {knot:g}")
        for i, knot in enumerate(knot for knot in knots if knot != zero)
    ]
    shape = EffectParameter(
        name="reach", unit=unit, lower=lower, upper=upper, null=None, start=start, scale="log", meaning="of the knot 1"
    )
    if not center:
        return (*values, shape)
    middle = EffectParameter(
        name="center", unit=unit, lower=-center, upper=center, null=None, start=0.0, meaning="where the knot 0 is"
    )
    return (*values, replace(shape, meaning="from the knot 0 to the knot 1"), middle)


class FreeForm(Effect):
    """A curve f over one variable x: straight from knot to knot, at ``center + reach · knot``."""

    free_form = True
    knots: ClassVar[tuple[float, ...]]
    """Where the curve has values, in parts of ``reach``."""
    zero: ClassVar[float | None] = None
    """Knot at which the curve is zero."""
    variable: ClassVar[str]
    """What it goes over, in words."""
    resists: ClassVar[bool] = False
    """Whether it is a level of friction; else a torque."""
    source = "piecewise linear; no physics behind it"
    reach: torch.Tensor

    @classmethod
    def curve(cls, values: Mapping[str, float]) -> dict[str, list[float]]:
        """Where the knots are, and the curve there [N m].

        Args:
            values: By parameter.
        """
        efforts = [values[p.name] for p in cls.parameters if p.name.startswith("effort_")]
        center, reach = values.get("center", 0.0), values["reach"]
        return {
            "at": [center + reach * knot for knot in cls.knots],
            "torque": [0.0 if knot == cls.zero else efforts.pop(0) for knot in cls.knots],
        }

    def prepare(self) -> None:
        """Put the values into one tensor (rows, num_joints, knots)."""
        left = [p.name for p in self.parameters if p.name.startswith("effort_")]
        names = [None if knot == self.zero else left.pop(0) for knot in self.knots]
        self._values = torch.stack([self.zeros() if n is None else getattr(self, n) for n in names], dim=-1)
        self._knots = torch.tensor(self.knots, **self._options)
        self._width = self._knots.diff()

    def at(self, x: torch.Tensor) -> torch.Tensor:
        """The curve at x, (rows, num_joints) [N m]."""
        u = ((x - getattr(self, "center", 0.0)) / self.reach).clamp(self.knots[0], self.knots[-1])
        right = torch.bucketize(u, self._knots).clamp_(1, len(self.knots) - 1)
        left = right - 1
        part = (u - self._knots[left]) / self._width[left]
        a, b = (self._values.gather(-1, each[..., None])[..., 0] for each in (left, right))
        return a + part * (b - a)


@register_effect
class TorqueOverPosition(FreeForm):
    """A torque that goes with the position: τ + f(q)."""

    name = "torque_over_position"
    stage = "transmission"
    knots = _EVEN
    variable = "position"
    parameters = _parameters(knots, None, (0.05, 1.0, 10.0), "rad", center=10.0)
    equation = "τ + f(q)"
    looks = "the error goes with the position, up and down strokes alike"
    separates = "a staircase over the whole range"
    center: torch.Tensor

    def transmission(self, s: DriveState) -> None:
        """Add it at the joint."""
        s.effort += self.at(s.joint_pos)


@register_effect
class TorqueOverTorque(FreeForm):
    """The drive gives another torque than is asked of it: τ + f(τ), f(0) = 0."""

    name = "torque_over_torque"
    stage = "drive"
    knots = _DENSE_AT_ZERO
    zero = 0.0
    variable = "torque"
    parameters = _parameters(knots, zero, (0.05, 5.0, 300.0), "N m")
    equation = "τ + f(τ), f(0) = 0"
    looks = "the error goes with the torque"
    separates = "another load"

    def drive(self, s: DriveState) -> None:
        """Add it to what the drive gives."""
        s.effort += self.at(s.effort)


@register_effect
class TorqueOverTime(FreeForm):
    """A torque that goes with the time since the session began: τ + f(t)."""

    name = "torque_over_time"
    stage = "transmission"
    knots = tuple(0.125 * i for i in range(9))
    variable = "time"
    parameters = _parameters(knots, None, (1.0, 60.0, 3600.0), "s")
    equation = "τ + f(t)"
    looks = "the error goes with the time, whatever the motion"
    separates = "the same motion again, later"

    def transmission(self, s: DriveState) -> None:
        """Add it at the joint."""
        s.effort += self.at(s.time)


@register_effect
class FrictionOverSpeed(FreeForm):
    """Coulomb friction that goes with the speed: F_c + f(|v|), f(0) = 0."""

    name = "friction_over_speed"
    stage = "friction"
    knots = _FROM_ZERO
    zero = 0.0
    variable = "speed"
    resists = True
    parameters = _parameters(knots, zero, (0.05, 5.0, 100.0), "rad/s")
    equation = "F = F_c + f(|v|), f(0) = 0"
    looks = "the error goes with the speed, both directions alike"
    separates = "triangles of several speeds"

    def friction(self, s: DriveState) -> None:
        """Change the level."""
        s.friction += self.at(s.motor_vel.abs())


@register_effect
class FrictionOverPosition(FreeForm):
    """Coulomb friction that goes with the position: F_c + f(q), f = 0 at the center."""

    name = "friction_over_position"
    stage = "friction"
    knots = _EVEN
    zero = 0.0
    variable = "position"
    resists = True
    parameters = _parameters(knots, zero, (0.05, 1.0, 10.0), "rad", center=10.0)
    equation = "F = F_c + f(q), f = 0 at the center"
    looks = "the hysteresis loop is wider at some positions than at others"
    separates = "a slow triangle over the whole range"
    center: torch.Tensor

    def friction(self, s: DriveState) -> None:
        """Change the level."""
        s.friction += self.at(s.motor_pos)


@register_effect
class FrictionOverLoad(FreeForm):
    """Coulomb friction that goes with the load on the gear: F_c + f(|τ - τ_g|), f(0) = 0."""

    name = "friction_over_load"
    stage = "friction"
    knots = _FROM_ZERO
    zero = 0.0
    variable = "load on the gear"
    resists = True
    parameters = _parameters(knots, zero, (0.05, 5.0, 300.0), "N m")
    equation = "F = F_c + f(|τ - τ_g|), f(0) = 0, τ_g the torque of gravity and load on the joint"
    looks = "the hysteresis loop is wider at some loads than at others"
    reads_load = True
    separates = "recordings at two loads"

    def friction(self, s: DriveState) -> None:
        """Change the level."""
        s.friction += self.at((s.motor_effort - s.load_effort).abs())
