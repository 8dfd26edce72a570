"""Small identification problems with known truths, simulated without the code that replays recordings."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pace_actuators import PaceDCMotorCfg
from pace_envs import ArticulationCfg, ManagerBasedRLEnv, SimulationCfg, load_env_cfg
from pace_envs.tasks.pace import PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizerCfg
from pace_optim.problem.kinematic_trees import independent_trees
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.recording import Drive, Load, Recording, conform_recording
from pace_optim.recording.dataset import make_dataset

torch.set_num_threads(1)  # small tensors

BENCH = "Pace-TestBench-v0"
ANYMAL = "Pace-AnymalD-v0"
DT = 0.0025
TRUTH: dict[str, Any] = {
    "armature": 0.1,
    "viscous_friction": 4.5,
    "friction": 0.3,
    "encoder_bias": 0.02,
    "delay": 3.4,
}
"""A drive of the test bench."""
CALM: dict[str, Any] = {**TRUTH, "delay": 1.4}
"""The same with a delay that the loop endures in both delay modes."""


def chirp(duration: float = 1.0, low: float = 0.5, high: float = 6.0, amplitude: float = 0.5) -> np.ndarray:
    """Targets of one joint, (T, 1) [rad]."""
    t = np.arange(round(duration / DT) + 1) * DT
    return amplitude * np.sin(2 * np.pi * (low * t + (high - low) / (2 * duration) * t**2))[:, None]


def legs_chirp(cfg: PaceSim2realEnvCfg, duration: float = 1.0) -> np.ndarray:
    """Targets of all joints of a robot that states its excitation, (T, n) [rad]."""
    e = cfg.sim2real.excitation
    assert e is not None
    signal = chirp(duration, amplitude=1.0)
    return (signal + np.array(e.bias)) * np.array(e.direction) * np.array(e.scale)


def env_cfg(task: str | Callable[[], PaceSim2realEnvCfg] = BENCH, **changes: Any) -> PaceSim2realEnvCfg:
    """A task's configuration, with changes to its ``PaceCfg``."""
    cfg = load_env_cfg(task) if isinstance(task, str) else task()
    for name, value in changes.items():
        setattr(cfg.sim2real, name, value)
    cfg.sim.num_threads = 1  # small batches
    return cfg


def record(
    target: np.ndarray | None = None,
    truth: Mapping[str, Any] = TRUTH,
    *,
    cfg: PaceSim2realEnvCfg | None = None,
    name: str = "r",
    delay_mode: str = "command",
    drive: Mapping[str, float] | None = None,
    load: Load | None = None,
    torque_enable: np.ndarray | None = None,
    noise: float = 0.0,
    seed: int = 0,
) -> Recording:
    """What the encoders of a simulated robot read, with noise, and what was commanded."""
    target = chirp() if target is None else target
    facts = (delay_mode, drive or {}, load, torque_enable)
    if cfg is not None:
        reading = _moved(target, truth, cfg, *facts)
    else:  # what differs in its noise alone is simulated once
        enabled = None if torque_enable is None else torque_enable.tolist()
        said = repr((target.shape, sorted(truth.items()), *facts[:3], enabled))
        cfg, key = env_cfg(), (target.tobytes(), said)
        if key not in _MOTIONS:
            _MOTIONS[key] = _moved(target, truth, cfg, *facts)
        reading = _MOTIONS[key]
    n = target.shape[1]
    return Recording(
        name=name,
        joint_names=tuple(cfg.sim2real.joint_order),
        time=np.arange(len(target)) * DT,
        dof_pos=reading + noise * np.random.default_rng(seed).standard_normal(reading.shape),
        des_dof_pos=target.copy(),
        torque_enable=torque_enable,
        drive=Drive(**{key: np.full(n, value) for key, value in (drive or {}).items()}),
        load=load or Load(),
    )


_MOTIONS: dict[tuple[bytes, str], np.ndarray] = {}


def replayed(
    target: np.ndarray,
    truth: Mapping[str, Any],
    cfg: PaceSim2realEnvCfg,
    *,
    drive: Mapping[str, float] | None = None,
    noise: float = 0.0,
    seed: int = 0,
) -> Recording:
    """What :func:`record` gives, by the code that replays recordings: compiled, so fine physics steps cost little."""
    drive = Drive(**{key: np.full(target.shape[1], value) for key, value in (drive or {}).items()})
    names, time = tuple(cfg.sim2real.joint_order), np.arange(len(target)) * DT
    at_rest = np.tile(target[:1], (len(target), 1))
    recording = Recording(
        name="r", joint_names=names, time=time, dof_pos=at_rest, des_dof_pos=target.copy(), drive=drive
    )
    problem = make_problem(recording, cfg=cfg)
    values, rollout = physical(problem, truth), problem.evaluator().rollout(1)
    rollout.start(values[None], problem.dataset.sampled)
    reading = (rollout.positions(torch.arange(len(target)))[:, 0] - values[problem.space["encoder_bias"]]).numpy()
    recording.dof_pos[:] = reading + noise * np.random.default_rng(seed).standard_normal(reading.shape)
    return recording


