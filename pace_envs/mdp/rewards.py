"""Reward terms: functions returning (num_envs,)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_envs.managers import SceneEntityCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv

_ROBOT = SceneEntityCfg()


def is_alive(env: ManagerBasedRLEnv) -> torch.Tensor:
    """1 where the episode goes on."""
    return (~env.termination_manager.terminated).double()


def joint_torques_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared joint torques [N^2 m^2]."""
    return env.scene[asset_cfg.name].data.applied_torque[:, asset_cfg.joint_ids].square().sum(dim=1)


def action_rate_l2(env: ManagerBasedRLEnv) -> torch.Tensor:
    """Sum of squared changes of the action."""
    return (env.action_manager.action - env.action_manager.prev_action).square().sum(dim=1)
