"""The batched environment as Gymnasium's ``VectorEnv``, numpy at the edge."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from pace_envs.manager_based_rl_env import ManagerBasedRLEnv


class PaceVectorEnv(gym.vector.VectorEnv):
    """The same object for Gymnasium's vector wrappers; observations are the group ``"policy"``."""

    def __init__(self, env: ManagerBasedRLEnv):
        """Wrap an environment."""
        self.env = env
        env.final_observations = True
        self.num_envs = env.num_envs
        self.metadata = env.metadata
        self.render_mode = env.render_mode
        self.single_observation_space = env.single_observation_space["policy"]
        self.single_action_space = env.single_action_space
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """How ``gym.make_vec`` built it."""
        return self.env.spec

    @property
    def unwrapped(self) -> ManagerBasedRLEnv:  # type: ignore[override]
        """The batched environment."""
        return self.env

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Reset all environments; ``options={"reset_mask": mask}`` resets some of them."""
        mask = (options or {}).get("reset_mask")
        obs, _ = self.env.reset(seed=seed, env_ids=None if mask is None else np.flatnonzero(mask))
        return obs["policy"].cpu().numpy(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Advance all environments; those that are done start anew in the same step."""
        obs, reward, terminated, truncated, extras = self.env.step(self.env.sim.tensor(actions))
        infos: dict[str, Any] = {}
        if "final_obs" in extras:
            done = extras["_final_obs"].cpu().numpy()
            # an array of numbers, not of objects: NumpyToTorch can convert it
            last = extras["final_obs"]["policy"].cpu().numpy()
            infos = {"final_obs": last, "_final_obs": done, "final_info": {}, "_final_info": done}
        seen = (value.cpu().numpy() for value in (obs["policy"], reward, terminated, truncated))
        return *seen, infos  # type: ignore[return-value]

    def render(self) -> tuple[np.ndarray | None, ...]:  # type: ignore[override]
        """A picture of environment 0."""
        return (self.env.render(),)

    def close_extras(self, **kwargs: Any) -> None:
        """Release the simulations."""
        self.env.close()
