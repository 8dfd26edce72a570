"""The two reward sets of the velocity tasks; every term is weighted per second."""

from __future__ import annotations

from pace_actuators import JointValue
from pace_envs import mdp
from pace_envs.managers import RewardTermCfg

_COMMAND = {"command_name": "base_velocity"}


def velocity_rewards(
    *, torques: float = -2.5e-5, feet_air_time: float = 0.5, air_time: float = 0.5
) -> dict[str, RewardTermCfg]:
    """The usual set for tracking a velocity on flat ground, with the weights of Isaac Lab's ANYmal task.

    Args:
        torques: Weight of squared torques; it scales with the size of the robot.
        feet_air_time: Weight of long steps.
        air_time: Time in the air that makes a step long [s].
    """
    term = RewardTermCfg
    return {
        "track_velocity": term(func=mdp.track_lin_vel_xy_exp, weight=1.0, params={"std": 0.5, **_COMMAND}),
        "track_yaw_rate": term(func=mdp.track_ang_vel_z_exp, weight=0.5, params={"std": 0.5, **_COMMAND}),
        "lin_vel_z_l2": term(func=mdp.lin_vel_z_l2, weight=-2.0),
        "ang_vel_xy_l2": term(func=mdp.ang_vel_xy_l2, weight=-0.05),
        "joint_torques_l2": term(func=mdp.joint_torques_l2, weight=torques),
        "joint_acc_l2": term(func=mdp.joint_acc_l2, weight=-2.5e-7),
        "action_rate_l2": term(func=mdp.action_rate_l2, weight=-0.01),
        "feet_air_time": term(
            func=mdp.feet_air_time,
            weight=feet_air_time,
            params={"sensor_name": "feet", "threshold": air_time, **_COMMAND},
        ),
        "undesired_contacts": term(func=mdp.undesired_contacts, weight=-1.0, params={"sensor_names": ("knees",)}),
        "flat_orientation_l2": term(func=mdp.flat_orientation_l2, weight=-5.0),
    }


def energy_rewards(
    copper_loss: JointValue, *, touching: tuple[str, ...] = ("knees", "base")
) -> dict[str, RewardTermCfg]:
    """The four terms and weights of PACE, Bjelonic, Tischhauser and Hutter, arXiv 2509.06342.

    Velocity tracking 0.2, electrical power -16e-5 per watt, collisions -1, and a term on the feet with -0.1, which
    here is how fast the feet on the ground slide.

    Args:
        copper_loss: R / (r² k²) of each drive [W/(N m)²].
        touching: Sensors of what should not touch the ground; ``("knees",)`` where the base does not collide.
    """
    term = RewardTermCfg
    return {
        "track_velocity": term(func=mdp.track_velocity_exp, weight=0.2, params={"std": 0.5, **_COMMAND}),
        "energy": term(func=mdp.electrical_power, weight=-16e-5, params={"copper_loss": copper_loss}),
        "collision": term(func=mdp.undesired_contacts, weight=-1.0, params={"sensor_names": touching}),
        "feet": term(func=mdp.feet_slide, weight=-0.1, params={"sensor_name": "feet"}),
    }
