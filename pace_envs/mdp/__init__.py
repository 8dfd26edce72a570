"""Terms of the managers: plain functions ``(env, **params)``, classes only where there is state."""

from pace_envs.mdp.actions import (
    JointEffortAction,
    JointEffortActionCfg,
    JointPositionAction,
    JointPositionActionCfg,
    JointVelocityAction,
    JointVelocityActionCfg,
)
from pace_envs.mdp.commands import UniformVelocityCommand, UniformVelocityCommandCfg
from pace_envs.mdp.curriculums import command_range_by_tracking
from pace_envs.mdp.energy import electrical_power, motor_power
from pace_envs.mdp.events import push_by_setting_velocity, reset_joints_by_offset, reset_root_state_uniform
from pace_envs.mdp.identified import randomize_identified_drives
from pace_envs.mdp.observations import (
    base_ang_vel,
    base_lin_vel,
    encoder_pos_rel,
    generated_commands,
    joint_pos,
    joint_pos_rel,
    joint_vel,
    last_action,
    projected_gravity,
)
from pace_envs.mdp.randomization import randomize_body_mass, randomize_friction
from pace_envs.mdp.rewards import (
    action_rate_l2,
    ang_vel_xy_l2,
    feet_air_time,
    feet_slide,
    flat_orientation_l2,
    is_alive,
    joint_acc_l2,
    joint_torques_l2,
    lin_vel_z_l2,
    track_ang_vel_z_exp,
    track_lin_vel_xy_exp,
    track_velocity_exp,
    undesired_contacts,
)
from pace_envs.mdp.terminations import (
    bad_orientation,
    diverged,
    illegal_contact,
    joint_pos_out_of_limit,
    root_height_below_minimum,
    time_out,
)

__all__ = [
    "JointEffortAction",
    "JointEffortActionCfg",
    "JointPositionAction",
    "JointPositionActionCfg",
    "JointVelocityAction",
    "JointVelocityActionCfg",
    "UniformVelocityCommand",
    "UniformVelocityCommandCfg",
    "action_rate_l2",
    "ang_vel_xy_l2",
    "bad_orientation",
    "base_ang_vel",
    "base_lin_vel",
    "command_range_by_tracking",
    "diverged",
    "electrical_power",
    "encoder_pos_rel",
    "feet_air_time",
    "feet_slide",
    "flat_orientation_l2",
    "generated_commands",
    "illegal_contact",
    "is_alive",
    "joint_acc_l2",
    "joint_pos",
    "joint_pos_out_of_limit",
    "joint_pos_rel",
    "joint_torques_l2",
    "joint_vel",
    "last_action",
    "lin_vel_z_l2",
    "motor_power",
    "projected_gravity",
    "push_by_setting_velocity",
    "randomize_body_mass",
    "randomize_friction",
    "randomize_identified_drives",
    "reset_joints_by_offset",
    "reset_root_state_uniform",
    "root_height_below_minimum",
    "time_out",
    "track_ang_vel_z_exp",
    "track_lin_vel_xy_exp",
    "track_velocity_exp",
    "undesired_contacts",
]
