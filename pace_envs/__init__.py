"""Robots as batched Gymnasium environments on MuJoCo. Importing registers them."""

from typing import TYPE_CHECKING

from pace_actuators.public_names import public_names
from pace_envs.registration import register_envs

if TYPE_CHECKING:
    from pace_actuators.config import configclass
    from pace_envs import managers, mdp
    from pace_envs.articulation import Articulation
    from pace_envs.articulation_cfg import ArticulationCfg, InitialStateCfg
    from pace_envs.assets_dir import ASSETS_DIR
    from pace_envs.from_model import cfg_from_model, robot_cfg_from_model
    from pace_envs.gym_vector import PaceVectorEnv
    from pace_envs.identified import set_identified_step, use_identified
    from pace_envs.manager_based_env import ManagerBasedEnv, ManagerBasedEnvCfg
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv, ManagerBasedRLEnvCfg
    from pace_envs.registration import load_env_cfg, register_task, registered_tasks, set_physics_dt
    from pace_envs.robots import anymal_d_cfg, go2_cfg, so101_cfg, test_bench_cfg
    from pace_envs.scene import InteractiveScene, InteractiveSceneCfg, TerrainCfg
    from pace_envs.simulation import Simulation, SimulationCfg
    from pace_envs.tasks.pace import (
        ExcitationCfg,
        PaceCfg,
        PaceSim2realEnvCfg,
        PaceSim2realSceneCfg,
        Parameter,
    )
    from pace_envs.tasks.reach.reach_env_cfg import ReachEnvCfg, reach_env_cfg
    from pace_envs.tasks.velocity.options import set_drives
    from pace_envs.tasks.velocity.velocity_env_cfg import VelocityEnvCfg, velocity_env_cfg, velocity_rewards

__all__ = [
    "ASSETS_DIR",
    "Articulation",
    "ArticulationCfg",
    "ExcitationCfg",
    "InitialStateCfg",
    "InteractiveScene",
    "InteractiveSceneCfg",
    "ManagerBasedEnv",
    "ManagerBasedEnvCfg",
    "ManagerBasedRLEnv",
    "ManagerBasedRLEnvCfg",
    "PaceCfg",
    "PaceSim2realEnvCfg",
    "PaceSim2realSceneCfg",
    "PaceVectorEnv",
    "Parameter",
    "ReachEnvCfg",
    "Simulation",
    "SimulationCfg",
    "TerrainCfg",
    "VelocityEnvCfg",
    "anymal_d_cfg",
    "cfg_from_model",
    "configclass",
    "go2_cfg",
    "load_env_cfg",
    "managers",
    "mdp",
    "reach_env_cfg",
    "register_envs",
    "register_task",
    "registered_tasks",
    "robot_cfg_from_model",
    "set_drives",
    "set_identified_step",
    "set_physics_dt",
    "so101_cfg",
    "test_bench_cfg",
    "use_identified",
    "velocity_env_cfg",
    "velocity_rewards",
]

__getattr__ = public_names(__file__)

register_envs()
