"""An arm brings its hand to commanded places."""

from pace_envs.tasks.reach.reach_env_cfg import ReachEnvCfg, reach_env_cfg
from pace_envs.tasks.reach.terms import ReachCommand, ReachCommandCfg

__all__ = ["ReachCommand", "ReachCommandCfg", "ReachEnvCfg", "reach_env_cfg"]
