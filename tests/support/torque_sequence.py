"""One random sequence of commands, positions and velocities, and the drive that four simulators run on it.

Needs torch, numpy and ``pace_actuators`` alone: it is imported in other simulators' environments too.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

JOINTS = tuple(f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE"))
DT = 0.0025
ENVS, STEPS = 3, 60
GAINS = {"stiffness": 85.0, "damping": 0.6, "saturation_effort": 140.0, "effort_limit": 89.0, "velocity_limit": 8.5}
EFFECTS = ("drive_bandwidth", "torque_gain", "stribeck_friction")


def write_result(path: Path, delay_mode: str = "command", delay: float = 3.4) -> Path:
    """A result with bias, delay and effects, every joint another."""
    i = np.arange(len(JOINTS))

    def per_joint(values: np.ndarray) -> dict[str, float]:
        return dict(zip(JOINTS, values.tolist(), strict=True))

    parameters = {
        "armature": per_joint(0.05 + 0.005 * i),
        "viscous_friction": per_joint(0.4 + 0.05 * i),
        "friction": per_joint(0.3 + 0.02 * i),
        "encoder_bias": per_joint(0.08 * np.cos(i)),
        "delay": {"all": delay},
        "drive_bandwidth.time_constant": per_joint(0.003 + 0.0005 * i),
        "torque_gain.gain": per_joint(1 + 0.1 * np.sin(i)),
        "stribeck_friction.effort": per_joint(0.2 + 0.01 * i),
        "stribeck_friction.velocity": per_joint(0.2 + 0.02 * i),
    }
    content = {
        "version": 1,
        "task": "Pace-AnymalD-v0",
        "joint_names": list(JOINTS),
        "effects": list(EFFECTS),
        "delay_mode": delay_mode,
        "physics_dt": DT,
        "control_dt": DT,
        "parameters": parameters,
        "delay_s": delay * DT,
        "std": {name: {key: 0.01 for key in values} for name, values in parameters.items()},
        "drive": {name: dict.fromkeys(JOINTS, value) for name, value in GAINS.items()},
    }
    path.write_text(json.dumps(content))
    return path


def sequence() -> dict[str, np.ndarray]:
    """Commands and positions [rad] and velocities [rad/s], each (STEPS, ENVS, joints)."""
    rng = np.random.default_rng(7)
    shape = (STEPS, ENVS, len(JOINTS))
    return {
        "command": 0.6 * rng.standard_normal(shape),
        "position": 0.6 * rng.standard_normal(shape),
        "velocity": 4.0 * rng.standard_normal(shape),
    }
