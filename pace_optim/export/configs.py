"""Configurations of identified drives as Python, ready to paste."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from pace_actuators import IdentifiedAt, IdentifiedDrives, PaceDCMotorCfg
from pace_actuators.effects import EffectCfg
from pace_actuators.identified import DRIVE_FIELDS, RATE_FLAGS
from pace_actuators.representable import HERE, ISAACLAB, MJLAB, World, check_representable
from pace_envs.identified import load_identified_cfg

_DELAY = (
    "The delay is in seconds: the drive converts it to its own control steps. At another physics step than "
    "{dt:g} ms the values are less exact."
)


def drive_groups(drives: IdentifiedDrives) -> dict[str, PaceDCMotorCfg]:
    """The identified drives in the groups of the identification's robot, with gains and limits as far as known.

    Raises:
        ValueError: If the environment of the identification is not registered.
    """
    cfg = load_identified_cfg(drives)
    result = {}
    for group, drive in cfg.scene.robot.actuators.items():
        patterns = [drive.joint_names_expr] if isinstance(drive.joint_names_expr, str) else drive.joint_names_expr
        own = [joint for joint in drives.joint_names if any(re.fullmatch(p, joint) for p in patterns)]
        if own:
            kept = (*(name for name in DRIVE_FIELDS if name not in drives.drive), "drive_dt", *RATE_FLAGS)
            configured = {name: getattr(drive, name) for name in kept}
            found = drives.cfg_fields([re.escape(joint) for joint in own])
            result[group] = PaceDCMotorCfg(**configured | {"joint_names_expr": drive.joint_names_expr} | found)
            result[group] = replace(result[group], joint_names_expr=drive.joint_names_expr)
    return result


def cfg_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """``PaceDCMotorCfg``s for the environments of this project."""
    body = [
        "from pace_actuators import IdentifiedAt, PaceDCMotorCfg",
        "from pace_actuators.effects import EffectCfg",
        "",
        f"ACTUATORS = {_groups(drives)}",
        '"""For ArticulationCfg(actuators=ACTUATORS), or set_drives(cfg, ACTUATORS) of pace_envs.tasks.velocity."""',
    ]
    return _page(drives, HERE, body)


def mjlab_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """An articulation of mjlab."""
    events = _changes_friction(drives)
    body = [
        "from mjlab.entity import EntityArticulationInfoCfg",
        "",
        "from pace_actuators import IdentifiedAt, PaceDCMotorCfg",
        "from pace_actuators.effects import EffectCfg",
        f"from pace_actuators.mjlab import PaceDCMotorActuatorCfg{', drive_friction_event' if events else ''}",
        "",
        f"MOTORS = {_groups(drives)}",
        "ARTICULATION = EntityArticulationInfoCfg(",
        "    actuators=tuple(PaceDCMotorActuatorCfg(motor=motor) for motor in MOTORS.values())",
        ")",
        '"""For EntityCfg(articulation=ARTICULATION); the encoder bias is written to entity.data.encoder_bias."""',
    ]
    if events:
        body += [
            'EVENTS = {"drive_friction": drive_friction_event()}',
            '"""Add to the environment\'s events: friction changes at every physics step."""',
        ]
    return _page(drives, MJLAB, body)


def isaaclab_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """Actuators of an Isaac Lab articulation."""
    body = [
        "from pace_actuators import IdentifiedAt, PaceDCMotorCfg",
        "from pace_actuators.effects import EffectCfg",
        "from pace_actuators.isaaclab import PaceDCMotorActuatorCfg",
        "",
        f"PHYSICS_DT = {drives.at.physics_dt!r}  # your simulation's dt [s]",
        f"MOTORS = {_groups(drives, physics_dt='PHYSICS_DT')}",
        "ACTUATORS = {name: PaceDCMotorActuatorCfg(motor=motor) for name, motor in MOTORS.items()}",
        '"""For ArticulationCfg(actuators=ACTUATORS); observe encoder_pos_rel of pace_actuators.isaaclab."""',
    ]
    return _page(drives, ISAACLAB, body)


def _page(drives: IdentifiedDrives, world: World, body: list[str]) -> tuple[str, list[str]]:
    notes = [_DELAY.format(dt=1e3 * drives.at.physics_dt), *check_representable(drives, world)]
    if world.friction_hook and _is_implicit(drives):
        notes.append(
            f"the drive's controller runs continuously (implicit), as friction of each step: {world.friction_hook}."
        )
    head = [f'"""Drives identified with {drives.task}: {drives.path.parent.name}.', "", *notes, '"""', ""]
    return "\n".join([*head, *body]) + "\n", notes


def _is_implicit(drives: IdentifiedDrives) -> bool:
    return any(cfg.implicit for cfg in drive_groups(drives).values())


def _changes_friction(drives: IdentifiedDrives) -> bool:
    kinds = [effect.effect_class for effect in drives.effects]
    stages = ("feedback", "friction", "transmission")
    return _is_implicit(drives) or any(kind.overrides(stage) for kind in kinds for stage in stages)


def _groups(drives: IdentifiedDrives, **extra: str) -> str:
    groups = drive_groups(drives)
    items = [f"    {name!r}: {_source(cfg, extra)}," for name, cfg in groups.items()]
    return "\n".join(["{", *items, "}"])


def _source(cfg: PaceDCMotorCfg, extra: dict[str, str]) -> str:
    """A constructor call; defaults are left out."""
    default = PaceDCMotorCfg(joint_names_expr="")
    values = {f.name: getattr(cfg, f.name) for f in fields(cfg)}
    changed = {name: _literal(value) for name, value in values.items() if value != getattr(default, name)}
    lines = [f"        {name}={text}," for name, text in (changed | extra).items()]
    return "\n".join(["PaceDCMotorCfg(", *lines, "    )"])


def _literal(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.10g}" if math.isfinite(value) else f'float("{value}")'
    if isinstance(value, IdentifiedAt):
        return f"IdentifiedAt(control_dt={value.control_dt!r}, physics_dt={value.physics_dt!r})"
    if isinstance(value, EffectCfg):
        fixed = f"effect={value.effect!r}, joint_names_expr={_literal(value.joint_names_expr)}"
        return f"EffectCfg({fixed}, shared={value.shared!r}, values={_literal(value.values)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key!r}: {_literal(each)}" for key, each in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "(" + "".join(f"{_literal(each)}, " for each in value).rstrip() + ")"
    return repr(value)
