"""A robot's exported file in plain MuJoCo, with nothing of this project: targets in, positions out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np


def fixed_in_the_air(xml: str, change: Callable[[mujoco.MjSpec], None] = lambda spec: None) -> mujoco.MjModel:
    """The model with its base held and without contacts, as in the recording."""
    spec = mujoco.MjSpec.from_string(xml)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    change(spec)
    return spec.compile()


def replay(model: mujoco.MjModel, joints: Sequence[str], targets: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Joint positions before each step, (steps, joints).

    Args:
        model: The model, with its actuators.
        joints: The joints.
        targets: One per step, (steps, joints).
        start: Positions at the start, at rest, (joints,).
    """
    data = mujoco.MjData(model)
    places = [int(model.joint(name).qposadr[0]) for name in joints]
    drives = [drive_of(model, name) for name in joints]
    data.qpos[places] = start
    for drive, first in zip(drives, targets[0], strict=True):
        if samples := int(model.actuator_history[drive, 0]):
            mujoco.mj_initCtrlHistory(model, data, drive, None, np.full(samples, first))
    positions = []
    for target in targets:
        positions.append(data.qpos[places].copy())
        data.ctrl[drives] = target
        mujoco.mj_step(model, data)
    return np.array(positions)


def drive_of(model: mujoco.MjModel, joint: str) -> int:
    """The joint's one actuator that a control moves."""
    moves = (model.actuator_gaintype != mujoco.mjtGain.mjGAIN_FIXED) | (model.actuator_gainprm[:, 0] != 0)
    (drive,) = np.flatnonzero((model.actuator_trnid[:, 0] == model.joint(joint).id) & moves)
    return int(drive)
