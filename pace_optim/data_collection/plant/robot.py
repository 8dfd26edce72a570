"""What the plant needs to know of a robot: its model file, its joints and its drives."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pace_envs import load_env_cfg
from pace_envs.model_file import read_model_file
from pace_envs.tasks.pace import PaceCfg

_REFERENCE_EFFORT = 89.0  # effort limit of the drive that the effects' sizes were chosen for [N m]
_NO_STALL = 1e9  # stall torque of a drive without a torque-speed line [N m]
DRIVE_FIELDS = ("stiffness", "damping", "effort_limit", "saturation_effort", "velocity_limit")


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantRobot:
    """A robot on a fixed base, joints in the order of the identification."""

    name: str
    """Its name."""
    mjcf_path: Path
    """Model file."""
    joint_names: tuple[str, ...]
    """The hinges, in order."""
    base_pos: tuple[float, float, float]
    """Where the base is held [m]."""
    drive: Mapping[str, np.ndarray]
    """Gains and limits, {field: (n,)}."""
    pace: PaceCfg
    """The identification's configuration (motion and sample parameters are read from it)."""
    control_dt: float
    """Time between two control instants [s]."""

    @property
    def num_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def torque_scale(self) -> float:
        """Strength of the drives: 1 for an effort limit of 89 N m."""
        limit = self.drive["effort_limit"]
        finite = limit[np.isfinite(limit)]
        return float(np.median(finite)) / _REFERENCE_EFFORT if finite.size else 1.0

    def spec(self) -> mujoco.MjSpec:
        """The model with its base fixed, without joint friction, damping, armature, contacts or actuators."""
        spec = read_model_file(self.mjcf_path).spec
        for joint in list(spec.joints):
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                joint.parent.pos = self.base_pos
                spec.delete(joint)
        for joint in spec.joints:
            if joint.type != mujoco.mjtJoint.mjJNT_HINGE:
                raise ValueError(f"{self.name}: the joint {joint.name!r} is no hinge; the plant simulates hinges only.")
        for key in list(spec.keys):  # it has the size of the model with its actuators
            spec.delete(key)
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        off = mujoco.mjtDisableBit
        spec.option.disableflags |= off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT
        return spec


def plant_robot(task: str, control_dt: float | None = None) -> PlantRobot:
    """The robot of an identification task.

    Args:
        task: As for :func:`pace_envs.load_env_cfg`.
        control_dt: Time between two commands [s], of a model file.
    """
    cfg = load_env_cfg(task, control_dt)
    pace = getattr(cfg, "sim2real", None)
    if pace is None:
        raise ValueError(f"{task} is not an identification task: it has no PaceCfg. Choose a Pace-<Robot>-v0.")
    robot = cfg.scene.robot
    names = tuple(pace.joint_order)
    drive = {field: np.full(len(names), np.inf) for field in DRIVE_FIELDS}
    for actuator in robot.actuators.values():
        patterns = actuator.joint_names_expr
        patterns = [patterns] if isinstance(patterns, str) else list(patterns)
        members = [i for i, name in enumerate(names) if any(re.fullmatch(p, name) for p in patterns)]
        for field in DRIVE_FIELDS:
            for i in members:
                drive[field][i] = _value_of(getattr(actuator, field), names[i], members.index(i))
    wanted = np.isfinite(drive["stiffness"]) & np.isfinite(drive["damping"])
    if not wanted.all():
        missing = [name for name, fine in zip(names, wanted, strict=True) if not fine]
        raise ValueError(f"{task}: no gains for {', '.join(missing)}. Give the joints an actuator with gains.")
    no_curve = ~np.isfinite(drive["saturation_effort"])  # a stall torque beyond all others, no fall with speed
    drive["saturation_effort"][no_curve] = _NO_STALL
    drive["velocity_limit"][no_curve] = np.inf
    return PlantRobot(
        name=pace.robot_name,
        mjcf_path=Path(robot.mjcf_path),
        joint_names=names,
        base_pos=tuple(robot.init_state.pos),
        drive=drive,
        pace=pace,
        control_dt=cfg.sim.dt * cfg.decimation,
    )


def _value_of(value: Any, joint: str, position: int) -> float:
    """A configuration's value for one joint: a number, {regular expression: number}, or a list."""
    if value is None:
        return np.inf
    if isinstance(value, Mapping):
        return next((float(v) for pattern, v in value.items() if re.fullmatch(pattern, joint)), np.inf)
    if isinstance(value, (int, float)):
        return float(value)
    return float(value[position])
