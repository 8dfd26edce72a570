"""Curves of any form over one variable: a torque or a friction, or what torque, friction or inertia is multiplied by.

They are for what no effect with an equation explains. A curve says what is missing and not why, so that a diagnosis
does not look for it, but holds it against the effects that it found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Literal

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import register_effect

_EFFORT = EffectParameter(name="effort", unit="N m", lower=-10.0, upper=10.0, null=0.0, start=0.05, follows_drive=True)
"""A value of a curve of torques or frictions."""
SHARE = EffectParameter(name="share", unit="1", lower=-0.95, upper=4.0, null=0.0, start=0.02)
"""A value of a curve that multiplies."""
_EVEN = tuple(-1 + 0.125 * i for i in range(17))
_FROM_ZERO = (0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8, 1.0)
_RISING = tuple(0.125 * i for i in range(9))
_DENSE_AT_ZERO = (-1.0, -0.6, -0.3, -0.15, -0.07, -0.03, 0.0, 0.03, 0.07, 0.15, 0.3, 0.6, 1.0)


def parameters_of_curve(
    knots: tuple[float, ...],
    zero: float | None,
    reach: tuple[float, float, float],
    unit: str,
    center: float = 0.0,
    value: EffectParameter = _EFFORT,
) -> tuple[EffectParameter, ...]:
    """A value at each knot but the one where the curve is zero, and where its knots are."""
    lower, start, upper = reach
    values = [
        replace(value, name=f"{value.name}_{i}", meaning=f"f at the knot {knot:g}")
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
    kind: ClassVar[Literal["torque", "friction", "gain", "inertia"]] = "torque"
    """What it is: a torque or a friction, which is added, or what a torque or the inertia is multiplied by."""
    source = "piecewise linear; no physics behind it"

    @classmethod
    def curve(cls, values: Mapping[str, float]) -> dict[str, list[float]]:
        """Where the knots are, and the curve there [N m], or the part by which it changes what it multiplies."""
        own = [values[name] for name in cls._names()]
        center, reach = values.get("center", 0.0), values["reach"]
        return {
            "at": [center + reach * knot for knot in cls.knots],
            "torque": [0.0 if knot == cls.zero else own.pop(0) for knot in cls.knots],
        }

    @classmethod
    def law(cls, values: Mapping[str, float], friction: float, viscous_friction: float) -> dict[str, list[float]]:
        """The curve, of a friction with all friction that there is: they share a part that cannot be separated."""
        result = cls.curve(values)
        if cls.kind == "friction" and cls.parameters[0].unit == "N m":
            slope = viscous_friction if cls.variable == "speed" else 0.0
            knots = zip(result["at"], result["torque"], strict=True)
            result["torque"] = [max(0.0, friction + more) + slope * x for x, more in knots]
        return result

    @classmethod
    def _names(cls) -> list[str]:
        """Its values, by parameter."""
        return [p.name for p in cls.parameters if p.null is not None]

    def prepare(self) -> None:
        """Put the values into one tensor (rows, num_joints, knots)."""
        left = self._names()
        names = [None if knot == self.zero else left.pop(0) for knot in self.knots]
        self._values = torch.stack([self.zeros() if n is None else getattr(self, n) for n in names], dim=-1)
        self._knots = torch.tensor(self.knots, **self._options)
        self._width = self._knots.diff()

    def at(self, x: torch.Tensor) -> torch.Tensor:
        """The curve at x, (rows, num_joints)."""
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
    parameters = parameters_of_curve(knots, None, (1e-3, 1.0, 10.0), "rad", center=10.0)
    equation = "τ + f(q)"
    looks = "the error goes with the position, up and down strokes alike"
    separates = "a staircase over the whole range"

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
    parameters = parameters_of_curve(knots, zero, (1e-3, 5.0, 300.0), "N m")
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
    knots = _RISING
    variable = "time"
    parameters = parameters_of_curve(knots, None, (1.0, 60.0, 3600.0), "s")
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
    kind = "friction"
    parameters = parameters_of_curve(knots, zero, (1e-3, 5.0, 100.0), "rad/s")
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
    kind = "friction"
    parameters = parameters_of_curve(knots, zero, (1e-3, 1.0, 10.0), "rad", center=10.0)
    equation = "F = F_c + f(q), f = 0 at the center"
    looks = "the hysteresis loop is wider at some positions than at others"
    separates = "a slow triangle over the whole range"

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
    kind = "friction"
    parameters = parameters_of_curve(knots, zero, (1e-3, 5.0, 300.0), "N m")
    equation = "F = F_c + f(|τ - τ_g|), f(0) = 0, τ_g as for gravity_compensation"
    looks = "the hysteresis loop is wider at some loads than at others"
    reads_load = True
    separates = "recordings at two loads"

    def friction(self, s: DriveState) -> None:
        """Change the level."""
        s.friction += self.at((s.motor_effort - s.load_effort).abs())


class GainCurve(FreeForm):
    """The drive gives (1 + f(x)) times the torque that is asked."""

    stage = "drive"
    kind = "gain"

    def over(self, s: DriveState) -> torch.Tensor:
        """The variable, (rows, num_joints)."""
        raise NotImplementedError

    def drive(self, s: DriveState) -> None:
        """Scale the torque."""
        s.scale_torque(1.0 + self.at(self.over(s)))


@register_effect
class GainOverTime(GainCurve):
    """The drive's torque is (1 + f(t)) times what is asked."""

    name = "gain_over_time"
    knots = _RISING
    variable = "time"
    parameters = parameters_of_curve(knots, None, (1.0, 60.0, 3600.0), "s", value=SHARE)
    equation = "τ -> (1 + f(t)) τ"
    looks = "static sag and amplitude change with the time, in proportion to the torque"
    separates = "the same motion again, later"

    def over(self, s: DriveState) -> torch.Tensor:
        """Time since the session began."""
        return s.time


