"""The torque that a joint's load takes: to hold it against gravity and to move its mass."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy import signal

from pace_envs import ManagerBasedEnv
from pace_envs.motor_coordinates import DrivenJoints
from pace_envs.moving_frame import FrameState, bias_in_frame
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
        frame = None if recording.frame is None else frame_motion(recording.frame[recording.sample_steps], dt)
        point = recording.frame_point
        result.append(inverse_dynamics(model, joints, position, speed, acceleration, frame, point))
    return result


def frame_motion(frame: np.ndarray, dt: float) -> np.ndarray:
    """Angular velocity, angular acceleration and specific force, (K, 9), of the first and the last of them, (K, 6)."""
    return np.concatenate([frame[:, :3], np.gradient(frame[:, :3], dt, axis=0), frame[:, 3:]], axis=1)


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
    env.scene["robot"].driven.clear(model)
    return model


def inverse_dynamics(
    model: mujoco.MjModel,
    joints: Sequence[str],
    position: np.ndarray,
    speed: np.ndarray,
    acceleration: np.ndarray,
    frame: np.ndarray | None = None,
    point: np.ndarray | None = None,
) -> np.ndarray:
    """Torques of some joints that make a model move as given, (K, n) [N m].

    Args:
        model: The links.
        joints: Names, (n,); motors that move several joints among them.
        position: (K, n) [rad].
        speed: (K, n) [rad/s].
        acceleration: (K, n) [rad/s²].
        frame: How the model's frame moves, (K, 9): see :mod:`pace_envs.moving_frame`; ``None``: it rests.
        point: Where its specific force acts, (3,) [m].
    """
    data, driven = mujoco.MjData(model), DrivenJoints.of_model(model, joints)
    qpos = [model.joint(name).qposadr[0] for name in driven.joints]
    dof = [model.joint(name).dofadr[0] for name in driven.joints]
    position, speed, acceleration = (driven.to_joints(each) for each in (position, speed, acceleration))
    torque = np.empty_like(position)
    moves = frame is not None and point is not None
    state = FrameState.empty(model, len(position) if moves else 0)
    for k in range(len(position)):
        data.qpos[qpos], data.qvel[dof], data.qacc[dof] = position[k], speed[k], acceleration[k]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse[dof]
        if moves:
            torque[k] -= data.qfrc_bias[dof]
            state.keep(k, data)
    if frame is not None and point is not None:
        torque = torque + bias_in_frame(model, state, frame, point)[:, dof]
    return driven.efforts_of_motors(torque)
