"""Coulomb friction that fades towards standstill: nothing sticks for ever."""

from __future__ import annotations

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import register_effect

IMPEDANCE, WIDEST = 0.9, 0.95
"""MuJoCo's defaults of ``solimp``: d, the impedance at rest, and the largest, which it takes for b."""
_SEPARATES = "a staircase that holds each of its steps longer, and a slow triangle"


def step_of_constraint(time_constant: torch.Tensor, dt: float) -> tuple[torch.Tensor, torch.Tensor]:
    """MuJoCo's friction constraint, whose rate b acts on a speed within a step h, as one of the speed before it.

    Below its level friction f holds a joint with the acceleration a and the speed v to a + b v + R f = 0. With R = ρ A,
    A what a torque on the joint alone accelerates it by, ρ = (1 - d) / d and b = 2 / (0.95 T), a step has

        a + b (v + θ h a) + R f = 0    or    a + b' v + R' f = 0,    b' = b / (1 + θ b h),  R' = R / (1 + θ b h)

    with θ = ½, of second order, or where that would let the speed ring, d b h > 2, with 1 - 1 / (d b h).

    Args:
        time_constant: T [s].
        dt: h [s].

    Returns:
        b' [1/s] and ρ' = R' / A.
    """
    time = WIDEST * time_constant
    share = (1 - time / (2 * IMPEDANCE * dt)).clamp(min=0.5)
    longer = time + 2 * dt * share
    return 2 / longer, (1 - IMPEDANCE) / IMPEDANCE * time / longer


def solver_parameters(rate: torch.Tensor, softness: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """What MuJoCo is to be given for b' and ρ': the time constant of ``solreffriction`` [s], and the impedance.

    Args:
        rate: b' [1/s].
        softness: ρ'.
    """
    impedance = 1 / (1 + softness)
    return 2 / (impedance * rate), impedance


@register_effect
class CreepingFriction(Effect):
    """Coulomb friction that fades towards standstill, so that a loaded joint creeps instead of sticking.

    F tanh(|v|/v_s) is its tangent at the speed in the middle of the step, L + D |v|. The simulator applies the level L,
    which turns within a step. D is viscous friction; the part that is too fast for the step acts on the speed at its
    end. Both are ≥ 0: no v_s is too small for the step, and none creates energy.
    """

    name = "creeping_friction"
    stage = "friction"
    two_sided = False
    smooths_friction = True
    memory = ("_before",)
    _before: torch.Tensor
    parameters = (
        EffectParameter(name="velocity", unit="rad/s", lower=0.0, upper=0.5, null=0.0, start=0.02, meaning="v_s"),
    )
    equation = "F tanh(v / v_s) in place of F sgn(v)"
    part = "grease, seals, a cable that yields"
    looks = "a joint that should stick creeps on under its load; soft reversals"
    source = "regularised Coulomb friction (e.g. Marques, Flores, Claro, Lankarani 2016); simulators' soft friction"
    probes = ({"velocity": 0.005}, {"velocity": 0.02}, {"velocity": 0.08}, {"velocity": 0.25})
    separates = _SEPARATES

    def prepare(self) -> None:
        """Where it acts."""
        super().prepare()
        self._on = self.velocity > 0
        self._velocity = torch.where(self._on, self.velocity, 1.0)

    def transmission(self, s: DriveState) -> None:
        """Split the level, after all that changes it."""
        self.begin(_before=s.motor_vel)
        middle = 1.5 * s.motor_vel - 0.5 * self._before  # of the step, as the last two speeds let expect
        self._before = s.motor_vel.clone()
        relative = middle.abs() / self._velocity
        share = torch.tanh(relative)
        slope = 1 - share.square()
        level = (share - slope * relative).clamp(min=0.0)
        damping = torch.where(self._on, slope * s.friction / self._velocity, 0.0)
        resolved = torch.minimum(damping, s.armature / self.dt)
        s.viscous_friction += resolved
        s.implicit_damping += damping - resolved
        s.friction = torch.where(self._on, level * s.friction, s.friction)


@register_effect
class SoftFriction(Effect):
    """Coulomb friction as MuJoCo's constraint ``frictionloss`` has it: it gives way within a time constant.

    The constraint asks for the acceleration -b v with an impedance d. Below its level it brakes with d (τ + M b v),
    τ all other torques and M the joint's inertia: a joint that should stick creeps, and a turn takes longer. The
    simulator applies it: MuJoCo by its own constraint, which solves it for all joints together.
    """

    name = "soft_friction"
    stage = "friction"
    parameters = (
        EffectParameter(
            name="time_constant", unit="s", lower=0.0, upper=0.2, null=0.0, start=0.02, meaning="T, solref's first"
        ),
    )
    equation = "f = -clip(d (τ + M b v), ± F), b = 2 / (0.95 T), d = 0.9"
    part = "none: the recording is from MuJoCo"
    looks = "a joint that should stick creeps on under its load; soft reversals"
    remark = (
        "soft_friction is MuJoCo's default for frictionloss: the log may come from a simulator. "
        "Joints of real robots stick."
    )
    source = "MuJoCo's manual, friction loss and solver parameters, at its defaults of solimp"
    probes = ({"time_constant": 0.005}, {"time_constant": 0.02}, {"time_constant": 0.08})
    shared = True
    two_sided = False
    smooths_friction = True
    separates = _SEPARATES

    def constraint(self, s: DriveState) -> None:
        """Let the simulator apply it."""
        s.friction_time = self.time_constant
