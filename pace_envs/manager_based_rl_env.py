"""The batched environment with rewards, terminations and commands."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from pace_envs.indexing import zeros_like
from pace_envs.manager_based_env import ManagerBasedEnv, ManagerBasedEnvCfg
from pace_envs.managers import (
    CommandManager,
    CommandTermCfg,
    CurriculumManager,
    CurriculumTermCfg,
    ManagerTermBase,
    RewardManager,
    RewardTermCfg,
    TerminationManager,
    TerminationTermCfg,
)
from pace_envs.step_graph import Homes


@dataclass(kw_only=True)
class ManagerBasedRLEnvCfg(ManagerBasedEnvCfg):
    """Configuration of an environment for learning."""

    episode_length_s: float = 20.0
    """Longest episode [s]."""

    commands: Mapping[str, CommandTermCfg] = field(default_factory=dict)
    """Commands by name."""

    rewards: Mapping[str, RewardTermCfg] = field(default_factory=dict)
    """Rewards by name."""

    terminations: Mapping[str, TerminationTermCfg] = field(default_factory=dict)
    """Terminations by name."""

    curriculum: Mapping[str, CurriculumTermCfg] = field(default_factory=dict)
    """Curriculum terms by name."""


class ManagerBasedRLEnv(ManagerBasedEnv):
    """A :class:`ManagerBasedEnv` with an episode.

    A step: (1) action, physics, contacts; (2) terminations; (3) rewards; (4) the curriculum judges environments that
    are done, and they are reset; (5) commands; (6) interval events; (7) observations. The observation of an
    environment that was reset is the first of its new episode (Gymnasium's "same step" autoreset);
    ``extras["final_obs"]`` holds the last one of the old episode where ``extras["_final_obs"]`` is true.
    """

    cfg: ManagerBasedRLEnvCfg

    def __init__(self, cfg: ManagerBasedRLEnvCfg, render_mode: str | None = None):
        """Build the scene and the managers."""
        super().__init__(cfg, render_mode)
        self.final_observations = False
        """Whether steps compute ``extras["final_obs"]``."""
        self._log, self._log_names = torch.zeros(0, device=self.device), list[str]()
        self.masks_resets = self.device.type != "cpu" and self.takes_masks

    @property
    def max_episode_length_s(self) -> float:
        """Longest episode [s]."""
        return self.cfg.episode_length_s

    @property
    def max_episode_length(self) -> int:
        """Longest episode [steps]."""
        return math.ceil(self.max_episode_length_s / self.step_dt - 1e-6)

    @property
    def takes_masks(self) -> bool:
        """Whether all terms can be reset by a mask instead of indices: those of this package can."""
        managers = (
            self.action_manager,
            self.command_manager,
            self.curriculum_manager,
            self.event_manager,
            self.observation_manager,
            self.reward_manager,
            self.termination_manager,
        )
        return self.scene.robot.closed_loops is None and all(manager.takes_masks for manager in managers)

    @property
    def can_be_captured(self) -> bool:
        """Whether nothing of a step has to wait for the GPU to count environments."""
        return self.takes_masks and all(term.changes_state_only for term in self.event_manager.terms)

    def load_managers(self) -> None:
        """Build the managers."""
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.command_manager = CommandManager(self.cfg.commands, self)
        super().load_managers()
        self.termination_manager = TerminationManager(self.cfg.terminations, self)
        self.reward_manager = RewardManager(self.cfg.rewards, self)
        self.curriculum_manager = CurriculumManager(self.cfg.curriculum, self)

    def step(  # type: ignore[override]  # gym.Env knows one reward, this is one per environment
        self, action: torch.Tensor
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance all environments by ``step_dt``.

        Args:
            action: (num_envs, action_dim).

        Returns:
            Observations by group; reward (num_envs,); terminated and truncated (num_envs,) bool; extras.

        Raises:
            ValueError: If the action is no tensor of that shape or not finite, or the environment is closed.
        """
        self._check_action(action)
        self.extras = {}
        if self.masks_resets and self.can_be_captured:
            self.action_manager.take_action(action)
            results = self._replayed(
                "step", lambda: self._advance() | self._after_physics(), lambda: Homes(self._step_parts(), self)
            )
            self.common_step_counter += 1
        else:
            self.simulate(action)
            results = self._after_physics()
        if self.masks_resets and self._log_names:
            self.extras["log"] = dict(zip(self._log_names, results["log"], strict=True))
        groups = self.observation_manager.group_obs_dim
        if final := {name: results[f"final_obs/{name}"] for name in groups if f"final_obs/{name}" in results}:
            self.extras |= {"final_obs": final, "_final_obs": results["done"]}
        obs = {name: results[f"obs/{name}"] for name in groups}
        return obs, results["reward"], results["terminated"], results["time_outs"], self.extras

    def _after_physics(self) -> dict[str, torch.Tensor]:
        """Steps (2) to (7); nothing of it waits for the GPU where :attr:`masks_resets`."""
        self.scene.update_sensors(self.step_dt)
        self.episode_length_buf += 1
        done = self.termination_manager.compute()
        reward = self.reward_manager.compute(self.step_dt)
        ended = None if self.masks_resets else done.nonzero()[:, 0]
        resets = ended is None or len(ended) > 0
        final = self.observation_manager.compute() if self.final_observations and resets else {}
        if ended is None:
            self._reset_where(done)
        elif resets:
            self._reset_idx(ended)
            self.sim.forward(ended)
            self.scene.update()
        self.command_manager.compute(self.step_dt)
        self.event_manager.apply("interval", dt=self.step_dt)
        return {
            "done": done,
            "reward": reward,
            "terminated": self.termination_manager.terminated,
            "time_outs": self.termination_manager.time_outs,
            "log": self._log.clone(),
            **{f"final_obs/{name}": value for name, value in final.items()},
            **{f"obs/{name}": value for name, value in self.observation_manager.compute().items()},
        }

    def _step_parts(self) -> list[object]:
        """The objects that keep something from step to step beside the simulation and the environment."""
        managers = (self.termination_manager, self.reward_manager, self.command_manager)
        terms = [
            term.func
            for manager in (
                self.termination_manager,
                self.reward_manager,
                self.observation_manager,
                self.event_manager,
                self.curriculum_manager,
            )
            for term in manager.terms
            if isinstance(term.func, ManagerTermBase)
        ]
        return [*self._moving_parts(), *managers, *self.command_manager.terms, *terms]

    def _graph_key(self) -> Hashable:
        constants = self.reward_manager.constants, self.observation_manager.constants
        return super()._graph_key(), *constants, self.final_observations

    def _reset_where(self, done: torch.Tensor) -> None:
        """:meth:`_reset_idx` of environments that are not counted, (num_envs,) bool.

        The log holds what the last episodes that ended have left, of this step or of one before.
        """
        log: dict[str, torch.Tensor] = self.curriculum_manager.compute_where(done)
        log |= self.reward_manager.reset_where(done) | self.termination_manager.reset_where(done)
        with self.scene.only_where(done):
            self.scene.reset_where(done)
            self.event_manager.apply("reset")
        self.scene.reset_drives_where(done)
        self.sim.forward(done)
        self.action_manager.reset(done)
        self.event_manager.reset_where(done)
        log |= self.command_manager.reset_where(done)
        self.episode_length_buf.masked_fill_(done, 0)
        self._keep_log(log, done)

    def _keep_log(self, log: dict[str, torch.Tensor], done: torch.Tensor) -> None:
        """Take numbers to log, where an episode has ended."""
        if not log:
            return
        if list(log) != self._log_names:
            self._log_names, self._log = list(log), zeros_like(torch.stack([value.float() for value in log.values()]))
        torch.where(done.any(), torch.stack([value.float() for value in log.values()]), self._log, out=self._log)

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        self.curriculum_manager.compute(env_ids)
        log = self.reward_manager.reset(env_ids) | self.termination_manager.reset(env_ids)
        log |= self.curriculum_manager.reset(env_ids)
        super()._reset_idx(env_ids)
        log |= self.command_manager.reset(env_ids)
        self.episode_length_buf[env_ids] = 0
        self.extras["log"] = log
