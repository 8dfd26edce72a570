"""Identification: a robot held in the air follows a recording's commands."""

from pace_envs.tasks.pace.pace_cfg import ExcitationCfg, PaceCfg
from pace_envs.tasks.pace.pace_sim2real_env_cfg import PaceSim2realEnvCfg, PaceSim2realSceneCfg
from pace_envs.tasks.pace.parameters import (
    GLOBAL,
    TORQUE_OFFSET,
    TORQUE_SCALE,
    Parameter,
    base_parameters,
    effect_parameters,
    link_parameters,
    sought_links,
    torque_parameters,
)

__all__ = [
    "GLOBAL",
    "TORQUE_OFFSET",
    "TORQUE_SCALE",
    "ExcitationCfg",
    "PaceCfg",
    "PaceSim2realEnvCfg",
    "PaceSim2realSceneCfg",
    "Parameter",
    "base_parameters",
    "effect_parameters",
    "link_parameters",
    "sought_links",
    "torque_parameters",
]
