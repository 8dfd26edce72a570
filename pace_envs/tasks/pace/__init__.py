"""Identification: a robot held in the air follows a recording's commands."""

from pace_envs.tasks.pace.pace_cfg import CMAESOptimizerCfg, ExcitationCfg, PaceCfg
from pace_envs.tasks.pace.pace_sim2real_env_cfg import PaceSim2realEnvCfg, PaceSim2realSceneCfg

__all__ = ["CMAESOptimizerCfg", "ExcitationCfg", "PaceCfg", "PaceSim2realEnvCfg", "PaceSim2realSceneCfg"]
