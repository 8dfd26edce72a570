"""An identification environment from a model file alone."""

from pace_envs.from_model.robot import Robot, cfg_from_model, read_robot, robot_cfg_from_model

__all__ = ["Robot", "cfg_from_model", "read_robot", "robot_cfg_from_model"]
