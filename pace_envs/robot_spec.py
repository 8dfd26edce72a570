"""A robot's model as the environment wants it: with a fixed or a floating base."""

from __future__ import annotations

import mujoco

from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.model_file import compile_model, read_model_file


def load_robot_spec(cfg: ArticulationCfg) -> mujoco.MjSpec:
    """Read a robot's MJCF; its base is fixed or floating as the configuration says.

    Raises:
        ValueError: If the file is missing or no usable MJCF.
    """
    spec = read_model_file(cfg.mjcf_path).spec
    compile_model(spec, cfg.mjcf_path)  # a fault of the file is told with its name
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if cfg.fix_base:
        for joint in free:
            base = joint.parent
            base.pos, base.quat = cfg.init_state.pos, cfg.init_state.rot
            spec.delete(joint)
    return spec
