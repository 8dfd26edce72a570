"""Event terms: functions ``(env, env_ids, **params)``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch

from pace_envs.managers import SceneEntityCfg, state_only
from pace_envs.quaternions import from_euler, multiply

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv

_ROBOT = SceneEntityCfg()
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@state_only
def reset_joints_by_offset(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    position_range: tuple[float, float],
    velocity_range: tuple[float, float] = (0.0, 0.0),
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Joints start at their defaults plus uniform offsets [rad], [rad/s], inside the soft limits."""
    asset, ids = env.scene[asset_cfg.name], asset_cfg.joint_ids
    position = asset.data.default_joint_pos[env_ids][:, ids]
    velocity = asset.data.default_joint_vel[env_ids][:, ids]
    limits = asset.data.soft_joint_pos_limits[ids]
    position = (position + env.uniform(tuple(position.shape), *position_range)).clamp(limits[:, 0], limits[:, 1])
    velocity = velocity + env.uniform(tuple(velocity.shape), *velocity_range)
    asset.write_joint_state_to_sim(position, velocity, ids, env_ids)


@state_only
def reset_root_state_uniform(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    pose_range: Mapping[str, tuple[float, float]],
    velocity_range: Mapping[str, tuple[float, float]],
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """A floating base starts at its initial state plus uniform offsets: x y z [m], roll pitch yaw [rad]."""
    asset = env.scene[asset_cfg.name]
    init = asset.cfg.init_state
    pose = _draw(env, len(env_ids), pose_range)
    velocity = _draw(env, len(env_ids), velocity_range)
    default = env.constant((*init.pos, *init.rot, *init.lin_vel, *init.ang_vel))
    state = default.repeat(len(env_ids), 1)
    state[:, :3] += pose[:, :3]
    state[:, 3:7] = multiply(state[:, 3:7], from_euler(pose[:, 3:]))
    state[:, 7:] += velocity
    asset.write_root_state_to_sim(state, env_ids)


@state_only
def push_by_setting_velocity(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    velocity_range: Mapping[str, tuple[float, float]],
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Push a floating base: add uniform draws by axis to its velocity [m/s], [rad/s]."""
    data = env.scene[asset_cfg.name].data
    if data.root_lin_vel_w is None or data.root_ang_vel_b is None:
        raise ValueError("This robot's base is fixed: it cannot be pushed. Remove the event or set fix_base=False.")
    change = _draw(env, len(env_ids), velocity_range)
    data.root_lin_vel_w[env_ids] += change[:, :3]
    data.root_ang_vel_b[env_ids] += change[:, 3:]


def _draw(env: ManagerBasedEnv, count: int, ranges: Mapping[str, tuple[float, float]]) -> torch.Tensor:
    unknown = set(ranges) - set(_AXES)
    if unknown:
        raise ValueError(f"Unknown axes {', '.join(sorted(unknown))}. Available: {', '.join(_AXES)}.")
    low, high = zip(*(ranges.get(axis, (0.0, 0.0)) for axis in _AXES), strict=True)
    return env.uniform((count, 6), env.constant(low), env.constant(high))
