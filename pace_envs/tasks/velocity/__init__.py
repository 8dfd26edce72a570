"""Walking on flat ground after a commanded velocity."""

from pace_envs.rsl_rl_cfg import play_cfg, use_rewards
from pace_envs.tasks.velocity.options import add_randomization, fix_command, set_drives
from pace_envs.tasks.velocity.velocity_env_cfg import VelocityEnvCfg, energy_rewards, velocity_env_cfg, velocity_rewards

__all__ = [
    "VelocityEnvCfg",
    "add_randomization",
    "energy_rewards",
    "fix_command",
    "play_cfg",
    "set_drives",
    "use_rewards",
    "velocity_env_cfg",
    "velocity_rewards",
]
