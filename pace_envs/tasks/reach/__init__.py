"""An arm brings its hand to commanded places."""

from pace_envs.tasks.reach.reach_env_cfg import ReachCommand, ReachCommandCfg, ReachEnvCfg, reach_env_cfg

__all__ = ["ReachCommand", "ReachCommandCfg", "ReachEnvCfg", "reach_env_cfg"]
