"""The torque that a joint's load takes: to hold it against gravity and to move its mass."""

from __future__ import annotations

import numpy as np
from scipy import signal

from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.inverse_dynamics import LinkMotion, frame_motion, model_of

_CUTOFF = 10.0


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
        result.append(LinkMotion.of(model, joints, position, speed, acceleration).torque(frame, point))
    return result


def smoothed(position: np.ndarray, dt: float) -> np.ndarray:
    """Positions (K, n) low-passed without delay."""
    nyquist = 0.5 / dt
    cutoff = min(_CUTOFF, 0.4 * nyquist)
    filter_ = signal.butter(3, cutoff / nyquist, output="sos")
    return signal.sosfiltfilt(filter_, position, axis=0, padlen=min(len(position) - 1, round(3 / (cutoff * dt))))
