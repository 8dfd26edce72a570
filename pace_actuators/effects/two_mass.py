"""Motor and link as two inertias: joint elasticity and backlash.

The simulator keeps the link; the effect keeps the motor (angle θ, armature J, viscous friction b, Coulomb friction F):

    J θ̈ = τ - f - b θ̇ - F sgn θ̇        f = k δ + c δ̇,  δ = θ - q        link: + f

Both are integrated together with Newmark's average acceleration: with v the link's speed and ₊ the next step,

    f = f_e + K (θ̇₊ - v₊)    f_e = k δ + (c/2 ∓ k h/4)(θ̇ - v)    K = k h/4 + c/2

(- where the simulator moves positions with the new speed, + where it moves them with the mean of old and new).
The motor's equation gives θ̇₊ as a function of v₊, so that f = f₀ - D v₊: the link gets the torque f₀, and D as
viscous friction, which the simulator integrates implicitly. No stiffness is too large for the step, whatever the
link's inertia; for k -> ∞, D -> J/h, which is the rigid drive's armature.

A joint that has both has one coupling, the gap with both springs in series behind it and no mass between them:

    1/k = 1/k_b + 1/k_e        c = k² (c_b/k_b² + c_e/k_e²)

(what the two dissipate while both carry the torque), and the encoder is where the backlash has it. Two couplings of
which each took the other's torque for that of the motor would bring energy in.

Source: Newmark 1959; Spong 1987 for the flexible joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter, off
from pace_actuators.effects.fading_friction import step_of_constraint
from pace_actuators.effects.registry import register_effect

_SMALLEST_ARMATURE = 1e-6
"""A motor without inertia would have no state [kg m²]."""

_RESOLVED = 0.1
"""Furthest that motor and link move against each other in a step [rad, m]. A link without inertia rings on from step to
step in this scheme, and a gap or a torque that no drive could hold makes it ring louder: beyond this, k h (θ̇₊ - v₊) is
added, which ends it."""

_HARDEST = 1e-4
"""Least R' / A of soft friction, as MuJoCo has it."""

_STIFFNESS = EffectParameter(
    name="stiffness",
    unit="N m/rad",
    lower=80.0,
    upper=2e4,
    null=float("inf"),
    start=1000.0,
    scale="log",
    meaning="k",
    follows_loop=True,
)
_DAMPING = EffectParameter(
    name="damping", unit="N m s/rad", lower=0.0, upper=20.0, null=None, start=0.5, meaning="c", follows_loop=True
)
_SIDE = EffectParameter(
    name="encoder_side",
    unit="1",
    lower=0.0,
    upper=1.0,
    null=None,
    start=0.0,
    meaning="where the encoder sits: 0 on the link, 1 on the motor",
)


