"""Reaching: the task of any arm, and of the SO-101."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from pace_envs import mdp
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.managers import (
    CommandTerm,
    CommandTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
    UniformNoiseCfg,
)
from pace_envs.robots import so101_cfg
from pace_envs.rsl_rl_cfg import RslRlOnPolicyRunnerCfg, TrainingEnvCfg
from pace_envs.scene import InteractiveSceneCfg
from pace_envs.simulation import SimulationCfg

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
    base, found = robot.base_id, []
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


COMMAND = "ee_position"
"""Name of the command."""


@dataclass(kw_only=True)
class ReachEnvCfg(TrainingEnvCfg):
    """Configuration of a reaching task."""

    site: str
    """The site, or the body, that is brought to the commanded places."""


def reach_env_cfg(robot: ArticulationCfg, *, site: str, action_scale: float, experiment_name: str) -> ReachEnvCfg:
    """A reaching task: 50 Hz policy over 200 Hz physics and control, contacts off.

    Args:
        robot: The arm; its initial state is where episodes begin, its base is held.
        site: The site of its hand, or the hand's body.
        action_scale: Change of a target per unit of action [rad].
        experiment_name: Name of the folder of the runs.
    """
    where = {"command_name": COMMAND, "site": site}
    rewards = {
        "distance": RewardTermCfg(func=distance, weight=-1.0, params=where),
        "closeness": RewardTermCfg(func=closeness, weight=1.0, params={**where, "std": 0.05}),
        "action_rate": RewardTermCfg(func=mdp.action_rate_l2, weight=-1e-3),
    }
    return ReachEnvCfg(
        site=site,
        scene=InteractiveSceneCfg(num_envs=512, robot=dataclasses.replace(robot, fix_base=True)),
        sim=SimulationCfg(dt=0.005),
        decimation=4,
        episode_length_s=8.0,
        actions={"joint_pos": mdp.JointPositionActionCfg(scale=action_scale)},
        commands={COMMAND: ReachCommandCfg(site=site, resampling_time_range=(4.0, 4.0))},
        observations={
            "policy": ObservationGroupCfg(
                terms={
                    "to_command": ObservationTermCfg(func=to_command, params=where),
                    "command": ObservationTermCfg(func=mdp.generated_commands, params={"command_name": COMMAND}),
                    "joint_pos": ObservationTermCfg(
                        func=mdp.encoder_pos_rel, noise=UniformNoiseCfg(n_min=-0.01, n_max=0.01)
                    ),
                    "joint_vel": ObservationTermCfg(func=mdp.joint_vel),
                    "actions": ObservationTermCfg(func=mdp.last_action),
                },
                enable_corruption=True,
            )
        },
        events={
            "reset_joints": EventTermCfg(
                func=mdp.reset_joints_by_offset, mode="reset", params={"position_range": (-0.2, 0.2)}
            )
        },
        terminations={
            "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
            "diverged": TerminationTermCfg(func=mdp.diverged),
        },
        rewards=rewards,
        reward_sets={"reach": rewards},
        runner=RslRlOnPolicyRunnerCfg(experiment_name=experiment_name, max_iterations=200),
    )


def so101_reach_env_cfg() -> ReachEnvCfg:
    """The SO-101's; friction and armature are a guess of the size that others measured, until ``--identified``."""
    robot = so101_cfg()
    robot.actuators = {
        name: dataclasses.replace(drive, armature=0.028, friction=0.1, viscous_friction=0.15)
        for name, drive in robot.actuators.items()
    }
    return reach_env_cfg(robot, site="gripper_frame", action_scale=0.5, experiment_name="so101_reach")
