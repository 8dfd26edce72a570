"""Actions: the policy's numbers become targets of joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.indexing import checked_values
from pace_envs.managers.manager_base import ClassTerms

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclass(kw_only=True)
class ActionTermCfg:
    """Configuration of an action term."""

    class_type: type[ActionTerm]
    """The term's class."""

    asset_name: str = "robot"
    """Name of the entity that it moves."""


class ActionTerm:
    """Turns a slice of the action into commands."""

    def __init__(self, cfg: ActionTermCfg, env: ManagerBasedEnv):
        """Keep the configuration and find the entity."""
        self.cfg = cfg
        self._env = env
        self._asset = env.scene[cfg.asset_name]

    @property
    def action_dim(self) -> int:
        """Number of action entries that it takes."""
        raise NotImplementedError

    def process_actions(self, actions: torch.Tensor) -> None:
        """Take the policy's numbers, once per environment step; (num_envs, action_dim)."""
        raise NotImplementedError

    def apply_actions(self) -> None:
        """Set the targets, before every physics step."""
        raise NotImplementedError

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the state of some environments."""

    def describe(self) -> dict[str, Any]:
        """What the numbers that it takes mean, for ``policy.json``."""
        return {}


class ActionManager(ClassTerms[ActionTerm]):
    """Splits the action among its terms."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv):
        """Build the terms of a dict of name to configuration."""
        super().__init__(cfg, env, "action")
        self._sizes = [term.action_dim for term in self._terms.values()]
        self.action = torch.zeros(env.num_envs, sum(self._sizes), dtype=env.dtype, device=env.device)
        self.prev_action, self._given = self.action.clone(), self.action.clone()

    @property
    def total_action_dim(self) -> int:
        """Number of entries of an action."""
        return self.action.shape[1]

    @property
    def takes_masks(self) -> bool:
        """Whether :meth:`reset` takes environments that are not counted, (num_envs,) bool, too."""
        return all(type(term).reset is ActionTerm.reset for term in self._terms.values())

    def process_action(self, action: torch.Tensor) -> None:
        """Take an action, (num_envs, total_action_dim), where either may be 1, and hand it to the terms."""
        self.take_action(action)
        self.process_taken()

    def take_action(self, action: torch.Tensor) -> None:
        """Copy an action to where :meth:`process_taken` finds it."""
        shape = (self.action.shape[0], self.action.shape[1])
        self._given.copy_(torch.as_tensor(checked_values(action, shape, "the action")))

    def process_taken(self) -> None:
        """Hand the action that was taken to the terms."""
        self.prev_action.copy_(self.action)
        self.action.copy_(self._given)
        start = 0
        for term, size in zip(self._terms.values(), self._sizes, strict=True):
            term.process_actions(self.action[:, start : start + size])
            start += size

    def apply_action(self) -> None:
        """Set the targets of all terms."""
        for term in self._terms.values():
            term.apply_actions()

    def reset(self, env_ids: torch.Tensor) -> None:
        """Zero the actions of some environments: indices, or (num_envs,) bool."""
        self.action[env_ids] = 0.0
        self.prev_action[env_ids] = 0.0
        for term in self._terms.values():
            term.reset(env_ids)
