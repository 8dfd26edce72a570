"""The parts of an identified drive that another simulator can hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pace_actuators.identified import RIG_EFFECTS, IdentifiedDrives
from pace_actuators.text import listed

if TYPE_CHECKING:
    from pace_actuators.effects.effect import Effect
    from pace_actuators.pace_dc_motor import PaceDCMotor


@dataclass(frozen=True, kw_only=True)
class World:
    """What a simulator offers to drives."""

    name: str
    """What it is called in messages."""

    bodies: bool = True
    """Whether a drive can change the rigid body that its joint moves."""

    soft_friction: bool = True
    """Whether its Coulomb friction is MuJoCo's constraint, whose softness a drive can set."""

    friction_per_step: bool = True
    """Whether a drive can change the joint's friction at every physics step."""

    inertia_per_step: bool = True
    """Whether a drive gets the joint's inertia at every physics step, and can change it."""

    friction_hook: str = ""
    """What the user must add for that, in words; empty if nothing."""


HERE = World(name="the environments of pace_envs")
MJLAB = World(
    name="mjlab",
    bodies=False,
    inertia_per_step=False,
    friction_hook="add events['drive_friction'] = drive_friction_event() of pace_actuators.mjlab to the environment",
)
ISAACLAB = World(
    name="Isaac Lab",
    bodies=False,
    soft_friction=False,
    inertia_per_step=False,
    friction_hook="set ArticulationCfg.class_type to a class of DriveFrictionMixin (pace_actuators.isaaclab) and "
    "isaaclab.assets.Articulation; it copies friction to the CPU at every physics step, which is slow",
)


def check_representable(drives: IdentifiedDrives, world: World = HERE, implicit: bool | None = None) -> list[str]:
    """What a world cannot represent of identified drives, or only with help, in words.

    Args:
        drives: What was identified.
        world: Where it is to be used.
        implicit: Whether a drive's controller runs continuously there; ``None``: as the result says.

    Raises:
        ValueError: If the world has no way to do what an effect needs: to change friction or read the inertia at every
            step, or MuJoCo's friction.
    """
    notes = [] if world.bodies else link_notes(drives)
    if world.friction_hook and (drives.is_continuous if implicit is None else implicit):
        notes.append(
            f"the drive's controller runs continuously (implicit), as friction of each step: {world.friction_hook}."
        )
    for cfg in drives.effects:
        kind = cfg.effect_class
        if note := of_the_recording(kind):
            notes.append(note)
            continue
        if kind.overrides("write_model") and not world.bodies:
            notes.append(
                f"{kind.name} changes the rigid body that a joint moves. In {world.name} a drive cannot do this. Use "
                "the model that pace export --format mjcf --joints_only writes: it has the change."
            )
        if kind.overrides("constraint") and not world.soft_friction:
            raise ValueError(
                f"{kind.name} is MuJoCo's own friction constraint, which {world.name} does not have. Fit again without "
                "it, or train elsewhere."
            )
        if kind.reads_link and not world.inertia_per_step:
            raise ValueError(
                f"{kind.name} depends on the joint's inertia at every physics step, which {world.name} cannot do. "
                "Fit again without it, or train elsewhere."
            )
        if any(kind.overrides(stage) for stage in ("feedback", "friction", "transmission")):
            if not world.friction_per_step:
                raise ValueError(
                    f"{kind.name} acts on the joint at every physics step, which {world.name} cannot do. "
                    "Fit again without it, or train elsewhere."
                )
            if world.friction_hook:
                notes.append(f"{kind.name} acts on the joint at every physics step: {world.friction_hook}.")
    return notes


def of_the_recording(kind: type[Effect]) -> str:
    """Why an effect is left out wherever the drive runs, in words; empty if it is the drive's."""
    if kind.name in RIG_EFFECTS:
        return f"{kind.name} is of what held the robot during the recording: it is left out."
    if kind.stage == "recording":
        return f"{kind.name} is about the recording's time stamps: it has no influence on a policy."
    return ""


def link_notes(drives: IdentifiedDrives) -> list[str]:
    """What becomes of the inertial parameters of links where only drives are written, in words."""
    if not drives.links:
        return []
    return [
        f"the inertial parameters of {listed(list(drives.links))} are of links, not of drives: use the model that "
        "pace export --format mjcf --joints_only writes, which has them."
    ]


def refuse_inertia(motor: PaceDCMotor, world: World) -> None:
    """Refuse a drive that needs the joint's inertia at every step, or MuJoCo's friction, in a simulator without it.

    Raises:
        ValueError: If it does.
    """
    if motor.joint_friction_time is not None and not world.soft_friction:
        raise ValueError(
            f"Soft friction is MuJoCo's own constraint, which {world.name} does not have. Leave it out of the drive's "
            "effects."
        )
    if motor.needs_link and not world.inertia_per_step and motor.effects is not None:
        names = ", ".join(effect.name for effect in motor.effects.effects if effect.reads_link)
        raise ValueError(
            f"{names} depends on the joint's inertia at every physics step, which {world.name} cannot do. "
            "Leave it out of the drive's effects."
        )
