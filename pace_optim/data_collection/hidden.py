"""Recordings with hidden effects, from the independent plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from pace_actuators.base_parameters import BASE_PARAMETERS, PER_JOINT
from pace_optim.data_collection.plant import (
    BaseTruth,
    PlantCfg,
    Truth,
    draw_visible,
    effect_named,
    joints_of,
    motion_change,
    plant_robot,
    session_of,
    simulate_motions,
    simulate_truths,
)
from pace_optim.motion.signals import Trajectory, make_excitation
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.recording.data import Drive, Load

from .cfg import CollectionCfg
from .simulate import Simulated

_VISIBLE = 3e-4
"""Smallest change of the motion that an effect is drawn for, where there is less noise [rad]."""
_REFERENCE = 6.0
"""Length of the chirp by which sizes are drawn [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hidden:
    """Simulated recordings and what is hidden in them."""

    simulated: list[Simulated]
    """One per trajectory."""
    truth: Truth
    """Base parameters and effects."""
    lines: tuple[str, ...]
    """The effects in words."""


def simulate_hidden(
    cfg: CollectionCfg,
    trajectories: Sequence[Trajectory],
    *,
    space: ParameterSpace,
    truth: torch.Tensor,
    delay_mode: Literal["command", "effort"],
) -> Hidden:
    """Draw the effects by the request's seed and let the plant follow the trajectories, one after another.

    Sizes are drawn so that the robot's own chirp shows them, for every recorded motion: recordings that are made one
    by one with the same seed are of one robot.

    Args:
        truth: Their true values, (size,).
    """
    for name in cfg.effects:
        effect_named(name)
    if len(set(cfg.effects)) < len(cfg.effects):
        raise ValueError(f"--effect names an effect twice: {', '.join(cfg.effects)}. Name each once.")
    robot = plant_robot(cfg.task, cfg.control_dt)
    joints = joints_of(robot, cfg.effect_joints)
    values = {key: truth[space[key]].tolist() for key in BASE_PARAMETERS}
    base = {key: dict(zip(robot.joint_names, values[key], strict=True)) for key in PER_JOINT}
    start = Truth(base=BaseTruth(**base, delay=values["delay"][0] * robot.control_dt), delay_mode=delay_mode)
    runs = session_of(trajectories, cfg.drive(robot.num_joints), cfg.load)
    plant = PlantCfg(
        step=PlantCfg.step if cfg.physics_dt is None else cfg.physics_dt,
        control_dt=robot.control_dt,
        noise=cfg.noise,
        counts_per_turn=None if cfg.encoder_bits is None else 2**cfg.encoder_bits,
        seed=cfg.seed,
    )
    chirp = make_excitation("chirp", robot.pace, control_dt=robot.control_dt, duration=_REFERENCE)
    drawn = draw_visible(
        robot,
        session_of(chirp, Drive(), Load()),
        cfg.effects,
        np.random.default_rng([cfg.seed, 3]),
        cfg=plant,
        base=start,
        joints=cfg.effect_joints,
        smallest=max(_VISIBLE, 3 * cfg.noise),
    )
    motions = simulate_motions(robot, runs, [drawn.truth], plant)[0]
    simulated = [Simulated(recording=m.recording, position=m.position, torque=m.torque[:-1]) for m in motions]
    lines = tuple(_in_words(name, drawn.truth, joints, len(robot.joint_names)) for name in cfg.effects)
    plain = simulate_truths(robot, runs, [start], plant)[0]
    change = f"they change the motion by {motion_change([m.recording for m in motions], plain, joints):.2g} rad (RMS)"
    return Hidden(simulated=simulated, truth=drawn.truth, lines=(*lines, change))


def _in_words(name: str, truth: Truth, joints: Sequence[str], count: int) -> str:
    effect = effect_named(name)
    values = truth.effects[name]
    numbers = []
    for parameter, draw in effect.draws.items():
        value = values[parameter]
        number = value[joints[0]] if not isinstance(value, float) else value  # type: ignore[index]
        numbers.append(f"{parameter} {number:.4g}{'' if draw.unit == '1' else f' {draw.unit}'}")
    where = "all joints" if len(joints) == count else ", ".join(joints)
    return f"{name}: {', '.join(numbers)}; {where}"
