"""Termination terms: functions returning (num_envs,) bool."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_envs.managers import SceneEntityCfg

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
