"""Terms of the reaching task: where a site is to be, where it is, and how far apart that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from pace_envs.managers import CommandTerm, CommandTermCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv

_PLACES = 4096
"""Places among which commands are drawn."""


class ReachCommand(CommandTerm):
    """Where a site or a body is to be in the base's frame [m]: a place that it takes at random joint positions."""

    cfg: ReachCommandCfg

    def __init__(self, cfg: ReachCommandCfg, env: ManagerBasedEnv):
        """Find places that the arm reaches."""
        super().__init__(cfg, env)
        env.scene["robot"].site_pose(cfg.site)  # complains if there is neither
        self._places = env.sim.tensor(_reachable(env, cfg))
        self._command = torch.zeros(env.num_envs, 3, dtype=env.dtype, device=env.device)
        self._errors = torch.zeros(env.num_envs, 2, dtype=env.dtype, device=env.device)  # distance, steps

    @property
    def command(self) -> torch.Tensor:
        """The present places, (num_envs, 3)."""
        return self._command

    def reset(self, env_ids: torch.Tensor) -> dict[str, float]:
        """Draw new places; returns the mean distance of the episodes that ended [m]."""
        super().reset(env_ids)
        distance, steps = self._errors[env_ids].sum(dim=0).tolist()
        self._errors[env_ids] = 0.0
        return {"distance": distance / steps} if steps else {}

    def _update_metrics(self) -> None:
        distance = (site_position(self._env, self.cfg.site) - self._command).norm(dim=1)
        self._errors += torch.stack([distance, torch.ones_like(distance)], dim=1)

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        drawn = self._env.uniform((len(env_ids),)) * len(self._places)
        self._command[env_ids] = self._places[drawn.long().clamp(max=len(self._places) - 1)]


@dataclass(kw_only=True)
class ReachCommandCfg(CommandTermCfg):
    """Configuration of :class:`ReachCommand`."""

    class_type: type[CommandTerm] = ReachCommand
    """The term's class."""

    site: str
    """The site, or the body, that is to be there."""

    joint_share: float = 0.5
    """How much of each joint's range, about the initial position, the places take."""

    lowest: float = 0.03
    """Least height of a place above the base [m]."""


def site_position(env: ManagerBasedEnv, site: str) -> torch.Tensor:
    """Where a site is in the base's frame, (num_envs, 3) [m]."""
    return env.scene["robot"].site_pose(site)[:, :3]


def to_command(env: ManagerBasedRLEnv, command_name: str, site: str) -> torch.Tensor:
    """The way from a site to where it is to be, (num_envs, 3) [m]."""
    return env.command_manager.get_command(command_name) - site_position(env, site)


def distance(env: ManagerBasedRLEnv, command_name: str, site: str) -> torch.Tensor:
    """Length of that way, (num_envs,) [m]."""
    return to_command(env, command_name, site).norm(dim=1)


def closeness(env: ManagerBasedRLEnv, command_name: str, site: str, std: float) -> torch.Tensor:
    """1 − tanh(distance / std), (num_envs,), as Isaac Lab's reaching task has it."""
    return 1.0 - torch.tanh(distance(env, command_name, site) / std)


def _reachable(env: Any, cfg: ReachCommandCfg) -> np.ndarray:
    """Places of a site at random joint positions, (n, 3) [m]."""
    robot, model = env.scene["robot"], env.sim.model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    low, high = robot.data.joint_pos_limits.cpu().numpy().T
    start = robot.data.default_joint_pos[0].cpu().numpy()
    low = np.where(np.isfinite(low), low, start - np.pi)
    high = np.where(np.isfinite(high), high, start + np.pi)
    half = 0.5 * cfg.joint_share * (high - low)
    at = [int(model.joint(name).qposadr[0]) for name in robot.driven.joints]
    base, found = 1, []
    is_site = any(model.site(i).name == cfg.site for i in range(model.nsite))
    hand = data.site(cfg.site) if is_site else data.body(cfg.site)
    for drawn in rng.uniform(-1.0, 1.0, (_PLACES, len(at))):
        data.qpos[at] = robot.driven.to_joints(np.clip(start + half * drawn, low, high))
        mujoco.mj_kinematics(model, data)
        found.append(data.xmat[base].reshape(3, 3).T @ (hand.xpos - data.xpos[base]))
    places = np.stack(found)
    places = places[places[:, 2] >= cfg.lowest]
    if not len(places):
        raise ValueError(
            f"{cfg.site} is nowhere {cfg.lowest:g} m above the base within {cfg.joint_share:g} of the joint ranges. "
            "Lower ReachCommandCfg.lowest, or raise joint_share."
        )
    return places
