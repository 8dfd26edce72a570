"""What the joints of a robot did, measured and simulated, at a screen's rate."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from pace_envs.closed_loops import ClosedLoops
from pace_envs.motor_coordinates import DrivenJoints
from pace_optim.run.tensors import RecordingData

from .scene import scalar_joints

_RATE = 50.0
"""Pictures a second of recorded time [Hz]."""
_MOST_PICTURES = 3000
"""Of one recording: a longer one is shown at fewer pictures a second."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """One recording at K instants, all m hinge and slide joints of the model in its order."""

    name: str
    """The recording's name."""
    time: np.ndarray
    """(K,) [s]."""
    measured: np.ndarray
    """Measured positions of the joints themselves, (K, m) [rad or m]."""
    simulated: np.ndarray
    """Simulated joint positions, (K, m) [rad or m]."""
    base: np.ndarray | None = None
    """Position [m] and quaternion of a base that moves, (K, 7)."""
    standing: np.ndarray | None = None
    """Which of its feet touch the ground, (K, feet) bool."""
    feet: tuple[Mapping[str, Any], ...] = ()
    """``body``, by index, and ``pos`` [m] of each foot."""


def motions_of(
    model: mujoco.MjModel,
    joint_names: Sequence[str],
    recordings: Sequence[RecordingData],
    encoder_bias: Sequence[float],
) -> list[Motion]:
    """What a page shows of each recording.

    Joints that no encoder measures stand at their home position; where the model closes loops they follow the measured
    ones.

    Args:
        joint_names: The n joints that were measured.
        encoder_bias: An encoder shows its joint's position less this, (n,) [rad or m].
    """
    driven = DrivenJoints.of_model(model, joint_names)
    columns = _columns(model, driven.joints)
    home = _home(model)
    bias = np.asarray(encoder_bias, dtype=float)
    return [_motion(model, driven, columns, home, recording, bias) for recording in recordings]


def _motion(
    model: mujoco.MjModel,
    driven: DrivenJoints,
    columns: np.ndarray,
    home: np.ndarray,
    recording: RecordingData,
    bias: np.ndarray,
) -> Motion:
    time = recording.time - recording.time[0]
    count = int(min(max(2, np.ceil(time[-1] * _RATE)), len(time), _MOST_PICTURES))
    kept = np.unique(np.searchsorted(time, np.linspace(0.0, time[-1], count)).clip(max=len(time) - 1))
    positions = []
    for shown in (recording.measured, recording.measured + recording.error):
        whole = np.tile(home, (len(kept), 1))
        whole[:, columns] = driven.to_joints(np.nan_to_num(shown[kept] + bias))
        positions.append(_closed(model, columns, whole) if model.neq else whole)
    return Motion(
        name=recording.name,
        time=time[kept],
        measured=positions[0],
        simulated=positions[1],
        base=None if recording.base is None else recording.base[kept],
        standing=None if recording.standing is None else recording.standing[kept],
        feet=tuple({**foot, "body": int(model.body(foot["body"]).id)} for foot in recording.feet),
    )


def _columns(model: mujoco.MjModel, joint_names: Sequence[str]) -> np.ndarray:
    names = [model.joint(j).name for j in scalar_joints(model)]
    return np.array([names.index(name) for name in joint_names], dtype=int)


def _home(model: mujoco.MjModel) -> np.ndarray:
    """Positions of the hinge and slide joints in the first keyframe, else in the model's reference."""
    qpos = model.key_qpos[0] if model.nkey else model.qpos0
    return qpos[model.jnt_qposadr[scalar_joints(model)]]


def _closed(model: mujoco.MjModel, columns: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """The same with the joints that no encoder measures where loops close, each instant from the one before."""
    joints = np.array(scalar_joints(model))
    free = np.setdiff1d(np.arange(len(joints)), columns)
    loops = ClosedLoops.of_model(model, np.setdiff1d(np.arange(model.nv), model.jnt_dofadr[joints[free]]).tolist())
    if loops is None:
        return positions
    result, posture, address = positions.copy(), model.qpos0.copy(), model.jnt_qposadr[joints]
    for k, row in enumerate(result):
        row[free] = result[max(k - 1, 0), free]
        posture[address] = row
        row[free] = loops.nearest(posture)[address[free]]
    return result


_GHOST = (0.25, 0.5, 0.85, 0.3)


def watch(model: mujoco.MjModel, motion: Motion, speed: float) -> None:
    """Play one recording again and again until the window is closed.

    Args:
        speed: 1 is real time.
    """
    from mujoco import viewer

    address = model.jnt_qposadr[scalar_joints(model)]
    shown, ghost = mujoco.MjData(model), mujoco.MjData(model)
    with viewer.launch_passive(model, shown, show_left_ui=False, show_right_ui=False) as window:
        start = time.perf_counter()
        while window.is_running():
            at = ((time.perf_counter() - start) * speed) % float(motion.time[-1])
            k = int(np.searchsorted(motion.time, at).clip(max=len(motion.time) - 1))
            with window.lock():
                shown.qpos[address], ghost.qpos[address] = motion.simulated[k], motion.measured[k]
                mujoco.mj_kinematics(model, shown)
                add_ghost(model, ghost, window.user_scn)
            window.sync()
            time.sleep(1 / 60)


def add_ghost(model: mujoco.MjModel, ghost: mujoco.MjData, scene: mujoco.MjvScene) -> None:
    """Replace what a scene shows by the visible shapes of a robot, see-through and of one colour."""
    mujoco.mj_kinematics(model, ghost)
    scene.ngeom = 0
    category = mujoco.mjtCatBit.mjCAT_DYNAMIC
    mujoco.mjv_addGeoms(model, ghost, mujoco.MjvOption(), mujoco.MjvPerturb(), category, scene)
    for i in range(scene.ngeom):
        scene.geoms[i].rgba[:] = _GHOST
