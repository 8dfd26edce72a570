"""Where joints without drives are when a robot is held still: what springs, weight and stops leave them."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

_STEP = 1e-3
"""Of the simulation that comes to rest [s]."""
_LONGEST = 10.0
"""It takes this long at most [s]."""
_LOOK = 200
"""Steps between two looks at whether it rests, ..."""
_STILL = 1e-7
"""which it does where nothing has moved further in between [rad or m]."""
_HEAVY = 1e6
"""Inertia that holds joints [kg m²]."""


def at_rest(model: mujoco.MjModel, posture: np.ndarray, driven: Sequence[str]) -> np.ndarray:
    """A posture (nq,) with the joints without drives at rest, the others held where they are.

    A recording begins at rest, and loops alone do not say where a finger's links are that its spring pushes against a
    stop. They fall, and are stopped where their energy is highest (dynamic relaxation), until nothing moves.

    Args:
        model: The model.
        posture: Where it begins.
        driven: Joints that are held; so is a floating base.
    """
    own = copy.copy(model)
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    own.opt.timestep, own.opt.integrator = _STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    free = np.flatnonzero([_is_free(model, int(joint), driven) for joint in model.dof_jntid])
    if not len(free):
        return posture
    places = [a for j in set(model.dof_jntid[free]) for a in _places(model, int(j))]
    held = np.setdiff1d(np.arange(model.nv), free)
    own.dof_armature[held] = _HEAVY
    own.dof_damping[free] = own.dof_frictionloss[free] = 0.0
    own.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(own)
    mujoco.mj_setConst(own, data)
    data.qpos[:] = last = posture
    fastest = 0.0
    for step in range(1, round(_LONGEST / _STEP) + 1):
        mujoco.mj_step(own, data)
        energy = float(data.energy[1])
        if energy < fastest:
            data.qvel[:] = 0.0
        fastest = energy if energy >= fastest else 0.0
        if step % _LOOK == 0:
            if not np.isfinite(data.qpos).all():
                return posture
            moved, last = np.abs(data.qpos - last)[places].max(), data.qpos.copy()
            if moved < _STILL:
                break
    result = posture.copy()
    result[places] = last[places]
    return result


def _places(model: mujoco.MjModel, joint: int) -> range:
    """Where a joint's position is in qpos."""
    first = int(model.jnt_qposadr[joint])
    return range(first, first + (4 if int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_BALL else 1))


def _is_free(model: mujoco.MjModel, joint: int, driven: Sequence[str]) -> bool:
    """Whether a joint has no drive; a floating base does not count."""
    return int(model.jnt_type[joint]) != mujoco.mjtJoint.mjJNT_FREE and model.joint(joint).name not in driven
