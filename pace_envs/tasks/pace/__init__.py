"""Identification: a robot held in the air follows a recording's commands."""

from pace_envs.tasks.pace.pace_cfg import ExcitationCfg, PaceCfg
from pace_envs.tasks.pace.pace_sim2real_env_cfg import PaceSim2realEnvCfg, PaceSim2realSceneCfg
from pace_envs.tasks.pace.parameters import (
    GLOBAL,
    Parameter,
    base_parameters,
    effect_parameters,
    link_parameters,
    sought_links,
)

__all__ = [
    "GLOBAL",
    "ExcitationCfg",
    "PaceCfg",
    "PaceSim2realEnvCfg",
    "PaceSim2realSceneCfg",
    "Parameter",
    "base_parameters",
    "effect_parameters",
    "link_parameters",
    "sought_links",
]
