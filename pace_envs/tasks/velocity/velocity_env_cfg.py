"""What the velocity tasks of all robots share."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from pace_actuators import JointValue
from pace_envs import mdp
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.contact_sensor import ContactSensorCfg
from pace_envs.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
    UniformNoiseCfg,
)
from pace_envs.rsl_rl_cfg import TrainingEnvCfg
from pace_envs.scene import InteractiveSceneCfg, TerrainCfg
from pace_envs.simulation import SimulationCfg

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


COMMAND = "base_velocity"
"""Name of the velocity command."""


@dataclass(kw_only=True)
class VelocityEnvCfg(TrainingEnvCfg):
    """Configuration of a velocity task."""

    copper_loss: JointValue = 0.0
    """Winding losses over squared torque, R / (r² k²) of each drive [W/(N m)²]: for the cost of transport."""


def velocity_env_cfg(
    robot: ArticulationCfg,
    *,
    feet: str,
    base: str | None,
    knees: str,
    action_scale: float,
    minimum_height: float | None = None,
) -> VelocityEnvCfg:
    """A velocity task without rewards: 50 Hz policy over 200 Hz physics and control.

    Expressions name colliding geoms, or the bodies whose geoms they are. Meshes collide as their convex hulls.

    Args:
        robot: The robot; its initial state is the stance, its drives run at 200 Hz.
        base: Expression of what ends an episode where it touches the ground; ``None`` for a base that does not collide:
            its tilt and height alone end an episode then.
        knees: Expression of what should not touch the ground.
        action_scale: Change of a target per unit of action [rad].
        minimum_height: Height of the base below which it has fallen [m]; ``None``: half of that in the stance.
    """
    cfg = VelocityEnvCfg(
        scene=InteractiveSceneCfg(
            num_envs=512,
            robot=dataclasses.replace(robot, fix_base=False),
            terrain=TerrainCfg(collision_geoms=(feet, knees), impratio=1.0),
            contact_sensors={
                "feet": ContactSensorCfg(geom_names=feet, track_velocity=True),
                "knees": ContactSensorCfg(geom_names=knees),
            },
        ),
        sim=SimulationCfg(dt=0.005, contacts=True),
        decimation=4,
        episode_length_s=20.0,
        actions={"joint_pos": mdp.JointPositionActionCfg(scale=action_scale)},
        commands={COMMAND: mdp.UniformVelocityCommandCfg(rel_standing_envs=0.05)},
        observations={"policy": ObservationGroupCfg(terms=_observations(), enable_corruption=True)},
        events=_resets(),
        terminations={
            "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
            "bad_orientation": TerminationTermCfg(func=mdp.bad_orientation, params={"limit_angle": 1.0}),
            "base_height": TerminationTermCfg(
                func=mdp.root_height_below_minimum,
                params={"minimum_height": 0.5 * robot.init_state.pos[2] if minimum_height is None else minimum_height},
            ),
            "diverged": TerminationTermCfg(func=mdp.diverged),
        },
        curriculum={
            "command_range": CurriculumTermCfg(
                func=mdp.command_range_by_tracking,
                params={"command_name": COMMAND, "reward_name": "track_velocity", "start": 0.5},
            )
        },
    )
    if base is not None:
        cfg.scene.terrain = TerrainCfg(collision_geoms=(feet, base, knees), impratio=1.0)
        cfg.scene.contact_sensors = {**cfg.scene.contact_sensors, "base": ContactSensorCfg(geom_names=base)}
        touches = TerminationTermCfg(func=mdp.illegal_contact, params={"sensor_name": "base"})
        cfg.terminations = {"time_out": cfg.terminations["time_out"], "base_contact": touches, **cfg.terminations}
    return cfg


def _observations() -> dict[str, ObservationTermCfg]:
    def noisy(func: object, amplitude: float) -> ObservationTermCfg:
        return ObservationTermCfg(func=func, noise=UniformNoiseCfg(n_min=-amplitude, n_max=amplitude))  # type: ignore[arg-type]

    return {
        "base_lin_vel": noisy(mdp.base_lin_vel, 0.1),
        "base_ang_vel": noisy(mdp.base_ang_vel, 0.2),
        "projected_gravity": noisy(mdp.projected_gravity, 0.05),
        "velocity_commands": ObservationTermCfg(func=mdp.generated_commands, params={"command_name": COMMAND}),
        "joint_pos": noisy(mdp.encoder_pos_rel, 0.01),
        "joint_vel": noisy(mdp.joint_vel, 1.5),
        "actions": ObservationTermCfg(func=mdp.last_action),
    }


def _resets() -> dict[str, EventTermCfg]:
    small = (-0.3, 0.3)
    return {
        "reset_base": EventTermCfg(
            func=mdp.reset_root_state_uniform,
            mode="reset",
            params={
                "pose_range": {"x": (-0.5, 0.5), "y": (-0.5, 0.5), "yaw": (-3.14159, 3.14159)},
                "velocity_range": {axis: small for axis in ("x", "y", "z", "roll", "pitch", "yaw")},
            },
        ),
        "reset_joints": EventTermCfg(
            func=mdp.reset_joints_by_offset, mode="reset", params={"position_range": (-0.1, 0.1)}
        ),
    }
