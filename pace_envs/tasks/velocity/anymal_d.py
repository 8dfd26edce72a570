"""ANYmal D walks."""

from dataclasses import replace

from pace_envs.robots import anymal_d_cfg
from pace_envs.rsl_rl_cfg import RslRlOnPolicyRunnerCfg, gaussian
from pace_envs.tasks.velocity.velocity_env_cfg import VelocityEnvCfg, energy_rewards, velocity_env_cfg, velocity_rewards

COPPER_LOSS = 0.008
"""R / (r² k²) [W/(N m)²]: R 0.2 ohm, r 50, k 0.1 N m/A. Assumed, of the right size; put in your motor's."""

ARMATURE = 0.06
"""Rotor inertia at the joint [kg m^2], the middle of what arXiv 2509.06342 identified. Without any, a free leg
overshoots the torque-speed curve at steps of 5 ms, up to twice the no-load speed."""

VISCOUS_FRICTION = 3.4
"""[N m s/rad], less than the 4.3 to 5.5 identified there: what one might guess before an identification. The gains are
those of the recordings (kp 85, kd 0.6), whose kd alone hardly damps a leg."""


def anymal_d_velocity_env_cfg() -> VelocityEnvCfg:
    """The task."""
    robot = anymal_d_cfg()
    robot.actuators = {
        name: replace(drive, armature=ARMATURE, viscous_friction=VISCOUS_FRICTION)
        for name, drive in robot.actuators.items()
    }
    cfg = velocity_env_cfg(
        robot, feet=".._foot", base="base_trunk", knees=".._shank_knee", action_scale=0.5, minimum_height=0.3
    )
    cfg.copper_loss = COPPER_LOSS
    cfg.reward_sets = {"velocity": velocity_rewards(), "energy": energy_rewards(COPPER_LOSS)}
    cfg.rewards = cfg.reward_sets["velocity"]
    cfg.runner = RslRlOnPolicyRunnerCfg(experiment_name="anymal_d_velocity")
    cfg.runner.actor.distribution_cfg = gaussian(init_std=0.6)  # of 0.5 rad: with 1 a robot falls before it learns
    return cfg
