"""Observation terms: functions returning (num_envs, dim)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_envs.managers import SceneEntityCfg
from pace_envs.robot_state import of_floating_base

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv

_ROBOT = SceneEntityCfg()


def joint_pos(env: ManagerBasedEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint positions [rad]."""
    return env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids]


def joint_pos_rel(env: ManagerBasedEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint positions relative to the defaults [rad]."""
    data = env.scene[asset_cfg.name].data
    return (data.joint_pos - data.default_joint_pos)[:, asset_cfg.joint_ids]


def encoder_pos_rel(env: ManagerBasedEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """What the drives' encoders show relative to the defaults, q - bias - q_default without effects [rad]."""
    robot = env.scene[asset_cfg.name]
    position = robot.sensed_joint_pos() - robot.data.default_joint_pos
    for actuator in robot.actuators.values():
        position[:, actuator.joint_indices] -= actuator.encoder_bias
    return position[:, asset_cfg.joint_ids]


def joint_vel(env: ManagerBasedEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint velocities [rad/s]."""
    return env.scene[asset_cfg.name].data.joint_vel[:, asset_cfg.joint_ids]


def last_action(env: ManagerBasedEnv) -> torch.Tensor:
    """The last action."""
    return env.action_manager.action


def generated_commands(env: ManagerBasedRLEnv, command_name: str) -> torch.Tensor:
    """The present command of a command term."""
    return env.command_manager.get_command(command_name)


def base_lin_vel(env: ManagerBasedEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Linear velocity of the base in its frame [m/s]."""
    return env.scene[asset_cfg.name].data.root_lin_vel_b


def base_ang_vel(env: ManagerBasedEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Angular velocity of the base in its frame [rad/s]."""
    return of_floating_base(env.scene[asset_cfg.name].data.root_ang_vel_b)


def projected_gravity(env: ManagerBasedEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Direction of gravity in the base's frame."""
    return env.scene[asset_cfg.name].data.projected_gravity_b