class _TwoMass(Effect):
    """What elasticity and backlash share."""

    stage = "transmission"
    is_stiff = True
    structural = "encoder_side"
    two_sided = False
    parts_motor_and_link = True
    reads_load = True
    memory: ClassVar[Mapping[str, float]] = dict.fromkeys(
        ("_angle", "_speed", "_drive", "_coupling", "_direction"), 0.0
    ) | {"_inertia": 1.0}
    _angle: torch.Tensor
    _speed: torch.Tensor
    _drive: torch.Tensor
    _coupling: torch.Tensor
    _direction: torch.Tensor
    _inertia: torch.Tensor
    numerical_damping: ClassVar[float] = 0.05
    """Part of k h below which c does not fall (half of what it says is added there, so that a fit feels it): what is
    too fast for the step dies out, a resonance inside the band does not."""

    def switched_on(self) -> torch.Tensor:
        """Where motor and link are two, (rows, num_joints) bool."""
        raise NotImplementedError

    def spring(self, deflection: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Torque k δ and stiffness k at a deflection."""
        raise NotImplementedError

    def damping_of(self, stiffness: torch.Tensor, s: DriveState) -> torch.Tensor:
        """Damping c of the transmission."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Where it acts."""
        self._on = self.switched_on()
        self._softness, self._loss = self.zeros(), self.zeros()
        self._take_sides()

    def _take_sides(self) -> None:
        self._any, self._all = bool(self._on.any()), bool(self._on.all())
        self._side = torch.where(self._on, self.encoder_side, 0.0)

    def lead(self, other: _TwoMass, num_envs: int) -> None:
        """Take another coupling in, on the joints that have both: it acts no more there, and is a spring in series."""
        n = self._on.shape[1]
        own, given = self._on.new_zeros((num_envs, n)), self._on.new_zeros((num_envs, n))
        own[self.rows], given[other.rows] = self._on, other._on
        both = own & given
        for name, value in (("_softness", 1 / other.stiffness), ("_loss", other.damping / other.stiffness**2)):
            whole = value.new_zeros((num_envs, n))
            whole[other.rows] = value
            setattr(self, name, torch.where(both, whole, 0.0)[self.rows])
        other._on = other._on & ~both[other.rows]
        other._take_sides()

    def rest_deflection(self, s: DriveState) -> torch.Tensor:
        """Deflection that holds the load."""
        raise NotImplementedError

    def armature(self, s: DriveState) -> None:
        """The motor's inertia is not the link's."""
        s.armature = torch.where(self._on, 0.0, s.armature)

    def advance(self, s: DriveState) -> None:
        """The motor's step, now that the link's speed after it is known."""
        if not self._any:
            return
        total = self._inertia + self._coupling
        speed = (self._drive + self._coupling * s.joint_vel) / total
        # friction brakes, it does not push; 0 in direction: the motor stuck
        braked = speed * (speed * self._direction > 0)
        speed = torch.where(s.friction_time > 0, speed, braked) if self.meets_soft_friction else braked
        moving = 0.5 * (self._speed + speed) if self.is_trapezoidal else speed
        self._angle = self._angle + self.dt * moving
        self._speed = speed
        new = self.take_new_rows()
        if new is not None:  # at rest against each other, the spring holding the load
            self._angle = torch.where(new, s.joint_pos + self.rest_deflection(s), self._angle)
            self._speed = torch.where(new, s.joint_vel, self._speed)
        s.motor_pos = torch.where(self._on, self._angle, s.motor_pos)
        s.motor_vel = torch.where(self._on, self._speed, s.motor_vel)

    def hold(self, s: DriveState) -> None:
        """An encoder on the motor shows the motor: the link is beyond the transmission, and both move together."""
        if not self._any:
            return
        s.held_pos -= self._side * (self._angle - s.joint_pos)
        s.held_vel -= self._side * (self._speed - s.joint_vel)
        moves = self._side * s.held
        self._angle = self._angle + moves * (s.held_pos - s.joint_pos)
        self._speed = self._speed + moves * (s.held_vel - s.joint_vel)
        s.motor_pos = torch.where(self._on, self._angle, s.motor_pos)
        s.motor_vel = torch.where(self._on, self._speed, s.motor_vel)

    def measurement(self, s: DriveState) -> None:
        """An encoder on the motor sees the motor; before the first step it is where it will stand at rest."""
        if not self._any:
            return
        twist = self._angle - s.joint_pos
        if self.new_rows is not None:
            twist = torch.where(self.new_rows, self.rest_deflection(s), twist)
        s.encoder_pos += self._side * twist

    def sensed_velocity(self, s: DriveState) -> None:
        """And its speed."""
        if self._any:
            s.encoder_vel += self._side * (self._speed - s.joint_vel)

    def transmission(self, s: DriveState) -> None:
        """Turn the motor's torque into that of the spring."""
        if not self._any:
            return
        h, relative = self.dt, self._speed - s.joint_vel
        torque, k = self.spring(self._angle - s.joint_pos + 0.5 * h * relative)
        torque = torque - k * (0.5 * h * relative)  # looked ahead for contact only
        c = self.damping_of(k, s)
        c = torch.maximum(c, (self.numerical_damping * h) * k + 0.5 * c)
        coupling = 0.25 * h * k + 0.5 * c
        ahead = (0.25 if self.is_trapezoidal else -0.25) * h * k
        explicit = torque + (0.5 * c + ahead) * relative
        coupling = coupling + (h * k) * (h * relative.abs() > _RESOLVED)
        momentum = s.base_armature.clamp(min=_SMALLEST_ARMATURE) / h
        drag = 0.5 * s.viscous_friction
        inertia = momentum + drag + s.implicit_damping
        push = (momentum - drag) * self._speed + s.effort - explicit
        free, level = push + coupling * s.joint_vel, s.friction
        stuck = free.abs() <= level
        direction = torch.sign(free) * ~stuck
        if self.meets_soft_friction:
            soft = s.friction_time > 0
            grip, pull = self._held_softly(s, momentum)
            asked = grip * (free + pull) / (inertia + grip + coupling) - pull
            holds = soft & (asked.abs() < level)
            inertia, push = inertia + torch.where(holds, grip, 0.0), push + torch.where(holds, pull, 0.0)
            level, stuck = torch.where(holds, 0.0, level), stuck & ~soft
            direction = torch.where(soft, torch.sign(asked), direction)
        push = push - level * direction
        total = inertia + coupling
        share = coupling / total * ~stuck
        self._drive, self._coupling, self._inertia, self._direction = push, coupling, inertia, direction
        s.effort = self._where_on(explicit + share * push, s.effort)
        s.implicit_damping = self._where_on(coupling * (1 - share), s.implicit_damping)
        if self._all:
            s.viscous_friction.zero_()
            s.friction.zero_()
        else:
            s.viscous_friction = torch.where(self._on, 0.0, s.viscous_friction)
            s.friction = torch.where(self._on, 0.0, s.friction)

    def _held_softly(self, s: DriveState, momentum: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the motor's soft friction below its level, -grip θ̇₊ + pull: its law (θ̇₊ - θ̇)/h + b' θ̇ + R' f = 0.

        Args:
            s: The drive's state.
            momentum: Motor's inertia by the step [N m s/rad].
        """
        rate, softness = step_of_constraint(s.friction_time, self.dt)
        grip = momentum / softness.clamp(min=_HARDEST)
        return grip, grip * (1 - self.dt * rate) * self._speed

    def _where_on(self, value: torch.Tensor, otherwise: torch.Tensor) -> torch.Tensor:
        return value if self._all else torch.where(self._on, value, otherwise)


@register_effect
class JointElasticity(_TwoMass):
    """Motor and link are joined by a spring and a damper, k and c."""

    name = "joint_elasticity"
    parameters = (_STIFFNESS, _DAMPING, _SIDE)
    equation = "J d²θ/dt² = τ - f - friction, link: + f, f = k (θ - q) + c (dθ/dt - dq/dt)"
    part = "belt, harmonic drive, long shaft"
    looks = "resonance and anti-resonance; the base fit is overdamped with parameters at their bounds"
    source = "Spong 1987, flexible joint"
    probes = tuple({"stiffness": k, "encoder_side": e} for k in (5000.0, 1500.0, 500.0, 200.0) for e in (0.0, 1.0))
    separates = "higher frequencies, and a known added mass"

    def switched_on(self) -> torch.Tensor:
        """Where the stiffness is finite."""
        on = ~off(self.stiffness)
        self._finite = torch.where(on, self.stiffness, 0.0)
        return on

    def spring(self, deflection: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Linear."""
        return self._finite * deflection, self._finite

    def damping_of(self, stiffness: torch.Tensor, s: DriveState) -> torch.Tensor:
        """A parameter."""
        return self.damping

    def rest_deflection(self, s: DriveState) -> torch.Tensor:
        """-τ_g / k."""
        return -s.load_effort / self.stiffness


@register_effect
class Backlash(_TwoMass):
    """Motor and link touch each other only beyond a gap; the contact is stiff."""

    name = "backlash"
    parameters = (
        EffectParameter(name="gap", unit="rad", lower=0.0, upper=0.05, null=0.0, start=0.004),
        replace(_STIFFNESS, lower=300.0, null=None, start=5000.0),
        replace(_DAMPING, start=5.0),
        _SIDE,
    )
    equation = "as joint_elasticity with f = k dz(θ - q, ± gap/2)"
    part = "gear play, loose couplings and screws"
    looks = "loose around zero load, a step at reversals"
    source = "Nordin, Gutman 2002, dead-zone model"
    probes = tuple({"gap": g, "encoder_side": e} for g in (0.002, 0.008, 0.025) for e in (0.0, 1.0))
    separates = "several amplitudes, and a 1.5 times larger proportional gain"
    numerical_damping = 0.3  # a contact shorter than a few steps would push harder on the way out than on the way in

    def switched_on(self) -> torch.Tensor:
        """Where there is a gap."""
        return self.gap > 0

    def spring(self, deflection: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Nothing inside the gap."""
        beyond = (deflection.abs() - 0.5 * self.gap).clamp(min=0.0)
        k = self._stiffness() * (beyond > 0)
        return k * torch.sign(deflection) * beyond, k

    def damping_of(self, stiffness: torch.Tensor, s: DriveState) -> torch.Tensor:
        """Only in contact."""
        return (self.damping / self.stiffness**2 + self._loss) * stiffness**2

    def rest_deflection(self, s: DriveState) -> torch.Tensor:
        """-τ_g / k beyond the gap, on the side that the load presses on."""
        side = -torch.sign(s.load_effort)
        return side * 0.5 * self.gap - s.load_effort / self._stiffness()

    def _stiffness(self) -> torch.Tensor:
        """In contact, with a spring in series where there is one."""
        return self.stiffness / (1 + self.stiffness * self._softness)


def join_couplings(effects: Sequence[Effect], num_envs: int) -> None:
    """Make one coupling of two on a joint: the gap leads.

    Args:
        effects: Of one drive, prepared.
    """
    couplings = [effect for effect in effects if isinstance(effect, _TwoMass)]
    for leading in (effect for effect in couplings if isinstance(effect, Backlash)):
        for other in couplings:
            if not isinstance(other, Backlash):
                leading.lead(other, num_envs)
