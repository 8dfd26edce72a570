"""A :class:`ManagerBasedRLEnv` as rsl-rl's ``VecEnv``, with the names and semantics of Isaac Lab's wrapper."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from pace_envs.manager_based_rl_env import ManagerBasedRLEnv, ManagerBasedRLEnvCfg


class RslRlVecEnvWrapper(VecEnv):
    """Observations as ``TensorDict``, rewards and dones for rsl-rl, time-outs and episode logs in the extras.

    The observation groups of the environment are the keys; float64 becomes float32 here.
    """

    def __init__(self, env: ManagerBasedRLEnv | gym.Env, clip_actions: float | None = None):
        """Wrap an environment and reset it.

        Args:
            env: The environment, or what ``gym.make`` returned.
            clip_actions: Actions are clipped to plus and minus this.
        """
        if not isinstance(env.unwrapped, ManagerBasedRLEnv):
            raise ValueError(f"The environment is a {type(env.unwrapped).__name__}, expected a ManagerBasedRLEnv.")
        self.env = env
        self.clip_actions = clip_actions
        self.num_envs = self.unwrapped.num_envs
        self.device = self.unwrapped.device
        self.max_episode_length = self.unwrapped.max_episode_length
        self.num_actions = self.unwrapped.action_manager.total_action_dim
        self.unwrapped.reset()

    @property
    def unwrapped(self) -> ManagerBasedRLEnv:
        """The environment."""
        return self.env.unwrapped  # type: ignore[return-value]

    @property
    def cfg(self) -> ManagerBasedRLEnvCfg:  # type: ignore[override]
        """Its configuration."""
        return self.unwrapped.cfg

    @property
    def render_mode(self) -> str | None:
        """Its render mode."""
        return self.unwrapped.render_mode

    @property
    def observation_space(self) -> gym.Space:
        """Its space of observations."""
        return self.unwrapped.observation_space

    @property
    def action_space(self) -> gym.Space:
        """Its space of actions."""
        return self.unwrapped.action_space

    @property
    def episode_length_buf(self) -> torch.Tensor:  # type: ignore[override]
        """Length of the present episodes [steps], (num_envs,); can be set."""
        return self.unwrapped.episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.unwrapped.episode_length_buf.copy_(value)

    def seed(self, seed: int = -1) -> int:
        """Seed the environment's random draws; -1 draws a seed."""
        return self.unwrapped.seed(None if seed == -1 else seed)

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Reset all environments."""
        obs, extras = self.unwrapped.reset()
        return self._pack(obs), extras

    def get_observations(self) -> TensorDict:
        """The present observations."""
        return self._pack(self.unwrapped.observation_manager.compute())

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance all environments; those that are done start anew.

        Args:
            actions: (num_envs, num_actions).

        Returns:
            Observations; rewards (num_envs,) float32; dones (num_envs,) long; extras with ``"time_outs"``
            (num_envs,) bool, and ``"log"`` where episodes ended.
        """
        if self.clip_actions is not None:
            actions = actions.clamp(-self.clip_actions, self.clip_actions)
        obs, reward, terminated, truncated, extras = self.unwrapped.step(actions)
        extras["time_outs"] = truncated
        # a simulation that blew up ends its episode, and its reward is no number
        return self._pack(obs), reward.float().nan_to_num(0.0), (terminated | truncated).long(), extras

    def close(self) -> None:
        """Release the simulations."""
        self.env.close()

    def _pack(self, obs: dict[str, torch.Tensor]) -> TensorDict:
        return TensorDict(obs, batch_size=[self.num_envs])
