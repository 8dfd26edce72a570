"""Coulomb friction that fades towards standstill: nothing sticks for ever."""

from __future__ import annotations

from typing import ClassVar

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import register_effect


class _FadingFriction(Effect):
    """What friction laws share that take the level over from the simulator, at the speed in the middle of the step."""

    stage = "friction"
    two_sided = False
    smooths_friction = True
    memory = ("_before",)
    _before: torch.Tensor
    separates = "a staircase that holds each of its steps longer, and a slow triangle"

    def middle_speed(self, s: DriveState) -> torch.Tensor:
        """The speed in the middle of the step, as the last two let expect [rad/s]; once per step."""
        self.begin(_before=s.motor_vel)
        middle = 1.5 * s.motor_vel - 0.5 * self._before
        self._before = s.motor_vel.clone()
        return middle

    def drag(self, s: DriveState, damping: torch.Tensor) -> None:
        """Add a drag [N m s/rad]; the part that is too fast for the step acts on the speed at its end."""
        resolved = torch.minimum(damping, s.armature / self.dt)
        s.viscous_friction += resolved
        s.implicit_damping += damping - resolved


@register_effect
class CreepingFriction(_FadingFriction):
    """Coulomb friction that fades towards standstill, so that a loaded joint creeps instead of sticking.

    F tanh(|v|/v_s) is its tangent at the speed in the middle of the step, L + D |v|. The simulator applies the level L,
    which turns within a step. D is viscous friction; the part that is too fast for the step acts on the speed at its
    end. Both are ≥ 0: no v_s is too small for the step, and none creates energy.
    """

    name = "creeping_friction"
    parameters = (
        EffectParameter(name="velocity", unit="rad/s", lower=0.0, upper=0.5, null=0.0, start=0.02, meaning="v_s"),
    )
    equation = "F tanh(v / v_s) in place of F sgn(v)"
    looks = "a joint that should stick creeps on under its load; soft reversals"
    source = "regularised Coulomb friction (e.g. Marques, Flores, Claro, Lankarani 2016); simulators' soft friction"
    probes = ({"velocity": 0.005}, {"velocity": 0.02}, {"velocity": 0.08}, {"velocity": 0.25})
    velocity: torch.Tensor

    def prepare(self) -> None:
        """Where it acts."""
        super().prepare()
        self._on = self.velocity > 0
        self._velocity = torch.where(self._on, self.velocity, 1.0)

    def transmission(self, s: DriveState) -> None:
        """Split the level, after all that changes it."""
        relative = self.middle_speed(s).abs() / self._velocity
        share = torch.tanh(relative)
        slope = 1 - share.square()
        level = (share - slope * relative).clamp(min=0.0)
        self.drag(s, torch.where(self._on, slope * s.friction / self._velocity, 0.0))
        s.friction = torch.where(self._on, level * s.friction, s.friction)


@register_effect
class SoftFriction(_FadingFriction):
    """Coulomb friction as MuJoCo's constraint ``frictionloss`` has it: it gives way within a time constant.

    The constraint asks for the acceleration -b v with an impedance d. Below its level it brakes with d (τ + M b v),
    τ all other torques and M the joint's inertia: a joint that should stick creeps, and a turn takes longer.
    """

    name = "soft_friction"
    parameters = (
        EffectParameter(
            name="time_constant", unit="s", lower=0.0, upper=0.2, null=0.0, start=0.02, meaning="T, solref's first"
        ),
    )
    equation = "f = -clip(d (τ + M b v), ± F), b = 2 / (0.95 T), d = 0.9"
    looks = "a joint that should stick creeps on under its load; soft reversals"
    source = "MuJoCo's manual, friction loss and solver parameters, at its defaults of solimp"
    probes = ({"time_constant": 0.005}, {"time_constant": 0.02}, {"time_constant": 0.08})
    reads_load = True
    reads_link = True
    impedance: ClassVar[float] = 0.9
    """At rest, d."""
    widest: ClassVar[float] = 0.95
    """Largest impedance, which MuJoCo takes for b."""
    time_constant: torch.Tensor

    def prepare(self) -> None:
        """Where it acts, and how fast it takes a speed away."""
        super().prepare()
        self._on = self.time_constant > 0
        self._rate = torch.where(self._on, 2 / (self.widest * self.time_constant), 0.0)

    def transmission(self, s: DriveState) -> None:
        """Brake below the level in place of the simulator, after all that changes the level."""
        speed = self.middle_speed(s)
        free = s.effort + s.load_effort - s.viscous_friction * speed
        damping = self.impedance * self._rate * (s.link_inertia + s.base_armature)
        asked = self.impedance * free + damping * speed
        below = self._on & (asked.abs() < s.friction)
        against = self._on & ~below & (asked * speed < 0)  # it slows a turn down
        s.effort -= torch.where(below, self.impedance * free, torch.where(against, torch.sign(asked) * s.friction, 0.0))
        self.drag(s, torch.where(below, damping, 0.0))
        s.friction = torch.where(below | against, 0.0, s.friction)
