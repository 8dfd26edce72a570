"""What every task has that a policy is trained in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pace_envs.manager_based_rl_env import ManagerBasedRLEnvCfg
from pace_envs.managers import RewardTermCfg
from pace_envs.rsl_rl_cfg import RslRlOnPolicyRunnerCfg


@dataclass(kw_only=True)
class TrainingEnvCfg(ManagerBasedRLEnvCfg):
    """Configuration of a task that ``scripts/train.py`` trains."""

    reward_sets: Mapping[str, Mapping[str, RewardTermCfg]] = field(default_factory=dict)
    """Sets of reward terms by name; ``rewards`` is the one in use."""

    runner: RslRlOnPolicyRunnerCfg = field(default_factory=RslRlOnPolicyRunnerCfg)
    """How rsl-rl trains it."""


def use_rewards(cfg: TrainingEnvCfg, name: str | None) -> None:
    """Reward by another set.

    Args:
        cfg: The task; it is changed.
        name: Of the set; ``None`` keeps the task's own rewards, or takes the first set where it has none.

    Raises:
        ValueError: If there is no such set.
    """
    if name is None:
        cfg.rewards = cfg.rewards or next(iter(cfg.reward_sets.values()), {})
        return
    if name not in cfg.reward_sets:
        raise ValueError(f"There is no reward set {name!r}. Available: {', '.join(cfg.reward_sets) or 'none'}.")
    cfg.rewards = cfg.reward_sets[name]


def play_cfg(cfg: TrainingEnvCfg) -> None:
    """Judge instead of training: no noise, no curriculum, commands from the whole ranges."""
    for group in cfg.observations.values():
        group.enable_corruption = False
    cfg.curriculum = {}
