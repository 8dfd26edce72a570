"""What each recording asks of the drives: their gains and limits, the torque that is asked, and what gravity takes."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import signal

from pace_actuators.identified import DRIVE_FIELDS
from pace_optim.problem.drive_facts import asked_torque, configured_drive, in_force
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.inverse_dynamics import LinkMotion, frame_motion, model_of
from pace_optim.problem.problem import Problem

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


_STRIDE = 10
"""Gravity is computed at every so many samples."""


def drive_loads(problem: Problem, evaluator: Evaluator, encoder_bias: np.ndarray) -> list[dict[str, Any]]:
    """Of each recording ``{"recording", "joints": {joint: {...}}}``, for ``drives.json``; torques in N m.

    What is asked is computed from what was recorded (:func:`pace_optim.problem.drive_facts.asked_torque`).

    Args:
        problem: Its recordings state the drives, with gains that were unknown as found.
        evaluator: Its environments hold each recording's load.
        encoder_bias: Of each joint, (n,) [rad].
    """
    rollout, configured = evaluator.rollout(1), configured_drive(problem.env_cfg, problem.joint_names)
    result = []
    for r, recording in enumerate(problem.dataset.recordings):
        dt = float(np.median(np.diff(recording.time)))
        position = smoothed(recording.dof_pos, dt)
        speed = np.gradient(position, dt, axis=0)
        drive = in_force(configured, recording)
        facts = {name: getattr(drive, name) for name in DRIVE_FIELDS}
        asked = asked_torque(drive, recording, speed, clip=False)
        still = np.zeros_like(position[::_STRIDE])
        model = model_of(rollout.env, r)
        gravity = LinkMotion.of(
            model, rollout.robot.joint_names, (position + encoder_bias)[::_STRIDE], still, still
        ).torque()
        joints = {}
        for j, name in enumerate(rollout.robot.joint_names):
            joints[name] = {
                **{field: float(values[j]) if np.isfinite(values[j]) else None for field, values in facts.items()},
                "asked_peak": float(np.abs(asked[:, j]).max()),
                "asked_rms": float(np.sqrt(np.mean(asked[:, j] ** 2))),
                "gravity_peak": float(np.abs(gravity[:, j]).max()),
                "speed_peak": float(np.abs(speed[:, j]).max()),
            }
        result.append({"recording": recording.name, "joints": joints})
    rollout.env.close()
    return result
