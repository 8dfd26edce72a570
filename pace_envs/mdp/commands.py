"""Command terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from pace_envs.managers import CommandTerm, CommandTermCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


class UniformVelocityCommand(CommandTerm):
    """Velocity of the base in its own frame: forward [m/s], left [m/s], yaw rate [rad/s].

    Attributes:
        scale: Part of the ranges that is drawn from, 0 to 1; a curriculum can change it.
    """

    cfg: UniformVelocityCommandCfg

    def __init__(self, cfg: UniformVelocityCommandCfg, env: ManagerBasedEnv):
        """Start with zero commands."""
        super().__init__(cfg, env)
        self.scale = 1.0
        self._command = torch.zeros(env.num_envs, 3, dtype=env.dtype, device=env.device)
        ranges = env.sim.tensor([cfg.lin_vel_x, cfg.lin_vel_y, cfg.ang_vel_z])
        self._low, self._high = ranges[:, 0], ranges[:, 1]
        self._errors = torch.zeros(env.num_envs, 3, dtype=env.dtype, device=env.device)  # planar, yaw, steps

    @property
    def command(self) -> torch.Tensor:
        """The present command, (num_envs, 3)."""
        return self._command

    def reset(self, env_ids: torch.Tensor) -> dict[str, float]:
        """Draw new commands; returns the mean errors of the episodes that ended [m/s], [rad/s]."""
        super().reset(env_ids)
        planar, yaw, steps = self._errors[env_ids].sum(dim=0).tolist()
        self._errors[env_ids] = 0.0
        return {"error_vel_xy": planar / steps, "error_vel_yaw": yaw / steps} if steps else {}

    def _update_metrics(self) -> None:
        data = self._env.scene["robot"].data
        if data.root_ang_vel_b is None:
            return
        planar = (data.root_lin_vel_b[:, :2] - self._command[:, :2]).norm(dim=1)
        yaw = (data.root_ang_vel_b[:, 2] - self._command[:, 2]).abs()
        self._errors += torch.stack([planar, yaw, torch.ones_like(yaw)], dim=1)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        drawn = self._env.uniform((len(env_ids), 3), self._low, self._high) * self.scale
        standing = self._env.uniform((len(env_ids), 1)) < self.cfg.rel_standing_envs
        self._command[env_ids] = drawn.masked_fill(standing, 0.0)


@dataclass(kw_only=True)
class UniformVelocityCommandCfg(CommandTermCfg):
    """Configuration of :class:`UniformVelocityCommand`."""

    class_type: type[CommandTerm] = UniformVelocityCommand
    """The term's class."""

    lin_vel_x: tuple[float, float] = (-1.0, 1.0)
    """Forward velocity [m/s]."""

    lin_vel_y: tuple[float, float] = (-1.0, 1.0)
    """Velocity to the left [m/s]."""

    ang_vel_z: tuple[float, float] = (-1.0, 1.0)
    """Yaw rate [rad/s]."""

    rel_standing_envs: float = 0.02
    """Part of the environments that are told to stand still, 0 to 1."""
