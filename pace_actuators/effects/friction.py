"""Friction laws beyond Coulomb and viscous friction.

The simulator applies Coulomb friction itself, so that a stuck joint sticks; an effect changes its level.
"""

from __future__ import annotations

import math

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter, off
from pace_actuators.effects.registry import register_effect


@register_effect
class StribeckFriction(Effect):
    """Friction is larger near standstill: F(v) = F_c + F_s exp(-(v/v_s)²)."""

    name = "stribeck_friction"
    stage = "friction"
    parameters = (
        EffectParameter(name="effort", unit="N m", lower=0.0, upper=4.0, null=0.0, start=0.1, meaning="F_s"),
        EffectParameter(
            name="velocity", unit="rad/s", lower=0.01, upper=1.0, null=None, start=0.1, scale="log", meaning="v_s"
        ),
    )
    equation = "F(v) = F_c + F_s exp(-(v/v_s)^2)"
    part = "the gear's lubrication, seals"
    looks = "error right after reversals and at creep; torque against speed dips, then rises"
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994"
    probes = ({"velocity": 0.03}, {"velocity": 0.1}, {"velocity": 0.3}, {"velocity": 0.8})
    two_sided = False
    separates = "a slow triangle"

    def friction(self, s: DriveState) -> None:
        """Raise the level near standstill."""
        s.friction += self.effort * torch.exp(-((s.motor_vel / self.velocity) ** 2))


@register_effect
class DynamicFriction(Effect):
    """Friction while sliding is less than at rest: F_c breaks away, r F_c slides; PACE's ``separate_dynamic_friction``.

    The base model's friction is then that at rest. Between the two, F(v) = F_c (r + (1 - r) exp(-(v/v_s)²)), v_s as
    small as a step resolves: a Stribeck friction of fixed width.
    """

    name = "dynamic_friction"
    stage = "friction"
    parameters = (EffectParameter(name="ratio", unit="1", lower=0.0, upper=1.0, null=1.0, start=0.8, meaning="r"),)
    equation = "F_c at rest, r F_c while sliding (beyond 0.02 rad/s)"
    part = "the gear's lubrication, seals"
    looks = "as stribeck_friction of a narrow width: error right after reversals"
    source = "Bjelonic et al., PACE 0.2.0: dynamic friction as a ratio of static friction"
    probes = ({"ratio": 0.8},)
    two_sided = False
    twins = ("stribeck_friction",)
    separates = "a slow triangle"

    creep = 0.02
    """v_s [rad/s]."""

    def friction(self, s: DriveState) -> None:
        """Lower the level where it slides."""
        stuck = torch.exp(-((s.motor_vel / self.creep) ** 2))
        s.friction *= torch.lerp(self.ratio, torch.ones_like(self.ratio), stuck)


@register_effect
class LoadDependentFriction(Effect):
    """Friction grows with the load on the gear: F = F_c + k_l |τ - τ_g|."""

    name = "load_dependent_friction"
    stage = "friction"
    parameters = (
        EffectParameter(name="coefficient", unit="1", lower=0.0, upper=0.5, null=0.0, start=0.01, meaning="k_l"),
    )
    equation = "F = F_c + k_l |τ - τ_g|, τ_g as for gravity_compensation"
    part = "the gear: worm, harmonic or planetary"
    looks = "the hysteresis loop widens with the load"
    source = "Duclusaud et al., BAM (Rhoban), model M3"
    probes = ({"coefficient": 0.01},)
    two_sided = False
    reads_load = True
    needs_loads = True
    separates = "recordings at two loads"

    def friction(self, s: DriveState) -> None:
        """Raise the level with the load."""
        s.friction += self.coefficient * (s.motor_effort - s.load_effort).abs()


@register_effect
class FrictionAsymmetry(Effect):
    """Coulomb friction differs between the directions: F_c + a forward, F_c - a backward, never less than none.

    Two levels are the same as one level and a constant torque, at rest and sliding, and are given to the simulator so:

        F₊ = max(F_c + a, 0)   F₋ = max(F_c - a, 0)   F = (F₊ + F₋)/2   τ -> τ - (F₊ - F₋)/2
    """

    name = "friction_asymmetry"
    stage = "friction"
    parameters = (EffectParameter(name="effort", unit="N m", lower=-1.5, upper=1.5, null=0.0, start=0.05),)
    equation = "F = F_c + a sgn(v)"
    part = "a gear or bearing that is worn to one side; a tendon"
    looks = "up and down strokes differ"
    source = "BAM (Rhoban), directional friction"
    probes = ({"effort": 0.05},)
    twins = ("torque_offset",)
    separates = "a second session: a torque stays when the friction changes"

    def friction(self, s: DriveState) -> None:
        """Brake one way more than the other."""
        forward = (s.friction + self.effort).clamp(min=0.0)
        backward = (s.friction - self.effort).clamp(min=0.0)
        s.effort -= 0.5 * (forward - backward)
        s.friction = 0.5 * (forward + backward)


