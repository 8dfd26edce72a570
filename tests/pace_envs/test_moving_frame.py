"""A robot on a base that moves: its joints feel what they feel on a free base that moves so."""

import mujoco
import numpy as np
import pytest

from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.moving_frame import FIELDS, FrameState, bias_in_frame

ANYMAL = ASSETS_DIR / "anymal_d" / "anymal_d.xml"


def models():
    """The robot with a free base, and with one that is at rest in the world's axes."""
    free = mujoco.MjSpec.from_file(str(ANYMAL))
    held = mujoco.MjSpec.from_file(str(ANYMAL))
    for spec in (free, held):
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    held.delete(held.joint("root"))
    held.body("base").pos = [0.1, -0.2, 0.3]
    held.body("base").quat = [0.6, 0.0, 0.8, 0.0]
    return free.compile(), held.compile()


def state_of(model, data):
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    shape = {"cdof": 6, "cdof_dot": 6, "cvel": 6, "cinert": 10, "subtree_com": 3}
    fields = {name: np.array(getattr(data, name)) for name in FIELDS}
    return FrameState(**{k: v.reshape(1, -1, shape[k]) if k in shape else v[None] for k, v in fields.items()})


def test_joints_need_the_torque_that_they_need_on_a_free_base():
    free, held = models()
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, v, a = rng.normal(0, 0.5, 12), rng.normal(0, 3, 12), rng.normal(0, 30, 12)
        data = mujoco.MjData(free)
        data.qpos[:3], data.qpos[3:7] = rng.normal(size=3), rng.normal(size=4)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qpos[7:], data.qvel[6:] = q, v
        data.qvel[:6], data.qacc[:6], data.qacc[6:] = rng.normal(0, 2, 6), rng.normal(0, 20, 6), a
        acceleration, linear, rotation, turning = data.qacc.copy(), data.qacc[:3].copy(), data.qvel[3:6], data.qacc[3:6]
        mujoco.mj_inverse(free, data)
        expected = data.qfrc_inverse[6:]
        # what an IMU at some place of the base shows, in its frame
        place = rng.normal(0, 0.2, 3)
        to_base = data.body("base").xmat.reshape(3, 3).T
        force = to_base @ (linear - free.opt.gravity)
        force = force + np.cross(turning, place) + np.cross(rotation, np.cross(rotation, place))

        there = mujoco.MjData(held)
        there.qpos[:], there.qvel[:] = q, v
        state = state_of(held, there)
        base = there.body("base")
        axes = base.xmat.reshape(3, 3)
        motion = np.concatenate([axes @ each for each in (rotation, turning, force)])[None]
        bias = bias_in_frame(held, state, motion, base.xpos + axes @ place)[0]
        mass = np.zeros((12, 12))
        mujoco.mj_fullM(held, there, mass)
        found = mass @ acceleration[6:] + bias - there.qfrc_passive
        assert found == pytest.approx(expected, abs=1e-10)


def test_a_base_at_rest_leaves_the_bias_of_mujoco():
    _, held = models()
    data = mujoco.MjData(held)
    data.qpos[:], data.qvel[:] = np.linspace(-0.5, 0.5, 12), np.linspace(-3, 3, 12)
    state = state_of(held, data)
    motion = np.array([[0, 0, 0, 0, 0, 0, 0, 0, 9.81]], dtype=float)
    assert bias_in_frame(held, state, motion, np.ones(3))[0] == pytest.approx(data.qfrc_bias, abs=1e-12)
