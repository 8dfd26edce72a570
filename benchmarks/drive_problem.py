"""The problem that both solvers are given: ANYmal D's 36 drive parameters from one simulated chirp.

Armature, viscous and Coulomb friction of twelve joints, within the bounds of the reference case. The recording is
noise-free, without delay and encoder bias: ``mujoco.sysid`` cannot place these in the loop. For the same reason the
drive's torque-speed curve is left out and its effort limit kept: a position actuator has no such curve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from pace_envs import load_env_cfg
from pace_envs.manager_based_rl_env import ManagerBasedRLEnv
from pace_optim.problem.kinematic_trees import independent_trees
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.problem.rollout import Rollout
from pace_optim.recording import Recording, conform_recording
from pace_optim.recording.dataset import make_dataset

TASK = "Pace-AnymalD-v0"
FITTED = ("armature", "viscous_friction", "friction")


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveProblem:
    """The problem, its truth, and which entries of our parameter vector are fitted."""

    problem: Problem
    truth: torch.Tensor
    """Physical vector, (size,)."""
    fitted: torch.Tensor
    """Indices of the fitted entries: armature, viscous friction, friction of every joint, (36,)."""

    @property
    def recording(self) -> Recording:
        """The recording."""
        return self.problem.dataset.recordings[0]

    def relative_error(self, fitted: np.ndarray | torch.Tensor) -> np.ndarray:
        """(value - truth) / range of the fitted entries' physical values, (36,)."""
        space = self.problem.space
        width = (space.upper - space.lower)[self.fitted]
        return ((torch.as_tensor(fitted) - self.truth[self.fitted]) / width).numpy()


def chirp(steps: int, dt: float, duration: float = 20.0) -> np.ndarray:
    """Targets of PACE's sweep from 0.1 to 10 Hz, its first ``steps`` steps, (steps, 12) [rad]."""
    t = np.arange(steps) * dt
    signal = np.sin(2 * np.pi * (0.1 + 9.9 / (2 * duration) * t) * t)[:, None]
    excitation = load_env_cfg(TASK).sim2real.excitation
    return (signal + excitation.bias) * np.array(excitation.direction) * np.array(excitation.scale)


def drive_problem(steps: int = 8000) -> DriveProblem:
    """Simulate the recording and state the problem.

    Args:
        steps: Length of the recording [control steps]; the whole chirp has 8000.
    """
    cfg = load_env_cfg(TASK)
    sim2real = cfg.sim2real
    for drive in cfg.scene.robot.actuators.values():
        drive.saturation_effort = None
    for name in ("encoder_bias", "delay"):
        sim2real.set_bounds(name, 0.0, 0.0)
    space = ParameterSpace.of(sim2real)
    truth = space.from_dict({**sim2real.sample_params, "encoder_bias": 0.0, "delay": 0.0})
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg)
    trees = independent_trees(env)
    recording = _simulated(env, space, truth, chirp(steps, env.step_dt), tuple(sim2real.joint_order))
    problem = Problem(
        task=TASK,
        plain_cfg=cfg,
        env_cfg=cfg,
        dataset=make_dataset([recording], train_fraction=1),
        space=space,
        trees=trees,
        delay_mode="command",
        control_dt=env.step_dt,
    )
    env.close()
    fitted = torch.cat([torch.arange(space.size)[space[name]] for name in FITTED])
    return DriveProblem(problem=problem, truth=truth, fitted=fitted)


def _simulated(
    env: ManagerBasedRLEnv, space: ParameterSpace, truth: torch.Tensor, targets: np.ndarray, joints: tuple[str, ...]
) -> Recording:
    steps = len(targets)
    still = Recording(
        name="chirp",
        joint_names=joints,
        time=np.arange(steps) * env.step_dt,
        dof_pos=np.repeat(targets[:1], steps, axis=0),
        des_dof_pos=targets,
    )
    still = conform_recording(still, joint_order=joints, control_dt=env.step_dt)
    rollout = Rollout(env, make_dataset([still], train_fraction=1), space)
    rollout.start(truth[None])
    positions = [sim_dof_pos[0].numpy().copy() for sim_dof_pos, _ in rollout]
    return replace(still, dof_pos=np.stack(positions))
