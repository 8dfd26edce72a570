"""Terminations: why an episode ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.indexing import mask_of
from pace_envs.managers.manager_base import ManagerBase, ManagerTermBaseCfg, Number, as_numbers

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclass(kw_only=True)
class TerminationTermCfg(ManagerTermBaseCfg):
    """A termination ``func(env, **params) -> (num_envs,) bool``."""

    time_out: bool = False
    """Whether the end is a truncation (time ran out) and not a failure."""


class TerminationManager(ManagerBase[TerminationTermCfg]):
    """Computes which environments are done, and why."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv):
        """Resolve the terms."""
        super().__init__(cfg, env)
        self.terminated = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self.time_outs = torch.zeros_like(self.terminated)
        self._last = {term.name: torch.zeros_like(self.terminated) for term in self.terms}

    @property
    def dones(self) -> torch.Tensor:
        """Environments whose episode ended, (num_envs,) bool."""
        return self.terminated | self.time_outs

    def get_term(self, name: str) -> torch.Tensor:
        """Which environments a term ended at the last step, (num_envs,) bool."""
        return self._last[name]

    def compute(self) -> torch.Tensor:
        """Evaluate all terms; returns :attr:`dones`."""
        self.terminated = torch.zeros_like(self.terminated)
        self.time_outs = torch.zeros_like(self.time_outs)
        for term in self.terms:
            value = term()
            self._last[term.name] = value
            if term.cfg.time_out:
                self.time_outs |= value
            else:
                self.terminated |= value
        return self.dones

    def reset_where(self, done: torch.Tensor) -> dict[str, torch.Tensor]:
        """:meth:`reset` of environments that are not counted, (num_envs,) bool."""
        if not self._last:
            return {}
        counts = (torch.stack(list(self._last.values())) & done).sum(dim=1)
        return {f"Episode_Termination/{name}": count for name, count in zip(self._last, counts, strict=True)}

    def reset(self, env_ids: torch.Tensor) -> dict[str, Number]:
        """Reset class terms; returns how many of these environments each term ended."""
        super().reset(env_ids)
        return as_numbers(self.reset_where(mask_of(env_ids, self.terminated)))
