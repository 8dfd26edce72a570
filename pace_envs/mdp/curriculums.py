"""Curriculum terms: ``(env, env_ids, **params)``, called for environments whose episode ended."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_envs.indexing import mask_of
from pace_envs.managers import ManagerTermBase, ManagerTermBaseCfg
from pace_envs.mdp.commands import UniformVelocityCommand

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv


class command_range_by_tracking(ManagerTermBase):
    """Widens the ranges of a velocity command as it is tracked.

    Episodes are judged together, a quarter of ``num_envs`` at a time: if a reward term earned on average more than
    ``threshold`` of what it can earn in a full episode, the command's scale grows by ``growth``, up to 1.
    """

    def __init__(self, cfg: ManagerTermBaseCfg, env: ManagerBasedEnv):
        """Start at ``start`` of the command's ranges."""
        super().__init__(cfg, env)
        command = env.command_manager.get_term(cfg.params["command_name"])  # type: ignore[attr-defined]
        if not isinstance(command, UniformVelocityCommand):
            raise ValueError(f"The command {cfg.params['command_name']!r} is no UniformVelocityCommand.")
        self._command = command
        self._command.scale = float(cfg.params.get("start", 0.5))
        self._window = max(env.num_envs // 4, 1)
        self._earned = torch.zeros((), dtype=env.dtype, device=env.device)
        self._ended = torch.zeros((), dtype=env.dtype, device=env.device)

    def __call__(  # type: ignore[override]
        self,
        env: ManagerBasedRLEnv,
        env_ids: torch.Tensor,
        command_name: str,
        reward_name: str,
        start: float = 0.5,
        growth: float = 0.1,
        threshold: float = 0.7,
    ) -> torch.Tensor:
        """Judge the episodes that ended; returns the part of the ranges that is drawn from."""
        done = mask_of(env_ids, env.episode_length_buf)
        return self.where(env, done, command_name, reward_name, start, growth, threshold)

    def where(
        self,
        env: ManagerBasedRLEnv,
        done: torch.Tensor,
        command_name: str,
        reward_name: str,
        start: float = 0.5,
        growth: float = 0.1,
        threshold: float = 0.7,
    ) -> torch.Tensor:
        """The same of environments that are not counted, (num_envs,) bool, without waiting for the GPU."""
        full = env.reward_manager.get_term_cfg(reward_name).weight * env.max_episode_length_s
        scale = self._command.scale_tensor
        self._earned += torch.where(done, env.reward_manager.episode_sums[reward_name], 0.0).sum() / full
        self._ended += done.sum()
        enough = self._ended >= self._window
        good = enough & (self._earned > threshold * self._ended)
        scale.copy_(torch.where(good, (scale + growth).clamp(max=1.0), scale))
        self._earned.masked_fill_(enough, 0.0)
        self._ended.masked_fill_(enough, 0.0)
        return scale.clone()
