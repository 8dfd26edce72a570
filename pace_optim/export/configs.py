"""Configurations of identified drives as Python, ready to paste."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from pace_actuators import IdentifiedAt, IdentifiedDrives, PaceDCMotorCfg
from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.effects import EffectCfg
from pace_actuators.identified import DRIVE_FIELDS, RATE_FLAGS
from pace_actuators.representable import HERE, ISAACLAB, MJLAB, World, check_representable, link_notes
from pace_envs.generated_python import Call, Word, python_page
from pace_envs.identified import load_identified_cfg
from pace_envs.link_inertia import NAMES
from pace_envs.tasks.pace import TORQUE_OFFSET, TORQUE_SCALE

_DELAY = (
    "The delay is in seconds: the drive converts it to its own control steps. At another physics step than "
    "{dt:g} ms the values are less exact."
)


def drive_groups(drives: IdentifiedDrives) -> dict[str, PaceDCMotorCfg]:
    """The identified drives in the groups of the identification's robot, with gains and limits as far as known."""
    cfg = load_identified_cfg(drives)
    result = {}
    for group, drive in cfg.scene.robot.actuators.items():
        patterns = [drive.joint_names_expr] if isinstance(drive.joint_names_expr, str) else drive.joint_names_expr
        own = [joint for joint in drives.joint_names if any(re.fullmatch(p, joint) for p in patterns)]
        if own:
            kept = (*(name for name in DRIVE_FIELDS if name not in drives.drive), "drive_dt", *RATE_FLAGS)
            configured = {name: getattr(drive, name) for name in kept}
            found = drives.cfg_fields([re.escape(joint) for joint in own])
            result[group] = PaceDCMotorCfg(**configured | found | {"joint_names_expr": drive.joint_names_expr})
    return result


def cfg_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """``PaceDCMotorCfg``s for the environments of this project."""
    return _page(drives, drive_groups(drives), HERE, _CFG, {})


def mjlab_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """An articulation of mjlab."""
    template, groups = _MJLAB, drive_groups(drives)
    if _changes_friction(drives, groups):
        template = template.replace(_MJLAB_IMPORT, f"{_MJLAB_IMPORT}, drive_friction_event") + _MJLAB_EVENTS
    return _page(drives, groups, MJLAB, template, {})


