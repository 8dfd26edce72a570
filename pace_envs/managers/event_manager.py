"""Events: changes at startup, at resets and at intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch

from pace_envs.managers.manager_base import ManagerTermBaseCfg, Term, term_items

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclass(kw_only=True)
class EventTermCfg(ManagerTermBaseCfg):
    """An event ``func(env, env_ids, **params)``."""

    mode: Literal["startup", "reset", "interval"]
    """When it happens."""

    interval_range_s: tuple[float, float] | None = None
    """Time between two events of an environment [s]; for mode ``"interval"``."""


class EventManager:
    """Runs events, mode by mode, in the order in which they were given."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv):
        """Resolve the terms."""
        self._env = env
        self._terms: dict[str, list[Term[EventTermCfg]]] = {"startup": [], "reset": [], "interval": []}
        self._time_left: list[torch.Tensor] = []
        for name, term_cfg in term_items(cfg).items():
            if term_cfg.mode not in self._terms:
                raise ValueError(f"The event {name!r} has mode {term_cfg.mode!r}. Available: {', '.join(self._terms)}.")
            if term_cfg.mode == "interval":
                if term_cfg.interval_range_s is None:
                    raise ValueError(f"The interval event {name!r} needs interval_range_s = (min, max) in seconds.")
                self._time_left.append(env.uniform((env.num_envs,), *term_cfg.interval_range_s))
            self._terms[term_cfg.mode].append(Term(name, term_cfg, env, num_args=2))

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the events by mode."""
        return {mode: [term.name for term in terms] for mode, terms in self._terms.items() if terms}

    def apply(self, mode: str, env_ids: torch.Tensor | None = None, dt: float | None = None) -> None:
        """Run the events of a mode on all or some environments; ``dt`` [s] for intervals."""
        if mode == "interval":
            for term, time_left in zip(self._terms[mode], self._time_left, strict=True):
                time_left -= dt or 0.0
                if self._env.masks_resets and term.changes_state_only:
                    self._apply_where(term, time_left, time_left <= 0.0)
                    continue
                due = (time_left <= 0.0).nonzero()[:, 0]
                if len(due):
                    self._draw_time(term, time_left, due)
                    term(due)
            return
        ids = torch.arange(self._env.num_envs, device=self._env.device) if env_ids is None else env_ids
        for term in self._terms[mode]:
            term(ids)

    @property
    def terms(self) -> list[Term[EventTermCfg]]:
        """The events of resets and intervals."""
        return [*self._terms["reset"], *self._terms["interval"]]

    @property
    def takes_masks(self) -> bool:
        """Whether :meth:`reset_where` does what :meth:`apply` and :meth:`reset` do at a reset."""
        every = [term for terms in self._terms.values() for term in terms]
        return all(t.changes_state_only for t in self._terms["reset"]) and not any(t.keeps_state for t in every)

    def reset_where(self, done: torch.Tensor) -> None:
        """Start the intervals of environments anew that are not counted, (num_envs,) bool."""
        for term, time_left in zip(self._terms["interval"], self._time_left, strict=True):
            self._draw_time_where(term, time_left, done)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Reset class terms, and start the intervals of these environments anew."""
        for terms in self._terms.values():
            for term in terms:
                term.reset(env_ids)
        for term, time_left in zip(self._terms["interval"], self._time_left, strict=True):
            self._draw_time(term, time_left, env_ids)

    def _apply_where(self, term: Term[EventTermCfg], time_left: torch.Tensor, due: torch.Tensor) -> None:
        self._draw_time_where(term, time_left, due)
        with self._env.scene.only_where(due):
            term(torch.arange(self._env.num_envs, device=self._env.device))

    def _draw_time_where(self, term: Term[EventTermCfg], time_left: torch.Tensor, mask: torch.Tensor) -> None:
        drawn = self._env.uniform(tuple(time_left.shape), *(term.cfg.interval_range_s or (0.0, 0.0)))
        torch.where(mask, drawn, time_left, out=time_left)

    def _draw_time(self, term: Term[EventTermCfg], time_left: torch.Tensor, env_ids: torch.Tensor) -> None:
        low, high = term.cfg.interval_range_s or (0.0, 0.0)
        time_left[env_ids] = self._env.uniform((len(env_ids),), low, high)
