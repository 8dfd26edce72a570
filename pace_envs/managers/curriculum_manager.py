"""Curriculum: the task grows with what the policy can do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.managers.manager_base import ManagerBase, ManagerTermBaseCfg, Number

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclass(kw_only=True)
class CurriculumTermCfg(ManagerTermBaseCfg):
    """A curriculum ``func(env, env_ids, **params) -> number | dict of numbers | None``, which is logged."""


class CurriculumManager(ManagerBase[CurriculumTermCfg]):
    """Runs its terms for the environments whose episode ended, before they are reset."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv):
        """Resolve the terms."""
        super().__init__(cfg, env, num_args=2)
        self._env = env
        self._state: dict[str, Any] = {term.name: None for term in self.terms}

    def compute(self, env_ids: torch.Tensor) -> None:
        """Let the terms judge the episodes of these environments."""
        for term in self.terms:
            self._state[term.name] = term(env_ids)

    @property
    def takes_masks(self) -> bool:
        """Whether all terms have a ``where(env, done, **params)`` beside what they do with indices."""
        return all(hasattr(term.func, "where") and not term.keeps_state for term in self.terms)

    def compute_where(self, done: torch.Tensor) -> dict[str, torch.Tensor]:
        """:meth:`compute` and :meth:`reset` of environments that are not counted, (num_envs,) bool."""
        return {f"Curriculum/{term.name}": term.func.where(self._env, done, **term.params) for term in self.terms}  # type: ignore[attr-defined]

    def reset(self, env_ids: torch.Tensor) -> dict[str, Number]:
        """Reset class terms; returns what the terms said last, as ``Curriculum/<term>``."""
        log: dict[str, Number] = {}
        for name, state in self._state.items():
            items = state.items() if isinstance(state, Mapping) else [] if state is None else [("", state)]
            log |= {f"Curriculum/{name}{key and '/' + key}": float(value) for key, value in items}
        super().reset(env_ids)
        return log
