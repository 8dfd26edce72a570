"""The torque that a joint's load takes: to hold it against gravity and to move its mass."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy import signal

from pace_envs import ManagerBasedEnv
from pace_optim.problem.evaluator import Evaluator

_CUTOFF = 10.0
_MODEL_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos")
"""What a recording's load may change."""


def load_torques(evaluator: Evaluator, encoder_bias: np.ndarray) -> list[np.ndarray]:
    """Inverse dynamics of the robot along each measured motion, (K, n) [N m] per recording.

        τ = M(q) q̈ + c(q, q̇) + g(q)

    of the links alone: without armature, friction and damping, which belong to the drive. Positions are smoothed below
    10 Hz without delay before they are differentiated.

    Args:
        evaluator: Of the run's problem; its environments hold each recording's load.
        encoder_bias: Of each joint, (n,) [rad].
    """
    rollout = evaluator.rollout(1)
    joints = rollout.robot.joint_names
    result = []
    for r, recording in enumerate(rollout.dataset.recordings):
        model = model_of(rollout.env, r)
        dt = float(recording.time[1] - recording.time[0])
        position = smoothed(recording.dof_pos, dt) + encoder_bias
        speed = np.gradient(position, dt, axis=0)
        acceleration = np.gradient(speed, dt, axis=0)
        result.append(inverse_dynamics(model, joints, position, speed, acceleration))
    return result


def smoothed(position: np.ndarray, dt: float) -> np.ndarray:
    """Positions (K, n) low-passed without delay."""
    nyquist = 0.5 / dt
    cutoff = min(_CUTOFF, 0.4 * nyquist)
    filter_ = signal.butter(3, cutoff / nyquist, output="sos")
    return signal.sosfiltfilt(filter_, position, axis=0, padlen=min(len(position) - 1, round(3 / (cutoff * dt))))


def model_of(env: ManagerBasedEnv, row: int) -> mujoco.MjModel:
    """One environment's model, with drives that neither weigh nor rub."""
    model = copy.deepcopy(env.sim.model)
    for name in _MODEL_FIELDS:
        getattr(model, name)[:] = env.sim.expand(name)[row].numpy().reshape(getattr(model, name).shape)
    for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
        getattr(model, name)[:] = 0.0
    return model


def inverse_dynamics(
    model: mujoco.MjModel, joints: Sequence[str], position: np.ndarray, speed: np.ndarray, acceleration: np.ndarray
) -> np.ndarray:
    """Torques of some joints that make a model move as given, (K, n) [N m]; positions, speeds and so on (K, n)."""
    data = mujoco.MjData(model)
    qpos = [model.joint(name).qposadr[0] for name in joints]
    dof = [model.joint(name).dofadr[0] for name in joints]
    torque = np.empty_like(position)
    for k in range(len(position)):
        data.qpos[qpos], data.qvel[dof], data.qacc[dof] = position[k], speed[k], acceleration[k]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse[dof]
    return torque
