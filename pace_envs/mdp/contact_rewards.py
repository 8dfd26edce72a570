"""Reward terms on contacts: functions returning (num_envs,)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv


def feet_air_time(
    env: ManagerBasedRLEnv, sensor_name: str, command_name: str, threshold: float, min_command: float = 0.1
) -> torch.Tensor:
    """Long steps: at each landing, the time in the air beyond ``threshold`` [s]; 0 when the command is to stand still.

    Standing still is a planar velocity command below ``min_command`` [m/s]. As in Isaac Lab.
    """
    sensor = env.scene.sensors[sensor_name]
    reward = ((sensor.last_air_time - threshold) * sensor.first_contact).sum(dim=1)
    return reward * (env.command_manager.get_command(command_name)[:, :2].norm(dim=1) > min_command)


def undesired_contacts(env: ManagerBasedRLEnv, sensor_names: tuple[str, ...]) -> torch.Tensor:
    """Number of geoms that touch something."""
    return sum(env.scene.sensors[name].in_contact.sum(dim=1) for name in sensor_names).to(env.dtype)  # type: ignore[union-attr]


def feet_slide(env: ManagerBasedRLEnv, sensor_name: str) -> torch.Tensor:
    """Sum of the horizontal speeds of the feet that touch the ground [m/s]; the sensor tracks velocities."""
    sensor = env.scene.sensors[sensor_name]
    return (sensor.lin_vel_w[..., :2].norm(dim=2) * sensor.in_contact).sum(dim=1)