def isaaclab_python(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """Actuators of an Isaac Lab articulation."""
    return _page(drives, drive_groups(drives), ISAACLAB, _ISAACLAB, {"physics_dt": Word("PHYSICS_DT")})


_CFG = '''\
_ABOUT_

from pace_actuators import EffectCfg, IdentifiedAt, PaceDCMotorCfg

ACTUATORS = _MOTORS_
"""For ArticulationCfg(actuators=ACTUATORS), or set_drives(cfg, ACTUATORS) of pace_envs.tasks.velocity."""
'''

_MJLAB_IMPORT = "from pace_actuators.mjlab import PaceDCMotorActuatorCfg"
_MJLAB = f'''\
_ABOUT_

from mjlab.entity import EntityArticulationInfoCfg

from pace_actuators import EffectCfg, IdentifiedAt, PaceDCMotorCfg
{_MJLAB_IMPORT}

MOTORS = _MOTORS_
ARTICULATION = EntityArticulationInfoCfg(
    actuators=tuple(PaceDCMotorActuatorCfg(motor=motor) for motor in MOTORS.values())
)
"""For EntityCfg(articulation=ARTICULATION); the encoder bias is written to entity.data.encoder_bias."""
'''
_MJLAB_EVENTS = '''\
EVENTS = {"drive_friction": drive_friction_event()}
"""Add to the environment's events: friction changes at every physics step."""
'''

_ISAACLAB = '''\
_ABOUT_

from pace_actuators import EffectCfg, IdentifiedAt, PaceDCMotorCfg
from pace_actuators.isaaclab import PaceDCMotorActuatorCfg

PHYSICS_DT = _PHYSICS_DT_  # your simulation's dt [s]
MOTORS = _MOTORS_
ACTUATORS = {name: PaceDCMotorActuatorCfg(motor=motor) for name, motor in MOTORS.items()}
"""For ArticulationCfg(actuators=ACTUATORS); observe encoder_pos_rel of pace_actuators.isaaclab."""
'''


def _page(
    drives: IdentifiedDrives,
    groups: Mapping[str, PaceDCMotorCfg],
    world: World,
    template: str,
    extra: Mapping[str, Any],
) -> tuple[str, list[str]]:
    notes = check_representable(drives, world, _is_continuous(groups))
    notes = [_DELAY.format(dt=1e3 * drives.at.physics_dt), *notes]
    notes += [*(link_notes(drives) if world is HERE else []), *extra_notes(drives)]
    motors = {group: _call(cfg, extra) for group, cfg in groups.items()}
    values = {"_ABOUT_": about(drives, "", notes), "_MOTORS_": motors, "_PHYSICS_DT_": drives.at.physics_dt}
    return python_page(template, values), notes


def about(drives: IdentifiedDrives, where: str, notes: Sequence[str]) -> str:
    """A page's docstring: of which fit it is, for what, and what it does not hold."""
    return "\n".join([f"Drives identified with {drives.task}{where}: {drives.path.parent.name}.", "", *notes, ""])


def extra_parameters(drives: IdentifiedDrives) -> list[str]:
    """Names of the parameters that the task itself adds (``PaceCfg.extra_parameters``)."""
    of_effects = {f"{e.effect_class.name}.{p.name}" for e in drives.effects for p in e.effect_class.parameters}
    known = {*BASE_PARAMETERS, *of_effects, *NAMES, TORQUE_SCALE, TORQUE_OFFSET}
    return [name for name in drives.parameters if name not in known]


def extra_notes(drives: IdentifiedDrives) -> list[str]:
    """That no drive has those parameters, in words."""
    return [
        f"{name} is an extra parameter of the task: omitted. The robot moves differently without it. Its values are in "
        "result.json; write them as the task's apply does."
        for name in extra_parameters(drives)
    ]


def _changes_friction(drives: IdentifiedDrives, groups: Mapping[str, PaceDCMotorCfg]) -> bool:
    kinds = [effect.effect_class for effect in drives.effects]
    stages = ("feedback", "friction", "transmission")
    return _is_continuous(groups) or any(kind.overrides(stage) for kind in kinds for stage in stages)


def _is_continuous(groups: Mapping[str, PaceDCMotorCfg]) -> bool:
    """Whether a drive's controller runs continuously, by the result or by the robot's configuration."""
    return any(cfg.implicit for cfg in groups.values())


def _call(cfg: PaceDCMotorCfg, extra: Mapping[str, Any]) -> Call:
    """A constructor call; defaults are left out."""
    default = PaceDCMotorCfg(joint_names_expr="")
    values = {f.name: getattr(cfg, f.name) for f in fields(cfg)}
    changed = {name: _value(value) for name, value in values.items() if value != getattr(default, name)}
    return Call(name="PaceDCMotorCfg", values={**changed, **extra})


def _value(value: Any) -> Any:
    if isinstance(value, IdentifiedAt):
        return Call(name="IdentifiedAt", values={"control_dt": value.control_dt, "physics_dt": value.physics_dt})
    if isinstance(value, EffectCfg):
        names = ("effect", "joint_names_expr", "shared", "values")
        return Call(name="EffectCfg", values={name: _value(getattr(value, name)) for name in names})
    if isinstance(value, Mapping):
        return {key: _value(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return tuple(map(_value, value))
    return digits(value) if isinstance(value, float) else value


def digits(value: float) -> float:
    """A number as a page shows it, in ten digits."""
    return float(f"{value:.10g}")
