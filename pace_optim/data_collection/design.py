"""The optimised motion of a collection."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from pace_envs.tasks.pace import PaceCfg
from pace_optim.motion.design import Design, DesignCfg, optimize_motion
from pace_optim.motion.design.motion_check import MotionLimits
from pace_optim.motion.signals import Trajectory
from pace_optim.problem.kinematic_trees import independent_trees
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.recording.dataset import make_dataset

from .cfg import CollectionCfg
from .simulate import draft_recordings, true_parameters

USUAL_NOISE = 1e-4
"""Encoder noise to design for where none is given [rad]."""


def design_motion(
    cfg: CollectionCfg, env: Any, unoptimized: Trajectory, limits: MotionLimits, report: Callable[[str], None]
) -> Design:
    """Choose the motion after which the parameters are known best, if they are near the expected ones."""
    sim2real, robot = env.cfg.sim2real, env.scene["robot"]
    space = ParameterSpace.of(sim2real)
    env_cfg, trees = copy.deepcopy(env.cfg), independent_trees(env)
    drive = cfg.drive(robot.num_joints)
    delay_mode = next(iter(env_cfg.scene.robot.actuators.values())).delay_mode

    def problem_of(trajectories: Sequence[Trajectory]) -> Problem:
        told = [replace(trajectory, by_speed=unoptimized.by_speed) for trajectory in trajectories]
        drafts = draft_recordings(env, told, drive, cfg.load)
        return Problem(
            task=cfg.task,
            plain_cfg=env_cfg,
            env_cfg=env_cfg,
            dataset=make_dataset(drafts, train_fraction=1),
            space=space,
            trees=trees,
            delay_mode=delay_mode,
            control_dt=env.step_dt,
        )

    return optimize_motion(
        problem_of,
        sim2real,
        unoptimized,
        limits,
        space.to_normalised(expected_parameters(sim2real, space, cfg.parameters)),
        excitation=cfg.excitation,
        min_frequency=cfg.min_frequency,
        max_frequency=cfg.max_frequency,
        control_dt=env.step_dt,
        duration=cfg.duration,
        cfg=DesignCfg(noise=cfg.noise or USUAL_NOISE, reach=cfg.reach, seed=cfg.seed),
        report=report,
    )


def expected_parameters(sim2real: PaceCfg, space: ParameterSpace, overrides: Mapping[str, float]) -> torch.Tensor:
    """Where the parameters are expected: as given, else as in ``sample_params``, else in the middle of the bounds.

    Args:
        overrides: By name (all joints) or ``name/joint``.
    """
    middle = space.to_physical(torch.zeros(space.size, dtype=torch.float64)).tolist()
    known = {label.partition("/")[0] for label in overrides if "/" not in label} | set(sim2real.sample_params)
    unknown = [label for label in space.labels if label.partition("/")[0] not in known and label not in overrides]
    guesses = {label: middle[space.labels.index(label)] for label in unknown}
    return true_parameters(sim2real, space, {**guesses, **overrides})
