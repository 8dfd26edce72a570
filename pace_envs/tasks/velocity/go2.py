"""Go2 walks."""

from dataclasses import replace

from pace_envs.robots import go2_cfg
from pace_envs.rsl_rl_cfg import RslRlOnPolicyRunnerCfg
from pace_envs.tasks.velocity.velocity_env_cfg import VelocityEnvCfg, energy_rewards, velocity_env_cfg, velocity_rewards

COPPER_LOSS = {".*_(hip|thigh)_joint": 0.45, ".*_calf_joint": 0.2}
"""R / (r² k²) [W/(N m)²]: R 0.3 ohm, k 0.128 N m/A, r 6.33 and 9.6. Assumed, of the right size; put in your motor's."""

ARMATURE = 0.01
"""Rotor inertia at the joint [kg m^2], of the usual size for this robot."""


def go2_velocity_env_cfg() -> VelocityEnvCfg:
    """The task."""
    robot = go2_cfg()
    robot.actuators = {
        name: replace(drive, stiffness=25.0, damping=1.0, armature=ARMATURE) for name, drive in robot.actuators.items()
    }
    cfg = velocity_env_cfg(
        robot, feet=".._foot", base="base_trunk", knees=".._thigh", action_scale=0.25, minimum_height=0.16
    )
    cfg.copper_loss = COPPER_LOSS
    cfg.reward_sets = {
        "velocity": velocity_rewards(torques=-2e-4, feet_air_time=0.25, air_time=0.3),
        "energy": energy_rewards(COPPER_LOSS),
    }
    cfg.rewards = cfg.reward_sets["velocity"]
    cfg.runner = RslRlOnPolicyRunnerCfg(experiment_name="go2_velocity")
    return cfg
