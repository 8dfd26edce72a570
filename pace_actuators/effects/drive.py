"""Effects inside the motor and its power stage."""

from __future__ import annotations

from typing import ClassVar

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter, Heat
from pace_actuators.effects.registry import register_effect

_INFINITE = float("inf")


@register_effect
class TorqueGain(Effect):
    """The drive gives more or less torque than it is asked for, of the limited torque too: τ -> g τ."""

    name = "torque_gain"
    stage = "drive"
    parameters = (EffectParameter(name="gain", unit="1", lower=0.1, upper=10.0, null=1.0, start=1.02, scale="log"),)
    equation = "τ -> g τ"
    part = "torque constant, gear ratio, efficiency"
    looks = "static sag and amplitude off together"
    source = "a wrong torque constant, gear ratio or efficiency"
    probes = ({"gain": 1.02}, {"gain": 0.4}, {"gain": 2.5})
    twins = ("payload",)
    scales = "torque"
    separates = "a recording with a known added mass"

    def drive(self, s: DriveState) -> None:
        """Scale the torque."""
        s.scale_torque(self.gain)


@register_effect
class TorqueFade(Effect):
    """The torque constant falls as the motor heats up: τ -> τ (1 - h / E²), T dh/dt + h = τ², τ what is asked.

    A session begins cold; a recording begins with the heat that those before it have left.
    """

    name = "torque_fade"
    stage = "drive"
    memory = ("_heat", "_first")
    _heat: torch.Tensor
    _first: torch.Tensor
    parameters = (
        EffectParameter(
            name="effort",
            unit="N m",
            lower=0.3,
            upper=3000.0,
            null=_INFINITE,
            start=100.0,
            scale="log",
            meaning="E: held for long, it would leave nothing",
        ),
        EffectParameter(name="time_constant", unit="s", lower=2.0, upper=2000.0, null=None, start=30.0, scale="log"),
    )
    equation = "τ -> τ (1 - h / E^2), T dh/dt + h = τ^2"
    part = "the motor's cooling, its thermal limit"
    looks = "the joint sags and slows down more and more, the more it has worked"
    source = "magnets and windings lose torque with their temperature; I²t models of motor drives"
    probes = tuple({"effort": e, "time_constant": t} for t in (10.0, 100.0) for e in (300.0, 80.0, 25.0, 8.0, 2.0))
    two_sided = False
    separates = "the same motion again after much work, and after a pause"
    least: ClassVar[float] = 0.1
    """What is left of the torque in any case."""

    def prepare(self) -> None:
        """What the heat takes, and how fast it follows."""
        self._per_heat = 1.0 / self.effort.square()
        self._weight = -torch.expm1(-self.dt / self.time_constant)

    def remember(self, heat: Heat) -> None:
        """Begin as warm as the session has made the motor."""
        self._first = heat(self.time_constant, self.rows).to(self._first)

    def drive(self, s: DriveState) -> None:
        """Scale the torque, and heat up by it."""
        self.begin(_heat=self._first)
        asked = s.effort.clone()
        left = (1.0 - self._heat * self._per_heat).clamp(min=self.least)
        s.scale_torque(left)
        self._heat = torch.lerp(self._heat, asked.square(), self._weight)


@register_effect
class SupplySag(Effect):
    """The supply gives way under load, so that the torque falls behind what is asked: τ -> τ (1 - |τ| / E).

    Beyond E/2 it rises no more.
    """

    name = "supply_sag"
    stage = "drive"
    parameters = (
        EffectParameter(
            name="effort",
            unit="N m",
            lower=0.5,
            upper=5000.0,
            null=_INFINITE,
            start=200.0,
            scale="log",
            meaning="E: four times the largest torque",
        ),
    )
    equation = "τ -> τ (1 - |τ| / E), at most E / 4"
    part = "power supply, battery, cables"
    looks = "large torques fall short, small ones do not"
    source = "internal resistance of batteries and cables; saturation of magnetic circuits"
    probes = tuple({"effort": e} for e in (2000.0, 600.0, 200.0, 60.0, 20.0, 6.0, 2.0))
    two_sided = False
    separates = "another load; the supply's voltage in the log"

    def drive(self, s: DriveState) -> None:
        """Give what is left."""
        share = (s.effort.abs() / self.effort).clamp(max=0.5)
        s.speed_slope *= 1.0 - 2.0 * share
        s.effort = torch.copysign(torch.minimum(s.effort.abs(), 0.5 * self.effort), s.effort) * (1.0 - share)


