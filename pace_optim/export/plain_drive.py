"""The part of an identified drive that a simulator's PD actuator and its joint can hold, joint by joint."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from pace_actuators import IdentifiedDrives
from pace_actuators.effects import Effect
from pace_actuators.effects.fading_friction import SoftFriction, solver_parameters, step_of_constraint
from pace_actuators.joint_values import resolve_joint_values
from pace_actuators.representable import of_the_recording
from pace_optim.export.configs import drive_groups, extra_notes

GAIN_EFFECTS = ("proportional_gain", "derivative_gain", "torque_gain", "torque_limit", "torque_speed_limit")
"""Effects that are other gains and limits of the same drive."""
JOINT_EFFECTS = {
    "parallel_spring": ("stiffness", "rest"),
    "torque_offset": ("effort",),
    "quadratic_friction": ("coefficient",),
}
"""Effects that are torques on the joint beside the drive's, and their parameters."""


@dataclass(frozen=True, kw_only=True)
class PlainDrive:
    """PD control with a DC motor's limits, and torques beside it.

    τ = clip(kp (q* - q + bias) - kd q̇, limits) - k (q - q₀) + τ₀ - b₂ q̇ |q̇|
    """

    stiffness: float
    """kp [N m/rad], with the effects that scale it."""

    damping: float
    """kd [N m s/rad], with the effects that scale it."""

    effort_limit: float
    """Largest torque [N m], with the effects that change it; ``inf`` without a limit."""

    saturation_effort: float
    """Stall torque of the torque-speed line [N m]; ``inf`` without a line."""

    velocity_limit: float
    """No-load speed of the torque-speed line [rad/s]; ``inf`` without a line."""

    encoder_bias: float
    """The encoder shows q - bias [rad]."""

    delay_s: float
    """Delay of the command [s]; 0 where the whole torque is delayed, which such an actuator cannot do."""

    run_dt: float = 0.0
    """Time over which the drive's controller holds its torque [s]; 0 for one that runs continuously."""

    second_order: bool = False
    """Whether it was identified with steps of second order."""

    spring: float = 0.0
    """k [N m/rad]."""

    rest: float = 0.0
    """q₀, true as q is [rad]."""

    offset: float = 0.0
    """τ₀ [N m]."""

    quadratic: float = 0.0
    """b₂ ≥ 0 [N m s²/rad²]."""

    def for_steps_of(self, dt: float, viscous: float) -> tuple[PlainDrive, float]:
        """The same in a simulator that evaluates it at every step and updates speeds before positions.

        There a speed is half a step h old when a position is new, and viscous friction d acts on a speed of h / 2
        later. A torque that is held for T is in the mean that of q - v T / 2 + a T² / 6 and v - a T / 2. So

            kd' = kd - kp T / 2        armature' = armature + kp T² / 6 - kd T / 2 + (kd' - d) h / 2

        but where a limit meets it. What would be below 0 is 0.

        Args:
            dt: h [s].
            viscous: d [N m s/rad].

        Returns:
            The drive, and what is to be added to the armature [kg m²].
        """
        damping = max(0.0, self.damping - 0.5 * self.stiffness * self.run_dt)
        held = self.stiffness * self.run_dt**2 / 6 - 0.5 * self.damping * self.run_dt
        return replace(self, damping=damping), held + 0.5 * (damping - viscous) * dt

    @property
    def has_line(self) -> bool:
        """Whether torque falls with speed."""
        return math.isfinite(self.saturation_effort) and math.isfinite(self.velocity_limit)


