"""Drives that follow speeds are commanded by speeds."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv
from pace_optim.motion.signals import Trajectory
from pace_optim.problem.drive_steps import of_joints

from .cfg import CollectionCfg


def driven_by_speed(env: ManagerBasedRLEnv, cfg: CollectionCfg) -> tuple[str, ...]:
    """Joints whose drives follow speeds: those that the request names, and those without a proportional gain.

    Args:
        cfg: What is asked for.
    """
    names = np.array(env.scene["robot"].joint_names)
    own = {"stiffness": cfg.stiffness, "damping": cfg.damping}
    kp, kd = (of_joints(env, name) if value is None else np.full(len(names), value) for name, value in own.items())
    by_speed = kp == 0.0
    if cfg.velocity_joints is not None:
        try:
            named = np.array([re.fullmatch(cfg.velocity_joints, name) is not None for name in names])
        except re.error as error:
            raise ValueError(
                f"--velocity_joints {cfg.velocity_joints!r} is no regular expression: {error}. Expected one such as "
                "'.*wheel.*'."
            ) from error
        if not named.any():
            raise ValueError(f"--velocity_joints {cfg.velocity_joints!r} fits no joint. Available: {', '.join(names)}.")
        by_speed |= named
    if loose := names[by_speed & (kd == 0.0)].tolist():
        raise ValueError(
            f"Nothing would move {listed(loose, 3)}: stiffness and damping are 0, so the drive follows torques, and "
            "motions are made of positions and speeds. State the gains (--stiffness, --damping), or record with a "
            "torque controller and log its commands (des_dof_effort)."
        )
    return tuple(names[by_speed].tolist())


def told_speeds(trajectory: Trajectory, by_speed: tuple[str, ...], cfg: CollectionCfg) -> Trajectory:
    """The trajectory, with speeds for these joints."""
    if not by_speed:
        return trajectory
    if trajectory.has_jumps:
        raise ValueError(
            f"{cfg.excitation} jumps from target to target, and {listed(by_speed, 3)} follow speeds. Choose another "
            "--excitation, such as chirp, multisine or ramp."
        )
    if cfg.effects:
        raise ValueError(
            f"The plant that hides effects follows positions, and {listed(by_speed, 3)} follow speeds. Omit --effect."
        )
    return replace(trajectory, by_speed=by_speed)
