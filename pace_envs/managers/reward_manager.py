"""Rewards: a weighted sum of terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.indexing import mask_of
from pace_envs.managers.manager_base import ManagerBase, ManagerTermBaseCfg, Number, as_numbers

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclass(kw_only=True)
class RewardTermCfg(ManagerTermBaseCfg):
    """A reward ``func(env, **params) -> (num_envs,)`` per second."""

    weight: float
    """Factor of the term; 0 switches it off."""


class RewardManager(ManagerBase[RewardTermCfg]):
    """Sums weight * term * dt and keeps each term's sum over the episode."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv):
        """Resolve the terms."""
        super().__init__(cfg, env)
        self._reward = torch.zeros(env.num_envs, dtype=env.dtype, device=env.device)
        self._totals = torch.zeros(len(self.terms), env.num_envs, dtype=env.dtype, device=env.device)
        self._sums = {term.name: total for term, total in zip(self.terms, self._totals, strict=True)}
        self._max_episode_length_s = getattr(env, "max_episode_length_s", 1.0)

    @property
    def episode_sums(self) -> dict[str, torch.Tensor]:
        """What each term has earned in the present episodes, weighted, (num_envs,)."""
        return self._sums

    @property
    def constants(self) -> tuple[float, ...]:
        """Numbers that a captured step repeats: the weights."""
        return tuple(term.cfg.weight for term in self.terms)

    def get_term_cfg(self, name: str) -> RewardTermCfg:
        """The configuration of a term; its weight can be changed."""
        if name not in self._sums:
            raise KeyError(f"There is no reward {name!r}. Available: {', '.join(self._sums) or 'none'}.")
        return next(term.cfg for term in self.terms if term.name == name)

    def compute(self, dt: float) -> torch.Tensor:
        """The reward of this step, (num_envs,)."""
        self._reward.zero_()
        for term in self.terms:
            weight = term.cfg.weight
            if weight != 0.0:
                value = term() * (weight * dt)
                self._reward += value
                self._sums[term.name] += value
        return self._reward.clone()

    def reset_where(self, done: torch.Tensor) -> dict[str, torch.Tensor]:
        """:meth:`reset` of environments that are not counted, (num_envs,) bool; NaN if none is masked."""
        if not self.terms:
            return {}
        mean = torch.where(done, self._totals, 0.0).sum(dim=1) / (done.sum() * self._max_episode_length_s)
        self._totals.masked_fill_(done, 0.0)
        return {f"Episode_Reward/{name}": value for name, value in zip(self._sums, mean, strict=True)}

    def reset(self, env_ids: torch.Tensor) -> dict[str, Number]:
        """Clear the sums of some environments; returns each term's mean per second of a full episode."""
        super().reset(env_ids)
        return as_numbers(self.reset_where(mask_of(env_ids, self._reward)))
