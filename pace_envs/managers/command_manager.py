"""Commands: what the policy is asked to do, drawn again from time to time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from pace_envs.managers.manager_base import ClassTerms

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclass(kw_only=True)
class CommandTermCfg:
    """Configuration of a command term."""

    class_type: type[CommandTerm]
    """The term's class."""

    resampling_time_range: tuple[float, float] = (10.0, 10.0)
    """Time between two draws [s]."""


class CommandTerm:
    """A command per environment; subclasses draw it in :meth:`_resample_command`."""

    cfg: CommandTermCfg

    def __init__(self, cfg: CommandTermCfg, env: ManagerBasedEnv):
        """Start with the time of the next draw at zero."""
        self.cfg = cfg
        self._env = env
        self.time_left = torch.zeros(env.num_envs, dtype=env.dtype, device=env.device)

    @property
    def command(self) -> torch.Tensor:
        """The present command, (num_envs, dim)."""
        raise NotImplementedError

    def reset(self, env_ids: torch.Tensor) -> dict[str, float]:
        """Draw new commands for some environments; returns how well their last episodes followed theirs."""
        self._resample(env_ids)
        return {}

    def compute(self, dt: float) -> None:
        """Let time pass and draw where it has run out."""
        self._update_metrics()
        self.time_left -= dt
        due = self.time_left <= 0.0
        if self._env.masks_resets:
            self._resample_where(due)
        else:
            self._resample(due.nonzero()[:, 0])
        self._update_command()

    @property
    def takes_masks(self) -> bool:
        """Whether the term draws by :meth:`_resample_command_where`."""
        return False

    def reset_where(self, done: torch.Tensor) -> dict[str, torch.Tensor]:
        """:meth:`reset` of environments that are not counted, (num_envs,) bool."""
        self._resample_where(done)
        return {}

    def _resample_where(self, mask: torch.Tensor) -> None:
        drawn = self._env.uniform(tuple(self.time_left.shape), *self.cfg.resampling_time_range)
        torch.where(mask, drawn, self.time_left, out=self.time_left)
        self._resample_command_where(mask)

    def _resample_command_where(self, mask: torch.Tensor) -> None:
        raise NotImplementedError

    def _resample(self, env_ids: torch.Tensor) -> None:
        if len(env_ids):
            self.time_left[env_ids] = self._env.uniform((len(env_ids),), *self.cfg.resampling_time_range)
            self._resample_command(env_ids)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        raise NotImplementedError

    def _update_metrics(self) -> None:
        """Note how well the command is followed (nothing by default)."""

    def _update_command(self) -> None:
        """Change the command with the state (none by default)."""


class CommandManager(ClassTerms[CommandTerm]):
    """Holds the command terms."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv):
        """Build the terms of a dict of name to configuration."""
        super().__init__(cfg, env, "command")

    def get_command(self, name: str) -> torch.Tensor:
        """The present command of a term, (num_envs, dim)."""
        return self.get_term(name).command

    def compute(self, dt: float) -> None:
        """Let time pass."""
        for term in self._terms.values():
            term.compute(dt)

    @property
    def takes_masks(self) -> bool:
        """Whether all terms do."""
        return all(term.takes_masks for term in self._terms.values())

    def reset_where(self, done: torch.Tensor) -> dict[str, torch.Tensor]:
        """:meth:`reset` of environments that are not counted, (num_envs,) bool."""
        log: dict[str, torch.Tensor] = {}
        for name, term in self._terms.items():
            log |= {f"Metrics/{name}/{metric}": value for metric, value in term.reset_where(done).items()}
        return log

    def reset(self, env_ids: torch.Tensor) -> dict[str, float]:
        """Draw new commands for some environments; returns the terms' metrics as ``Metrics/<term>/<metric>``."""
        log: dict[str, float] = {}
        for name, term in self._terms.items():
            log |= {f"Metrics/{name}/{metric}": value for metric, value in term.reset(env_ids).items()}
        return log