def plain_drives(drives: IdentifiedDrives) -> tuple[dict[str, PlainDrive], list[str]]:
    """The drive of each joint as far as a plain actuator holds it, and what it does not hold, in words.

    Gains and limits are those that were in force in all recordings, otherwise those of the robot's configuration. A
    bias that the recordings do not determine is left out.
    """
    result: dict[str, PlainDrive] = {}
    own = {name: _of_effect(drives, name) for name in GAIN_EFFECTS}
    line_effort = _of_effect(drives, "torque_speed_limit", "effort")
    beside = {name: [_of_effect(drives, name, each) for each in each_of] for name, each_of in JOINT_EFFECTS.items()}
    commands = drives.delay_mode == "command"
    for cfg in drive_groups(drives).values():
        joints = drives.find_joints(cfg.joint_names_expr)
        found = {
            name: [default] * len(joints)
            if (value := getattr(cfg, name)) is None
            else resolve_joint_values(value, joints, field=name).tolist()
            for name, default in (
                ("stiffness", 0.0),
                ("damping", 0.0),
                ("effort_limit", math.inf),
                ("saturation_effort", math.inf),
                ("velocity_limit", math.inf),
                ("encoder_bias", 0.0),
            )
        }
        exact = cfg.centred_commands or cfg.second_order  # the other simulator's commands act half a step early
        early = 0.5 * drives.at.physics_dt if exact else 0.0
        for i, joint in enumerate(joints):
            gain = own["torque_gain"].get(joint, 1.0)
            speed, stall = own["torque_speed_limit"].get(joint, math.inf), line_effort.get(joint, math.inf)
            if math.isfinite(speed) and math.isfinite(stall):
                found["velocity_limit"][i], found["saturation_effort"][i] = speed, stall
            line = math.isfinite(found["saturation_effort"][i]) and math.isfinite(found["velocity_limit"][i])
            (spring, rest), (offset,), (quadratic,) = (
                [values.get(joint, 0.0) for values in beside[name]] for name in JOINT_EFFECTS
            )
            result[joint] = PlainDrive(
                stiffness=found["stiffness"][i] * own["proportional_gain"].get(joint, 1.0) * gain,
                damping=found["damping"][i] * own["derivative_gain"].get(joint, 1.0) * gain,
                effort_limit=min(found["effort_limit"][i], own["torque_limit"].get(joint, math.inf)) * gain,
                saturation_effort=found["saturation_effort"][i] if line else math.inf,
                velocity_limit=found["velocity_limit"][i] if line else math.inf,
                encoder_bias=found["encoder_bias"][i] if drives.determined("encoder_bias", [joint]) else 0.0,
                delay_s=drives.delay_s + early if commands else 0.0,
                run_dt=0.0 if cfg.implicit else cfg.drive_dt or drives.at.control_dt,
                second_order=cfg.second_order,
                spring=spring,
                rest=rest,
                offset=offset,
                quadratic=max(0.0, quadratic),
            )
    notes = []
    if not commands and drives.delay_s > 0:
        notes.append(
            f"delay of {1e3 * drives.delay_s:.3g} ms of the controller's torque, feedback included: omitted; such an "
            "actuator delays commands, which is another physics."
        )
    return {joint: result[joint] for joint in drives.joint_names if joint in result}, notes


_IN_PLAIN_STEPS = (
    "kd, delay and armature differ from the identified ones: they compensate for MuJoCo's steps of first order "
    "and for torques that the drive holds. In such a step the speed is half a step older than the position."
)


def in_plain_steps(
    drives: IdentifiedDrives, plain: Mapping[str, PlainDrive]
) -> tuple[dict[str, PlainDrive], dict[str, float], list[str]]:
    """Drives, armatures and a note, for a simulator that runs each drive at every step of the identification.

    A drive that ran continuously acts there within the step, as viscous friction does, unless it has a torque-speed
    line. An armature that the recordings do not determine is left out.
    """
    found, armatures, least, dt = dict(plain), {}, [], drives.at.physics_dt
    for joint, drive in plain.items():
        more = 0.0
        if drive.second_order:
            viscous = drives.determined("viscous_friction", [joint]).get(joint, 0.0)
            if drive.run_dt or drive.has_line:
                found[joint], more = drive.for_steps_of(dt, viscous)
            else:
                more = -0.5 * (drive.damping + viscous) * dt
        for armature in drives.determined("armature", [joint]).values():
            armatures[joint] = max(0.0, armature + more)
            if armature + more < 0 or drive.damping > 0 == found[joint].damping:
                least.append(joint)
    return found, armatures, plain_step_notes(plain, least)