@register_effect
class GainOverPosition(GainCurve):
    """The drive's torque is (1 + f(q)) times what is asked."""

    name = "gain_over_position"
    knots = _EVEN
    variable = "position"
    parameters = parameters_of_curve(knots, None, (1e-3, 1.0, 10.0), "rad", center=10.0, value=SHARE)
    equation = "τ -> (1 + f(q)) τ"
    looks = "the error goes with the torque, more at some positions than at others"
    separates = "a staircase over the whole range, with two loads"

    def over(self, s: DriveState) -> torch.Tensor:
        """Position."""
        return s.joint_pos


@register_effect
class GainOverSpeed(GainCurve):
    """The drive's torque is (1 + f(|v|)) times what is asked, f(0) = 0."""

    name = "gain_over_speed"
    knots = _FROM_ZERO
    zero = 0.0
    variable = "speed"
    parameters = parameters_of_curve(knots, zero, (1e-3, 5.0, 100.0), "rad/s", value=SHARE)
    equation = "τ -> (1 + f(|v|)) τ, f(0) = 0"
    looks = "the torque falls short where the joint is fast"
    separates = "fast motions with two loads"

    def over(self, s: DriveState) -> torch.Tensor:
        """Speed."""
        return s.motor_vel.abs()


@register_effect
class FrictionOverTime(FreeForm):
    """All friction goes with the time: (1 + f(t)) times Coulomb and viscous friction."""

    name = "friction_over_time"
    stage = "friction"
    knots = _RISING
    variable = "time"
    kind = "friction"
    parameters = parameters_of_curve(knots, None, (1.0, 60.0, 3600.0), "s", value=SHARE)
    equation = "(1 + f(t)) times F_c and d"
    looks = "the hysteresis loop becomes wider or narrower with the time"
    separates = "the same motion again, later"

    def friction(self, s: DriveState) -> None:
        """Scale both frictions."""
        s.add_friction(self.at(s.time))


@register_effect
class InertiaOverPosition(FreeForm):
    """All inertia goes with the position: (1 + f(q)) times that of link and rotor.

    As f changes along the way the joint feels - I f'(q) v²/2 too.
    """

    name = "inertia_over_position"
    stage = "transmission"
    knots = _EVEN
    variable = "position"
    kind = "inertia"
    parameters = parameters_of_curve(knots, None, (1e-3, 1.0, 10.0), "rad", center=10.0, value=SHARE)
    equation = "(1 + f(q)) I, and τ - I f'(q) v²/2, I the inertia of link and rotor"
    looks = "fast parts are too early at some positions and too late at others"
    reads_link = True
    changes_armature = True
    separates = "fast motions about several positions"
    across: ClassVar[float] = 0.05
    """Part of the reach over which the slope is taken."""

    def armature(self, s: DriveState) -> None:
        """Carry more or less."""
        s.armature += self.at(s.joint_pos) * (s.link_inertia + s.base_armature)

    def transmission(self, s: DriveState) -> None:
        """What the change along the way takes."""
        away = self.across * self.reach
        slope = (self.at(s.joint_pos + away) - self.at(s.joint_pos - away)) / (2.0 * away)
        s.effort -= 0.5 * slope * (s.link_inertia + s.base_armature) * s.joint_vel.square()
