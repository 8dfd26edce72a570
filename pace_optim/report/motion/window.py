"""MuJoCo's own viewer: the simulated robot, and the measured one as a ghost over it."""

from __future__ import annotations

import time

import mujoco
import numpy as np

from .motion import Motion
from .scene import scalar_joints

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
