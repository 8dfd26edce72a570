"""Configuration of a robot: model file, initial state, drives."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from pace_actuators import JointValue, PaceDCMotorCfg
from pace_actuators.config import Config
from pace_actuators.drive_result import LinkInertia


@dataclass(kw_only=True)
class InitialStateCfg(Config):
    """State after a reset."""

    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the base in the world [m]."""

    rot: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation of the base (w, x, y, z)."""

    lin_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Linear velocity of a floating base in the world [m/s]."""

    ang_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Angular velocity of a floating base in its own frame [rad/s]."""

    joint_pos: JointValue = 0.0
    """Joint positions [rad]; joints without a value start at 0."""

    joint_vel: JointValue = 0.0
    """Joint velocities [rad/s]; joints without a value start at 0."""


_State = InitialStateCfg


@dataclass(kw_only=True)
class ArticulationCfg(Config):
    """A robot."""

    InitialStateCfg: ClassVar[type[_State]] = _State
    """As Isaac Lab has it."""

    elsewhere: ClassVar = {
        "prim_path": "MuJoCo has no stage. Leave it out.",
        "spawn": "write mjcf_path='robot.xml', the robot's MJCF file. pace new-robot makes one of a URDF.",
    }

    mjcf_path: str | Path
    """MJCF file. Its actuators are not used: the drives below take their place."""

    init_state: _State = field(default_factory=_State)
    """State after a reset."""

    actuators: Mapping[str, PaceDCMotorCfg] = field(default_factory=dict)
    """Groups of joints by name of the group; each joint belongs to one group at most."""

    joint_order: tuple[str, ...] | None = None
    """Order of the joints in every tensor, and which of them are used; ``None`` means the model's order."""

    assumed_gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Stiffness and damping by joint that a model file does not state and that were assumed. If the drives still have
    them, identified drives replace them by the recordings'."""

    couplings: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Motors that move several joints, ``{motor: {joint: ratio}}``: a motor's position is Σ ratio q_joint, and its
    torque acts on each of these joints by its ratio. ``joint_order`` and the drives name motors in place of their
    joints. Motors that are fixed tendons of the model file need no entry. A joint in place of a motor: its drive pulls
    joints that follow it too."""

    fix_base: bool | None = None
    """Whether the base is held in place or floats; ``None``: as in the file."""

    held_joints: Mapping[str, float] = field(default_factory=dict)
    """Joints of the model that do not move, and where they are held [rad, of slides m]: they are taken out of it."""

    links: Mapping[str, LinkInertia] = field(default_factory=dict)
    """Inertial parameters of links by name, in place of the file's: those that were identified."""

    soft_joint_pos_limit_factor: float = 1.0
    """Part of the joint range that counts as the soft limit, 0 to 1."""
