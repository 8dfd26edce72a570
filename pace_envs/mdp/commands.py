"""Command terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from pace_envs.managers import CommandTerm, CommandTermCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


class UniformVelocityCommand(CommandTerm):
    """Velocity of the base in its own frame: forward [m/s], left [m/s], yaw rate [rad/s]."""

    cfg: UniformVelocityCommandCfg

    def __init__(self, cfg: UniformVelocityCommandCfg, env: ManagerBasedEnv):
        """Start with zero commands."""
        super().__init__(cfg, env)
        self._scale = torch.ones((), dtype=env.dtype, device=env.device)
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

    @property
    def scale(self) -> float:
        """Part of the ranges that is drawn from, 0 to 1; a curriculum can change it."""
        return float(self._scale)

    @scale.setter
    def scale(self, value: float) -> None:
        self._scale.fill_(value)

    @property
    def scale_tensor(self) -> torch.Tensor:
        """:attr:`scale` where the tensors are, without dimensions, so that nothing waits for it."""
        return self._scale

    @property
    def takes_masks(self) -> bool:
        """It does."""
        return True

    def reset_where(self, done: torch.Tensor) -> dict[str, torch.Tensor]:
        """Draw new commands; returns the mean errors of the episodes that ended [m/s], [rad/s]."""
        super().reset_where(done)
        total = torch.where(done[:, None], self._errors, 0.0).sum(dim=0)
        self._errors.masked_fill_(done[:, None], 0.0)
        return {"error_vel_xy": total[0] / total[2], "error_vel_yaw": total[1] / total[2]}

    def _update_metrics(self) -> None:
        data = self._env.scene["robot"].data
        if data.root_ang_vel_b is None:
            return
        planar = (data.root_lin_vel_b[:, :2] - self._command[:, :2]).norm(dim=1)
        yaw = (data.root_ang_vel_b[:, 2] - self._command[:, 2]).abs()
        self._errors += torch.stack([planar, yaw, torch.ones_like(yaw)], dim=1)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        self._command[env_ids] = self._drawn(len(env_ids))

    def _resample_command_where(self, mask: torch.Tensor) -> None:
        torch.where(mask[:, None], self._drawn(len(mask)), self._command, out=self._command)

    def _drawn(self, count: int) -> torch.Tensor:
        drawn = self._env.uniform((count, 3), self._low, self._high) * self._scale
        standing = self._env.uniform((count, 1)) < self.cfg.rel_standing_envs
        return drawn.masked_fill(standing, 0.0)


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
    """Part of the environments whose command is to stand still, 0 to 1."""
