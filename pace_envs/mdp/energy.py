"""Electrical power of the drives, for rewards and for the cost of transport."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_actuators import JointValue, resolve_joint_values
from pace_envs.managers import ManagerTermBase, ManagerTermBaseCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv


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
