"""What a drive's logged temperature and voltage do: laws that are straight, and curves where these are not it.

Between the beginning and the end of a recording a condition is a line of eight straight parts. A supply that gives way
for milliseconds is no condition: see ``supply_sag``.
"""

from __future__ import annotations

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Conditions, Effect, EffectParameter
from pace_actuators.effects.free_form import SHARE, FreeForm, GainCurve, parameters_of_curve
from pace_actuators.effects.registry import register_effect

_PLACES = 9
"""Instants of a recording between which a condition is a straight line."""
_FEW = (-1.0, -0.5, 0.0, 0.5, 1.0)
_REFERENCE = 25.0
"""Temperature at which friction and torque constant are those of the base model [°C]."""
_LEAST = 0.05
"""What is left of a friction or a torque in any case."""


class _OfCondition(Effect):
    """What follows a condition of the drive; where nothing was logged, that is :meth:`usual`."""

    memory = ("_first", "_rate", *(f"_place_{k}" for k in range(_PLACES)))
    _first: torch.Tensor
    _rate: torch.Tensor

    def usual(self) -> torch.Tensor:
        """The condition at which it does nothing, (rows, num_joints)."""
        return self.full(_REFERENCE)

    def notice(self, conditions: Conditions) -> None:
        """Keep the line."""
        if (logged := conditions(self.condition, _PLACES, self.rows)) is None:
            return
        time, values = logged
        self._first = self.zeros() + time[..., 0].to(self._first)
        self._rate = self.zeros() + 1.0 / time[..., 1].to(self._rate)
        for k in range(_PLACES):
            setattr(self, f"_place_{k}", values[..., k].to(self._first))

    def now(self, s: DriveState) -> torch.Tensor:
        """The condition, (rows, num_joints)."""
        along = (s.time - self._first) * self._rate
        places = [getattr(self, f"_place_{k}") for k in range(_PLACES)]
        result = places[0]
        for k in range(_PLACES - 1):
            result = result + (places[k + 1] - places[k]) * (along - k).clamp(0.0, 1.0)
        return torch.where(self._rate > 0, result, self.usual())


@register_effect
class ThermalFriction(_OfCondition):
    """All friction falls as the drive warms up: 1 + k (T - 25 °C) times Coulomb and viscous friction."""

    name = "thermal_friction"
    stage = "friction"
    condition = "temperature"
    parameters = (
        EffectParameter(name="slope", unit="1/°C", lower=-0.05, upper=0.05, null=0.0, start=-0.005, meaning="k"),
    )
    equation = "1 + k (T - 25 °C) times F_c and d, T the motor's logged temperature"
    part = "grease and seals of the gear"
    looks = "the hysteresis loop becomes narrower as the drive warms up"
    source = "Bittencourt, Gunnarsson 2012, static friction in a robot joint: load and temperature"
    separates = "the same motion again, cold and warm"

    def friction(self, s: DriveState) -> None:
        """Scale both frictions."""
        s.add_friction((self.slope * (self.now(s) - _REFERENCE)).clamp(min=_LEAST - 1.0))


@register_effect
class ThermalTorque(_OfCondition):
    """The torque constant falls as the motor warms up: τ -> τ (1 + k (T - 25 °C))."""

    name = "thermal_torque"
    stage = "drive"
    condition = "temperature"
    parameters = (
        EffectParameter(name="slope", unit="1/°C", lower=-0.02, upper=0.02, null=0.0, start=-0.002, meaning="k"),
    )
    equation = "τ -> τ (1 + k (T - 25 °C)), T the motor's logged temperature"
    part = "the motor's magnets, cooling"
    looks = "the joint sags and slows down as the motor warms up"
    source = "magnets lose 0.1 to 0.2 % of their flux per °C"
    separates = "the same motion again, cold and warm"

    def drive(self, s: DriveState) -> None:
        """Scale the torque."""
        s.scale_torque((1.0 + self.slope * (self.now(s) - _REFERENCE)).clamp(min=_LEAST))


@register_effect
class SupplyVoltage(_OfCondition):
    """The drive's torque goes with the supply's voltage: τ -> τ (1 + k (U / U_n - 1)).

    k is 1 where the drive states a share of the voltage, and 0 where it controls the current.
    """

    name = "supply_voltage"
    stage = "drive"
    condition = "voltage"
    parameters = (
        EffectParameter(
            name="share", unit="1", lower=-0.5, upper=2.0, null=0.0, start=0.3, meaning="k", possible=(-5.0, 5.0)
        ),
        EffectParameter(
            name="nominal", unit="V", lower=2.0, upper=500.0, null=None, start=24.0, scale="log", meaning="U_n"
        ),
    )
    equation = "τ -> τ (1 + k (U / U_n - 1)), U the logged voltage"
    part = "the battery, the voltage compensation"
    looks = "static sag and amplitude follow the battery"
    source = "a bridge that is switched: its mean voltage is a share of the supply's"
    probes = tuple({"nominal": u} for u in (7.0, 12.0, 24.0, 48.0))
    separates = "the same motion again with another voltage"

    def usual(self) -> torch.Tensor:
        """The nominal voltage."""
        return self.nominal

    def drive(self, s: DriveState) -> None:
        """Scale the torque."""
        s.scale_torque((1.0 + self.share * (self.now(s) / self.nominal - 1.0)).clamp(min=_LEAST))


class _Curve(_OfCondition, FreeForm):
    """A curve over a condition."""

    knots = _FEW

    def usual(self) -> torch.Tensor:
        """That of the knot 0."""
        return self.center


@register_effect
class FrictionOverTemperature(_Curve):
    """All friction goes with the motor's temperature: (1 + f(T)) times Coulomb and viscous friction."""

    name = "friction_over_temperature"
    stage = "friction"
    condition = variable = "temperature"
    zero = 0.0
    kind = "friction"
    parameters = parameters_of_curve(_FEW, zero, (0.1, 20.0, 200.0), "°C", center=200.0, value=SHARE)
    equation = "(1 + f(T)) times F_c and d, f = 0 at the center, T the logged temperature"
    looks = "the hysteresis loop becomes narrower as the drive warms up"
    separates = "the same motion again, cold and warm"

    def friction(self, s: DriveState) -> None:
        """Scale both frictions."""
        s.add_friction(self.at(self.now(s)))


class _GainOverCondition(_Curve, GainCurve):
    """A gain over a condition."""

    def over(self, s: DriveState) -> torch.Tensor:
        """The condition."""
        return self.now(s)


@register_effect
class GainOverTemperature(_GainOverCondition):
    """The drive's torque is (1 + f(T)) times what is asked, T the motor's temperature."""

    name = "gain_over_temperature"
    condition = variable = "temperature"
    parameters = parameters_of_curve(_FEW, None, (0.1, 20.0, 200.0), "°C", center=200.0, value=SHARE)
    equation = "τ -> (1 + f(T)) τ, T the logged temperature"
    looks = "static sag and amplitude change as the drive warms up, in proportion to the torque"
    separates = "the same motion again, cold and warm"


@register_effect
class GainOverVoltage(_GainOverCondition):
    """The drive's torque is (1 + f(U)) times what is asked, U the supply's voltage."""

    name = "gain_over_voltage"
    condition = variable = "voltage"
    parameters = parameters_of_curve(_FEW, None, (0.01, 2.0, 500.0), "V", center=500.0, value=SHARE)
    equation = "τ -> (1 + f(U)) τ, U the logged voltage"
    looks = "static sag and amplitude follow the battery"
    separates = "the same motion again with another voltage"