@register_effect
class QuadraticFriction(Effect):
    """Friction that grows with the square of the speed: b₂ v |v|.

    Where b₂ is negative it takes from the viscous friction, never more than there is: it does not drive the joint.
    """

    name = "quadratic_friction"
    stage = "friction"
    parameters = (
        EffectParameter(
            name="coefficient",
            unit="N m s^2/rad^2",
            lower=-1.0,
            upper=3.0,
            null=0.0,
            start=0.02,
            plausible=(0.0, math.inf),
        ),
    )
    equation = "τ - b2 v |v|"
    part = "grease that is churned, fans, air"
    looks = "the error grows with speed, in both directions"
    source = "churning of a gear's oil; BAM (Rhoban)"
    probes = ({"coefficient": 0.02},)
    separates = "a faster motion"

    def friction(self, s: DriveState) -> None:
        """Change the viscous friction, which the simulator integrates implicitly."""
        s.viscous_friction += self.coefficient * s.motor_vel.abs()


@register_effect
class FrictionDrift(Effect):
    """Friction changes as the drive warms up: d and F_c times 1 + δ (1 - exp(-t/T)), t since the session began."""

    name = "friction_drift"
    stage = "friction"
    parameters = (
        EffectParameter(
            name="ratio", unit="1", lower=-0.8, upper=0.8, null=0.0, start=0.05, meaning="δ", possible=(-0.95, 9.0)
        ),
        EffectParameter(name="time_constant", unit="s", lower=1.0, upper=600.0, null=None, start=30.0, scale="log"),
    )
    equation = "d and F_c times (1 + δ (1 - exp(-t/T)))"
    part = "warm-up, wear, a screw that comes loose"
    looks = "the error grows or shrinks from recording to recording"
    source = "grease that warms up"
    probes = ({"time_constant": 5.0}, {"time_constant": 20.0}, {"time_constant": 80.0})
    separates = "the first recording once more at the end of the session"

    def friction(self, s: DriveState) -> None:
        """Scale the base friction."""
        s.add_friction(-self.ratio * torch.expm1(-s.time / self.time_constant))


@register_effect
class PreslidingFriction(Effect):
    """Coulomb friction behind a bristle: the joint gives way elastically before it slides (Dahl, LuGre).

    ż = v - σ₀ |v| z / F, friction σ₀ z. It depends on the path only, so that each step is integrated exactly:
    z₊ = ± F/σ₀ + (z ∓ F/σ₀) exp(-σ₀ |Δq| / F).
    """

    name = "presliding_friction"
    stage = "friction"
    memory = ("_bristle", "_position")
    _bristle: torch.Tensor
    _position: torch.Tensor
    parameters = (
        EffectParameter(
            name="stiffness",
            unit="N m/rad",
            lower=10.0,
            upper=3000.0,
            null=float("inf"),
            start=300.0,
            scale="log",
            meaning="σ_0",
            follows_loop=True,
        ),
    )
    equation = "dz/dt = v - σ0 |v| z / F, friction σ0 z"
    part = "bearings, seals"
    looks = "soft loops at tiny amplitudes, no sharp stick"
    source = "Dahl 1968; Canudas de Wit, Olsson, Astrom, Lischinsky 1995"
    probes = ({"stiffness": 1000.0}, {"stiffness": 300.0}, {"stiffness": 100.0}, {"stiffness": 30.0})
    two_sided = False
    is_stiff = True
    separates = "a slow triangle of small amplitude"

    def prepare(self) -> None:
        """Where it acts."""
        self._on = ~off(self.stiffness)
        self._sigma = torch.where(self._on, self.stiffness, 0.0)

    def transmission(self, s: DriveState) -> None:
        """Take the Coulomb level over from the simulator.

        The bristle's force is taken at the present position, its slope towards the next one implicitly (a quarter
        of a step, as Newmark's average acceleration does), so that no stiffness is too large for the step. At first no
        bristle is bent.
        """
        self.begin(_bristle=0.0, _position=s.motor_pos)
        level = s.friction.clamp(min=1e-9)
        moved = s.motor_pos - self._position
        direction = torch.sign(moved)
        limit = direction * level / self._sigma.clamp(min=1e-9)
        decay = torch.exp(-self._sigma * moved.abs() / level)
        bent = torch.where(moved == 0, self._bristle, limit + (self._bristle - limit) * decay)
        furthest = level / self._sigma.clamp(min=1e-9)
        self._bristle = torch.clamp(bent, -furthest, furthest)
        self._position = s.motor_pos.clone()
        slope = self._sigma * (1 - self._sigma * self._bristle * torch.sign(s.motor_vel) / level).clamp(0.0, 1.0)
        implicit = slope * (0.3 * self.dt)
        # towards the mean position of the step: Newmark's average acceleration, as two_mass has it
        ahead = (-0.25 * self.dt if self.is_trapezoidal else 0.3 * self.dt) * slope
        s.effort += torch.where(self._on, ahead * s.motor_vel - self._sigma * self._bristle, 0.0)
        s.implicit_damping += implicit
        s.friction = torch.where(self._on, 0.0, s.friction)
