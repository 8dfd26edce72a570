"""Reaching: the task of any arm, and of the SO-101."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from pace_envs import mdp
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.managers import (
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
from pace_envs.tasks.reach.terms import ReachCommandCfg, closeness, distance, to_command

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
