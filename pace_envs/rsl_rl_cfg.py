"""Configuration of a task that rsl-rl trains, and of how: plain, turned into the dict that rsl-rl 5 reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from pace_envs.manager_based_rl_env import ManagerBasedRLEnvCfg
from pace_envs.managers import RewardTermCfg


@dataclass(kw_only=True)
class RslRlPpoAlgorithmCfg:
    """Proximal policy optimisation."""

    class_name: str = "PPO"
    """Class of the algorithm."""

    num_learning_epochs: int = 4
    """Passes over the collected samples per iteration."""

    num_mini_batches: int = 4
    """Mini-batches per pass."""

    clip_param: float = 0.2
    """Largest change of the probability ratio."""

    gamma: float = 0.99
    """Discount per environment step."""

    lam: float = 0.95
    """Decay of generalised advantage estimation."""

    value_loss_coef: float = 1.0
    """Weight of the value loss."""

    use_clipped_value_loss: bool = True
    """Whether the change of the value is clipped, too."""

    entropy_coef: float = 0.005
    """Weight of the policy's entropy."""

    learning_rate: float = 1e-3
    """At the start."""

    max_grad_norm: float = 1.0
    """Gradients are scaled down to this norm."""

    schedule: str = "adaptive"
    """``"adaptive"`` changes the learning rate to keep ``desired_kl``; ``"fixed"`` keeps it."""

    desired_kl: float = 0.01
    """Change of the policy per update, as Kullback-Leibler divergence."""


@dataclass(kw_only=True)
class RslRlMlpModelCfg:
    """A multi-layer perceptron."""

    class_name: str = "MLPModel"
    """Class of the model."""

    hidden_dims: tuple[int, ...] = (128, 128, 128)
    """Sizes of the hidden layers."""

    activation: str = "elu"
    """Activation function."""

    obs_normalization: bool = True
    """Whether observations are scaled by their running mean and standard deviation."""

    distribution_cfg: dict[str, Any] | None = None
    """Distribution of the actions; ``None`` for a critic."""


def gaussian(init_std: float) -> dict[str, Any]:
    """Normally distributed actions with a learned standard deviation, which starts at ``init_std``."""
    return {"class_name": "GaussianDistribution", "init_std": init_std, "std_type": "scalar"}


@dataclass(kw_only=True)
class RslRlOnPolicyRunnerCfg:
    """Configuration of rsl-rl's ``OnPolicyRunner``."""

    experiment_name: str = ""
    """Name of the folder of the runs; empty: the task's."""

    seed: int = 42
    """Seed of the environment and of the networks."""

    num_steps_per_env: int = 24
    """Environment steps per iteration."""

    max_iterations: int = 600
    """Iterations of a training."""

    save_interval: int = 50
    """Iterations between checkpoints."""

    obs_groups: dict[str, list[str]] = field(default_factory=lambda: {"actor": ["policy"], "critic": ["policy"]})
    """Observation groups that each network sees."""

    clip_actions: float | None = 100.0
    """Actions are clipped to plus and minus this; ``None`` for no clipping."""

    actor: RslRlMlpModelCfg = field(default_factory=lambda: RslRlMlpModelCfg(distribution_cfg=gaussian(1.0)))
    """The policy."""

    critic: RslRlMlpModelCfg = field(default_factory=RslRlMlpModelCfg)
    """The value function."""

    algorithm: RslRlPpoAlgorithmCfg = field(default_factory=RslRlPpoAlgorithmCfg)
    """The algorithm."""

    logger: str = "tensorboard"
    """Where rsl-rl logs to."""

    def to_dict(self) -> dict[str, Any]:
        """The dict that ``OnPolicyRunner`` takes (and changes)."""
        cfg = asdict(self)
        if cfg["critic"]["distribution_cfg"] is None:
            del cfg["critic"]["distribution_cfg"]
        return cfg


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
