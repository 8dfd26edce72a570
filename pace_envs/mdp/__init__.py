"""Terms of the managers: plain functions ``(env, **params)``, classes only where there is state."""

from pace_envs.mdp.actions import JointPositionAction, JointPositionActionCfg
from pace_envs.mdp.commands import UniformVelocityCommand, UniformVelocityCommandCfg
from pace_envs.mdp.events import push_by_setting_velocity, reset_joints_by_offset, reset_root_state_uniform
from pace_envs.mdp.observations import generated_commands, joint_pos, joint_pos_rel, joint_vel, last_action
from pace_envs.mdp.rewards import action_rate_l2, is_alive, joint_torques_l2
from pace_envs.mdp.terminations import joint_pos_out_of_limit, time_out

__all__ = [
    "JointPositionAction",
    "JointPositionActionCfg",
    "UniformVelocityCommand",
    "UniformVelocityCommandCfg",
    "action_rate_l2",
    "generated_commands",
    "is_alive",
    "joint_pos",
    "joint_pos_out_of_limit",
    "joint_pos_rel",
    "joint_torques_l2",
    "joint_vel",
    "last_action",
    "push_by_setting_velocity",
    "reset_joints_by_offset",
    "reset_root_state_uniform",
    "time_out",
]