@register_effect
class DriveBandwidth(Effect):
    """The torque follows what is asked, within its limit, with a first-order lag: T τ̇ + τ = τ_cmd, exact if held."""

    name = "drive_bandwidth"
    stage = "drive"
    memory = ("_torque",)
    _torque: torch.Tensor
    parameters = (EffectParameter(name="time_constant", unit="s", lower=0.0, upper=0.03, null=0.0, start=0.002),)
    equation = "T dτ/dt + τ = clip(τ_cmd, ± τ_c)"
    part = "the current loop's tuning"
    looks = "phase falls beyond what the delay explains"
    source = "current loop of a motor drive"
    probes = ({"time_constant": 0.001}, {"time_constant": 0.005}, {"time_constant": 0.015})
    two_sided = False
    separates = "a known added mass, and recordings at another gain"

    def prepare(self) -> None:
        """Weights of the command in the torque at the end of a step and in its mean over the step."""
        decay = self.dt / self.time_constant
        self._weight = -torch.expm1(-decay)
        self._mean_weight = torch.where(decay.isinf(), 1.0, 1 - self._weight / decay)

    def current_loop(self, s: DriveState) -> None:
        """Give the mean torque over the coming step; the first counts as settled."""
        self.begin(_torque=s.effort)
        before, asked = self._torque, s.effort.clone()
        self._torque = torch.lerp(before, asked, self._weight)
        s.effort = torch.lerp(before, asked, self._mean_weight)
        s.speed_slope *= self._mean_weight


@register_effect
class TorqueRipple(Effect):
    """The torque varies with the position: a sin(N q) + b cos(N q)."""

    name = "torque_ripple"
    stage = "drive"
    joint_types = ("hinge",)
    parameters = (
        EffectParameter(name="sine", unit="N m", lower=-3.0, upper=3.0, null=0.0, start=0.1),
        EffectParameter(name="cosine", unit="N m", lower=-3.0, upper=3.0, null=0.0, start=0.0),
        EffectParameter(
            name="periods", unit="1/rev", lower=3.0, upper=220.0, null=None, start=40.0, scale="log", meaning="N"
        ),
    )
    equation = "τ + a sin(N q) + b cos(N q)"
    part = "the motor's poles, the gear's teeth"
    looks = "a comb over position"
    source = "cogging and commutation of a motor, seen through its gear"
    probes = tuple({"sine": a, "cosine": b} for a, b in ((0.1, 0.0), (0.0, 0.1)))
    comb = ("periods", "sine", "cosine")
    separates = "a slow motion over a wide range"

    def drive(self, s: DriveState) -> None:
        """Add the ripple."""
        angle = self.periods * s.joint_pos
        s.effort += self.sine * torch.sin(angle) + self.cosine * torch.cos(angle)


@register_effect
class TorqueLimit(Effect):
    """The drive limits what is asked of it more than the configuration says: |τ_cmd| <= τ_max."""

    name = "torque_limit"
    stage = "drive"
    parameters = (
        EffectParameter(name="effort", unit="N m", lower=0.1, upper=200.0, null=_INFINITE, start=20.0, scale="log"),
    )
    equation = "|τ_cmd| <= τ_max, before current loop and torque constant"
    part = "current limit, stated effort limit"
    looks = "peaks are cut, in the fast parts only"
    source = "current limit of a drive"
    probes = tuple({"effort": e} for e in (60.0, 40.0, 30.0, 20.0, 14.0, 10.0, 7.0, 5.0, 3.0, 1.0, 0.5, 0.3))
    two_sided = False
    separates = "a larger and faster motion"

    def current_limit(self, s: DriveState) -> None:
        """Clip."""
        s.speed_slope *= s.effort.abs() <= self.effort
        s.effort = torch.clamp(s.effort, -self.effort, self.effort)


