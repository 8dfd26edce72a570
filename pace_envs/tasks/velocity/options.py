"""What can be changed in a velocity task, one function each."""

from __future__ import annotations

from collections.abc import Mapping

from pace_actuators import PaceDCMotorCfg
from pace_envs import mdp
from pace_envs.managers import EventTermCfg, SceneEntityCfg
from pace_envs.tasks.velocity.velocity_env_cfg import COMMAND, VelocityEnvCfg

_BASE = 1
"""The model's first body after the world."""


def set_drives(cfg: VelocityEnvCfg, drives: Mapping[str, PaceDCMotorCfg]) -> None:
    """Put other drives into the robot, such as identified ones."""
    cfg.scene.robot.actuators = dict(drives)


def add_randomization(
    cfg: VelocityEnvCfg,
    *,
    friction_range: tuple[float, float] = (0.4, 1.0),
    mass_range: tuple[float, float] = (-1.0, 2.0),
    push_speed: float = 0.5,
    push_interval_s: tuple[float, float] = (8.0, 12.0),
) -> None:
    """Train over many grounds and loads, with pushes.

    Args:
        mass_range: Mass that is added to the base [kg].
        push_speed: Largest change of the base's velocity by a push, forward and sideways [m/s].
        push_interval_s: Time between pushes [s].
    """
    push = (-push_speed, push_speed)
    cfg.events = {
        **cfg.events,
        "friction": EventTermCfg(
            func=mdp.randomize_friction,
            mode="startup",
            params={"sensor_name": "feet", "friction_range": friction_range},
        ),
        "mass": EventTermCfg(
            func=mdp.randomize_body_mass,
            mode="startup",
            params={"asset_cfg": SceneEntityCfg(body_ids=[_BASE]), "mass_range": mass_range},
        ),
        "push": EventTermCfg(
            func=mdp.push_by_setting_velocity,
            mode="interval",
            interval_range_s=push_interval_s,
            params={"velocity_range": {"x": push, "y": push}},
        ),
    }


def fix_command(cfg: VelocityEnvCfg, command: tuple[float, float, float]) -> None:
    """Give all robots one command: forward [m/s], left [m/s], yaw rate [rad/s]."""
    x, y, yaw = command
    cfg.commands = {
        COMMAND: mdp.UniformVelocityCommandCfg(
            lin_vel_x=(x, x), lin_vel_y=(y, y), ang_vel_z=(yaw, yaw), rel_standing_envs=0.0
        )
    }
