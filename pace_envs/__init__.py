"""Robots as batched Gymnasium environments on MuJoCo. Importing registers them."""

from pace_actuators import configclass
from pace_envs.articulation import Articulation
from pace_envs.articulation_cfg import ArticulationCfg, InitialStateCfg
from pace_envs.gym_vector import PaceVectorEnv
from pace_envs.manager_based_env import ManagerBasedEnv, ManagerBasedEnvCfg
from pace_envs.manager_based_rl_env import ManagerBasedRLEnv, ManagerBasedRLEnvCfg
from pace_envs.registration import (
    load_env_cfg,
    register_envs,
    register_task,
    registered_tasks,
    set_physics_dt,
)
from pace_envs.scene import InteractiveScene, InteractiveSceneCfg, TerrainCfg
from pace_envs.simulation import Simulation, SimulationCfg

__all__ = [
    "Articulation",
    "ArticulationCfg",
    "InitialStateCfg",
    "InteractiveScene",
    "InteractiveSceneCfg",
    "ManagerBasedEnv",
    "ManagerBasedEnvCfg",
    "ManagerBasedRLEnv",
    "ManagerBasedRLEnvCfg",
    "PaceVectorEnv",
    "Simulation",
    "SimulationCfg",
    "TerrainCfg",
    "configclass",
    "load_env_cfg",
    "register_envs",
    "register_task",
    "registered_tasks",
    "set_physics_dt",
]

register_envs()