def plain_step_notes(plain: Mapping[str, PlainDrive], least: Sequence[str]) -> list[str]:
    """What changes where drives act in steps of first order.

    Args:
        plain: The drives.
        least: Those whose armature or kd would be below 0.
    """
    notes = [_IN_PLAIN_STEPS] if any(drive.second_order for drive in plain.values()) else []
    if least:
        notes.append(f"armature or kd of {', '.join(least)} would be below 0: it is 0, and the motion differs.")
    return notes


def soft_frictions(
    drives: IdentifiedDrives, weights: Mapping[str, float] | None = None, late: Mapping[str, float] | None = None
) -> dict[str, tuple[float, float]]:
    """Time constant [s] and impedance of MuJoCo's friction constraint, of joints whose friction is soft.

    They are for the identification's step: MuJoCo's constraint takes a speed half a step older than the fit's.

    Args:
        drives: What was identified.
        weights: By what MuJoCo scales the friction of each joint, as a multiple of the identification's.
        late: What damping adds to the inertia of each joint in a step, as a part of it: the constraint knows of none.
    """
    result = {}
    for joint, time in _of_effect(drives, SoftFriction.name).items():
        if time > 0:
            rate, softness = step_of_constraint(torch.tensor(time, dtype=torch.float64), drives.at.physics_dt)
            more = 1 + (late or {}).get(joint, 0.0)
            own = solver_parameters(more * rate, more * softness / (weights or {}).get(joint, 1.0))
            result[joint] = float(own[0]), float(own[1])
    return result


def effect_notes(drives: IdentifiedDrives, held: Sequence[str]) -> list[str]:
    """Which effects are held and which are not, and which parameters are of the task alone, in words.

    Args:
        held: Names of the effects that the format holds.
    """
    notes = []
    for kind in (cfg.effect_class for cfg in drives.effects):
        if note := of_the_recording(kind):
            notes.append(note)
        elif kind.name in held:
            notes.append(f"{kind.name}: in the file.")
        else:
            notes.append(
                f"{kind.name} ({_what(kind)}): omitted. The robot moves differently without it. PaceDCMotor has it, in "
                "any simulator (--format mjcf --joints_only)."
            )
    return [*notes, *extra_notes(drives)]


def joint_values(drives: IdentifiedDrives, joint: str, names: Mapping[str, str]) -> dict[str, float]:
    """A joint's parameters that the recordings determine: others kept their priors, and are not exported.

    Args:
        names: What a format calls them, by parameter.
    """
    found = {name: drives.determined(parameter, [joint]) for parameter, name in names.items()}
    return {name: values[joint] for name, values in found.items() if values}


def _of_effect(drives: IdentifiedDrives, name: str, parameter: str = "") -> dict[str, float]:
    """An effect's parameter on the joints that have it, the first where none is named."""
    for cfg in drives.effects:
        if cfg.effect_class.name == name:
            parameter = parameter or cfg.effect_class.parameters[0].name
            return drives.values(f"{name}.{parameter}", cfg.joints(drives.joint_names))
    return {}


def _what(kind: type[Effect]) -> str:
    return kind.equation or (kind.__doc__ or "").strip().splitlines()[0]


def whole_steps_note(drives: IdentifiedDrives, plain: Mapping[str, PlainDrive]) -> list[str]:
    """What becomes of the delay in a simulator that delays by whole steps; empty without a delay."""
    dt, delay = drives.at.physics_dt, max((drive.delay_s for drive in plain.values()), default=0.0)
    if not delay:
        return []
    steps = delay / dt
    lost = "" if abs(steps - round(steps)) < 1e-6 else f", {1e3 * round(steps) * dt:.3g} ms"
    return [f"delay of {1e3 * delay:.3g} ms: {round(steps)} whole steps of {1e3 * dt:g} ms{lost}."]
