"""Observations: groups of terms, concatenated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.managers.manager_base import ManagerBase, ManagerTermBaseCfg, Term, term_items

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclass(kw_only=True)
class UniformNoiseCfg:
    """Additive noise, uniform between two values."""

    n_min: float = -1.0
    """Smallest value, in the term's unit."""
    n_max: float = 1.0
    """Largest value, in the term's unit."""


@dataclass(kw_only=True)
class ObservationTermCfg(ManagerTermBaseCfg):
    """An observation ``func(env, **params) -> (num_envs, dim)``."""

    noise: UniformNoiseCfg | None = None
    """Noise, added where the group is corrupted."""

    clip: tuple[float, float] | None = None
    """Limits, applied after the noise."""

    scale: float | None = None
    """Factor, applied last."""


@dataclass(kw_only=True)
class ObservationGroupCfg:
    """A named group of terms, concatenated in order."""

    terms: Mapping[str, ObservationTermCfg]
    """The terms."""

    enable_corruption: bool = False
    """Whether noise is added."""


class ObservationManager(ManagerBase[ObservationTermCfg]):
    """Computes every group: a dict of name to tensor (num_envs, dim), float32."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv):
        """Resolve the terms and find the size of each group."""
        self._env = env
        self._groups: dict[str, tuple[ObservationGroupCfg, list[Term[ObservationTermCfg]]]] = {
            name: (group, [Term(key, term, env) for key, term in term_items(group.terms).items()])
            for name, group in term_items(cfg).items()
        }
        self.terms = [term for _, terms in self._groups.values() for term in terms]
        self.group_obs_dim = {name: tuple(obs.shape[1:]) for name, obs in self.compute().items()}

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the terms by group."""
        return {name: [term.name for term in terms] for name, (_, terms) in self._groups.items()}

    @property
    def constants(self) -> tuple[bool, ...]:
        """Flags that a captured step repeats: whether noise is added, by group."""
        return tuple(group.enable_corruption for group, _ in self._groups.values())

    def group_terms(self, name: str) -> dict[str, tuple[ObservationTermCfg, int]]:
        """Configuration and size of the terms of a group, in order."""
        return {term.name: (term.cfg, term().shape[1]) for term in self._groups[name][1]}

    def compute(self) -> dict[str, torch.Tensor]:
        """All groups."""
        return {name: self.compute_group(name) for name in self._groups}

    def compute_group(self, name: str) -> torch.Tensor:
        """One group, (num_envs, dim), float32."""
        group, terms = self._groups[name]
        return torch.cat([self._compute_term(term, group.enable_corruption) for term in terms], dim=1).float()

    def _compute_term(self, term: Term[ObservationTermCfg], corrupt: bool) -> torch.Tensor:
        cfg, value = term.cfg, term()
        if corrupt and cfg.noise is not None:
            value = value + self._env.uniform(tuple(value.shape), cfg.noise.n_min, cfg.noise.n_max)
        if cfg.clip is not None:
            value = value.clamp(*cfg.clip)
        return value if cfg.scale is None else value * cfg.scale