@register_effect
class OffDamping(Effect):
    """A drive that is switched off brakes otherwise than one that is on: viscous friction d + c in place of d.

    Its windings are open (what back-EMF brakes while the drive is on is missing then, c < 0) or shorted (they brake by
    kt²/R).
    """

    name = "off_damping"
    stage = "drive"
    parameters = (
        EffectParameter(
            name="damping", unit="N m s/rad", lower=-5.0, upper=20.0, null=0.0, start=0.1, meaning="more while off"
        ),
    )
    equation = "d + c in place of d while the drive is switched off"
    part = "what the drive does when off: short circuit or open"
    looks = "the error sits where the drive is off: the joint falls or swings too fast or too slowly there"
    source = "open or shorted windings of a DC motor; torque_enable of servo firmware"
    probes = ({"damping": 0.1}, {"damping": 1.0})
    acts_while_off = True
    separates = "a recording with the drive switched off while the joint moves"

    def friction(self, s: DriveState) -> None:
        """Add it while the drive is off."""
        s.viscous_friction += (1.0 - s.enabled) * self.damping


@register_effect
class TorqueSpeedLimit(Effect):
    """The torque falls with the speed where the motor drives; braking is not limited.

    |τ| <= max(0, τ_stall (1 - |v|/v_0)) where τ v >= 0.

    Where a joint turns within a step, it brakes until then and drives from then on, and the mean acts. With the torque
    of the step's beginning it would brake too long, always to the same side. The speed goes on as in the last step.
    """

    name = "torque_speed_limit"
    stage = "drive"
    memory = ("_speed",)
    _speed: torch.Tensor
    parameters = (
        EffectParameter(
            name="velocity", unit="rad/s", lower=0.5, upper=60.0, null=_INFINITE, start=8.0, scale="log", meaning="v_0"
        ),
        EffectParameter(
            name="effort",
            unit="N m",
            lower=0.1,
            upper=300.0,
            null=_INFINITE,
            start=50.0,
            scale="log",
            meaning="τ_stall",
        ),
    )
    equation = "|τ| <= τ_stall (1 - |v|/v_0) where τ v > 0"
    part = "supply voltage, stated no-load speed"
    looks = "speed saturates"
    source = "DC motor at its supply's voltage"
    probes = tuple(
        {"velocity": v, "effort": e} for v in (2.0, 3.5, 6.0, 10.0, 20.0) for e in (5.0, 10.0, 20.0, 40.0, 80.0)
    )
    two_sided = False
    separates = "a larger and faster motion"

    def prepare(self) -> None:
        """Stall torque, finite so that no speed makes it undefined."""
        self._stall = self.effort.clamp(max=torch.finfo(self.effort.dtype).max)
        self._on = ~(self.effort.isinf() | self.velocity.isinf())

    def torque_speed(self, s: DriveState) -> None:
        """Clip by quadrant."""
        new = self.take_new_rows()
        last = self._speed if new is None else torch.where(new, s.motor_vel, self._speed)
        left, change = s.motor_vel * s.effort.sign(), (s.motor_vel - last) * s.effort.sign()
        fall = self._stall / self.velocity
        most = (self._stall - fall * left.abs()).clamp_(min=0.0)
        limited = self._on & (left >= 0) & (s.effort.abs() > most)
        turns = self._on & (left < 0) & (left + change > 0) & (s.effort.abs() > self._stall)
        braking = torch.where(turns, -left / torch.where(turns, change, 1.0), 1.0)
        s.speed_slope = torch.where(limited & (most > 0), fall, s.speed_slope)
        mean = torch.lerp(torch.copysign(self._stall, s.effort), s.effort, braking)
        s.effort = torch.where(limited, torch.copysign(most, s.effort), torch.where(turns, mean, s.effort))
        self._speed = s.motor_vel.clone()
