"""Termination terms: functions returning (num_envs,) bool."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from pace_envs.managers import SceneEntityCfg
from pace_envs.robot_state import of_floating_base

if TYPE_CHECKING:
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv

_ROBOT = SceneEntityCfg()


def time_out(env: ManagerBasedRLEnv) -> torch.Tensor:
    """The episode has reached its longest length."""
    return env.episode_length_buf >= env.max_episode_length


def joint_pos_out_of_limit(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """A joint has left its soft limits."""
    data, ids = env.scene[asset_cfg.name].data, asset_cfg.joint_ids
    limits, position = data.soft_joint_pos_limits[ids], data.joint_pos[:, ids]
    return ((position < limits[:, 0]) | (position > limits[:, 1])).any(dim=1)


def bad_orientation(env: ManagerBasedRLEnv, limit_angle: float, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """The base is tilted by more than ``limit_angle`` [rad] from upright."""
    return env.scene[asset_cfg.name].data.projected_gravity_b[:, 2] > -math.cos(limit_angle)


def root_height_below_minimum(
    env: ManagerBasedRLEnv, minimum_height: float, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """The base is lower than ``minimum_height`` [m]."""
    return of_floating_base(env.scene[asset_cfg.name].data.root_pos_w)[:, 2] < minimum_height


def illegal_contact(env: ManagerBasedRLEnv, sensor_name: str) -> torch.Tensor:
    """A geom of a contact sensor touches something."""
    return env.scene.sensors[sensor_name].in_contact.any(dim=1)


def diverged(env: ManagerBasedRLEnv, max_speed: float = 1e3) -> torch.Tensor:
    """The simulation has blown up: a speed is not finite or above ``max_speed`` [m/s], [rad/s]."""
    return ~(env.sim.qvel.abs() <= max_speed).all(dim=1)
