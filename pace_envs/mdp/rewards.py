"""Reward terms on joints, actions and the base's motion, as in Isaac Lab: functions returning (num_envs,)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_actuators import JointValue, resolve_joint_values
from pace_envs.managers import ManagerTermBase, ManagerTermBaseCfg, SceneEntityCfg
from pace_envs.robot_state import of_floating_base

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv


_ROBOT = SceneEntityCfg()


def is_alive(env: ManagerBasedRLEnv) -> torch.Tensor:
    """1 where the episode goes on."""
    return (~env.termination_manager.terminated).to(env.dtype)


def joint_torques_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared joint torques [N^2 m^2]."""
    return env.scene[asset_cfg.name].data.applied_torque[:, asset_cfg.joint_ids].square().sum(dim=1)


def action_rate_l2(env: ManagerBasedRLEnv) -> torch.Tensor:
    """Sum of squared changes of the action."""
    return (env.action_manager.action - env.action_manager.prev_action).square().sum(dim=1)


class joint_acc_l2(ManagerTermBase):
    """Sum of squared joint accelerations at the last physics step [rad^2/s^4]."""

    def __init__(self, cfg: ManagerTermBaseCfg, env: ManagerBasedEnv):
        """Bind the simulation's accelerations."""
        super().__init__(cfg, env)
        self._qacc = env.sim.bind("qacc")

    def __call__(  # type: ignore[override]
        self, env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = _ROBOT
    ) -> torch.Tensor:
        """The sum, (num_envs,)."""
        columns = env.scene[asset_cfg.name].dof_columns[asset_cfg.joint_ids]
        return self._qacc.index_select(1, columns).square().sum(dim=1)


def track_lin_vel_xy_exp(
    env: ManagerBasedRLEnv, std: float, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-|v_xy - v*_xy|^2 / std^2) of the base's velocity in its frame; ``std`` in m/s."""
    velocity = env.scene[asset_cfg.name].data.root_lin_vel_b[:, :2]
    error = (velocity - env.command_manager.get_command(command_name)[:, :2]).square().sum(dim=1)
    return torch.exp(-error / std**2)


def track_ang_vel_z_exp(
    env: ManagerBasedRLEnv, std: float, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-(w_z - w*_z)^2 / std^2) of the yaw rate; ``std`` in rad/s."""
    rate = of_floating_base(env.scene[asset_cfg.name].data.root_ang_vel_b)[:, 2]
    return torch.exp(-(rate - env.command_manager.get_command(command_name)[:, 2]).square() / std**2)


def lin_vel_z_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Squared velocity of the base along its z axis [m^2/s^2]."""
    return env.scene[asset_cfg.name].data.root_lin_vel_b[:, 2].square()


def ang_vel_xy_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Squared roll and pitch rates of the base [rad^2/s^2]."""
    return of_floating_base(env.scene[asset_cfg.name].data.root_ang_vel_b)[:, :2].square().sum(dim=1)


def flat_orientation_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Squared sine of the base's tilt."""
    return env.scene[asset_cfg.name].data.projected_gravity_b[:, :2].square().sum(dim=1)


def track_velocity_exp(env: ManagerBasedRLEnv, std: float, command_name: str) -> torch.Tensor:
    """Both tracking terms as one, 2/3 of the planar and 1/3 of the yaw term; at most 1."""
    planar = track_lin_vel_xy_exp(env, std, command_name)
    return (2.0 * planar + track_ang_vel_z_exp(env, std, command_name)) / 3.0


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


def motor_power(
    torque: torch.Tensor, velocity: torch.Tensor, copper_loss: torch.Tensor, regeneration: float = 1.0
) -> torch.Tensor:
    """Electrical power of permanent-magnet motors, Bjelonic, Tischhauser and Hutter, arXiv 2509.06342.

    With winding resistance R [ohm], gear ratio r and torque constant k [N m/A], the current is τ / (r k), so that

        P_el = Σ_joints τ² R / (r² k²) + τ q̇,

    heat in the windings and mechanical power; a braking joint feeds the others or the battery (regeneration).

    Args:
        torque: τ at the joints [N m], (num_envs, num_joints).
        velocity: q̇ [rad/s], (num_envs, num_joints).
        copper_loss: R / (r² k²) of each joint [W/(N m)²], (num_joints,).
        regeneration: Part of negative mechanical power that comes back, 0 to 1.

    Returns:
        P_el [W], (num_envs,).
    """
    mechanical = torque * velocity
    if regeneration != 1.0:
        mechanical = mechanical.clamp(min=0.0) + regeneration * mechanical.clamp(max=0.0)
    return (mechanical + copper_loss * torque.square()).sum(dim=1)


class electrical_power(ManagerTermBase):
    """:func:`motor_power` of a robot's drives at the last physics step [W]."""

    def __init__(self, cfg: ManagerTermBaseCfg, env: ManagerBasedEnv):
        """Resolve the joints' constants."""
        super().__init__(cfg, env)
        value = cfg.params.get("copper_loss", 0.0)
        self._copper_loss = env.sim.tensor(
            resolve_joint_values(value, env.scene["robot"].joint_names, field="copper_loss")
        )

    def __call__(  # type: ignore[override]
        self, env: ManagerBasedRLEnv, copper_loss: JointValue, regeneration: float = 1.0
    ) -> torch.Tensor:
        """P_el [W], (num_envs,).

        Args:
            copper_loss: R / (r² k²) [W/(N m)²], a number or by expression of joints.
            regeneration: Part of negative mechanical power that comes back, 0 to 1.
        """
        data = env.scene["robot"].data
        return motor_power(data.applied_torque, data.joint_vel, self._copper_loss, regeneration)