def _moved(
    target: np.ndarray,
    truth: Mapping[str, Any],
    cfg: PaceSim2realEnvCfg,
    delay_mode: str,
    drive: Mapping[str, float],
    load: Load | None,
    torque_enable: np.ndarray | None,
) -> np.ndarray:
    """Step one environment by hand; what its encoders read, (T, n) [rad]."""
    cfg = copy.deepcopy(cfg)
    cfg.scene.num_envs = 1
    for each in cfg.scene.robot.actuators.values():
        each.delay_mode = delay_mode  # type: ignore[assignment]
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    robot, space = env.scene["robot"], ParameterSpace.of(cfg.sim2real)
    physical = space.from_dict(truth)
    space.apply(env, physical[None])
    for actuator in robot.actuators.values():
        for key, value in drive.items():
            getattr(actuator, key)[:] = value
    if load is not None:
        bench = {f.name: getattr(load, f.name) for f in fields(Load) if not f.name.startswith("added_mass")}
        bench = {key: value for key, value in bench.items() if value is not None}
        if bench:
            assert cfg.sim2real.apply_load is not None
            cfg.sim2real.apply_load(env, None, bench)
        for body, mass in load.added_mass.items():
            env.sim.expand("body_mass")[:, env.sim.model.body(body).id] += mass
            env.sim.constants_changed()
    bias = physical[space["encoder_bias"]]
    commands = torch.as_tensor(target)
    robot.write_joint_state_to_sim(commands[:1] + bias, torch.zeros_like(commands[:1]))
    reading = np.zeros_like(target)
    for k, command in enumerate(commands):
        reading[k] = (robot.data.joint_pos[0] - bias).numpy()
        if torque_enable is not None:
            for actuator in robot.actuators.values():
                actuator.set_torque_enable(torch.tensor([bool(torque_enable[k])]))
        env.simulate(command[None])
    env.close()
    return reading


def make_problem(
    recordings: Recording | Sequence[Recording] | None = None,
    *,
    cfg: PaceSim2realEnvCfg | None = None,
    validation: Sequence[Recording] = (),
    train_fraction: float = 1.0,
    delay_mode: str = "command",
) -> Problem:
    """What :func:`pace_optim.problem.problem.load_problem` makes of files, of recordings."""
    cfg = copy.deepcopy(cfg or env_cfg())
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings or [record()])
    for each in cfg.scene.robot.actuators.values():
        each.delay_mode = delay_mode  # type: ignore[assignment]
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg)
    conformed = [
        conform_recording(
            r,
            joint_order=cfg.sim2real.joint_order,
            control_dt=DT,
            load_bodies=env.scene["robot"].body_names,
            accepts_load=cfg.sim2real.apply_load is not None,
        )
        for r in (*recordings, *validation)
    ]
    problem = Problem(
        task="test",
        plain_cfg=cfg,
        env_cfg=cfg,
        dataset=make_dataset(conformed[: len(recordings)], conformed[len(recordings) :], train_fraction),
        space=ParameterSpace.of(cfg.sim2real),
        trees=independent_trees(env),
        delay_mode=delay_mode,
        control_dt=DT,
        passive_joints=env.scene["robot"].has_passive_joints,
    )
    env.close()
    return problem


def physical(problem: Problem, truth: Mapping[str, Any] = TRUTH) -> torch.Tensor:
    """A truth as a vector, (size,)."""
    return problem.space.from_dict(truth)


def normalised(problem: Problem, truth: Mapping[str, Any] = TRUTH) -> torch.Tensor:
    """A truth as a normalised vector, (size,)."""
    return problem.space.to_normalised(physical(problem, truth))


def range_error(problem: Problem, x: torch.Tensor, truth: Mapping[str, Any] = TRUTH) -> float:
    """Largest distance from the truth, as a part of the bound range."""
    return float((x - normalised(problem, truth)).abs().max()) / 2


PENDULUMS = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="left" pos="0 -0.3 1"><joint name="left" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.8"/>
      <site name="left_tip" pos="0 0 -0.25"/>
    </body>
    <body name="right" pos="0 0.3 1"><joint name="right" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="1.5"/>
      <site name="right_tip" pos="0 0 -0.2"/>
    </body>
  </worldbody>
  {more}
</mujoco>
"""
PENDULUMS_TRUTH: dict[str, Any] = {
    "armature": {"left": 0.08, "right": 0.15},
    "viscous_friction": {"left": 2.5, "right": 1.5},
    "friction": {"left": 0.2, "right": 0.4},
    "encoder_bias": {"left": 0.03, "right": -0.02},
    "delay": 2.6,
}


def pendulums_cfg(folder: Path, more: str = "", **cmaes: Any) -> PaceSim2realEnvCfg:
    """Two pendulums that hang side by side; ``more`` goes into their MJCF."""
    path = folder / "pendulums.xml"
    path.write_text(PENDULUMS.format(more=more))
    joints = ("left", "right")
    drive = PaceDCMotorCfg(
        joint_names_expr=".*",
        stiffness=60.0,
        damping=0.5,
        saturation_effort=80.0,
        effort_limit=50.0,
        velocity_limit=9.0,
        delay=0.0,
        max_delay=10.0,
    )
    return PaceSim2realEnvCfg(
        sim=SimulationCfg(num_threads=1),
        scene=PaceSim2realSceneCfg(robot=ArticulationCfg(mjcf_path=path, actuators={"all": drive}, fix_base=True)),
        sim2real=PaceCfg(
            robot_name="pendulums",
            data_dir=folder / "missing.npz",
            joint_order=joints,
            bounds={
                "armature": (1e-5, 0.5),
                "viscous_friction": (0.0, 6.0),
                "friction": (0.0, 1.0),
                "encoder_bias": (-0.1, 0.1),
                "delay": (0.0, 8.0),
            },
            cmaes=CMAESOptimizerCfg(**cmaes),
        ),
    )


def pendulums_target(duration: float = 1.0) -> np.ndarray:
    """Targets of both, (T, 2) [rad]."""
    return np.concatenate([chirp(duration), chirp(duration, low=0.8, high=5.0, amplitude=-0.4)], axis=1)
