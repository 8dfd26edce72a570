"""SO-101 reaches."""

from dataclasses import replace

from pace_envs.robots import so101_cfg
from pace_envs.tasks.reach.reach_env_cfg import ReachEnvCfg, reach_env_cfg


def so101_reach_env_cfg() -> ReachEnvCfg:
    """The task; friction and armature are a guess of the size that others measured, until ``--identified``."""
    robot = so101_cfg()
    robot.actuators = {
        name: replace(drive, armature=0.028, friction=0.1, viscous_friction=0.15)
        for name, drive in robot.actuators.items()
    }
    return reach_env_cfg(robot, site="gripper_frame", action_scale=0.5, experiment_name="so101_reach")
