"""Torques along a motion: passive joints that constraints tie stand on them, and the driven joints carry them."""

import mujoco
import numpy as np
import pytest

from pace_envs.closed_loops import ClosedLoops
from pace_optim.problem.inverse_dynamics import LinkMotion

FINGER = """
<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody><body name="a">
  <joint name="root" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.05 0 0" size="0.006" mass="0.006"/>
  <body name="b" pos="0.05 0 0"><joint name="tip" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0.04 0 0" size="0.005" mass="0.004"/></body></body></worldbody>
<equality><joint joint1="tip" joint2="root" polycoef="0.72 1.06 {curved} 0 0"/></equality></mujoco>
"""
FOUR_BAR = """
<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody>
  <body name="a"><joint name="root" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.1"/>
    <body name="c" pos="0 0 0.1"><joint name="knee" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.01" mass="0.2"/>
      <site name="end" pos="0.25 0 0"/></body></body>
  <body name="d" pos="0.25 0 -0.05"><joint name="rear" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.15" size="0.01" mass="0.1"/><site name="top" pos="0 0 0.15"/></body>
</worldbody><equality><connect site1="end" site2="top"/></equality></mujoco>
"""
ROOT = ["root"]


@pytest.fixture(params=[FINGER.format(curved=0), FINGER.format(curved=0.1), FOUR_BAR])
def model(request):
    return mujoco.MjModel.from_xml_string(request.param)


def _energy(model, position, speed):
    """Of the links on their constraints, (K,) [J]: potential and kinetic."""
    loops, data, result = ClosedLoops.of_model(model, [0]), mujoco.MjData(model), []
    posture = model.qpos0.copy()
    for q, v in zip(position, speed, strict=True):
        posture[0] = q
        posture = loops.close(posture)
        data.qpos[:], data.qvel[:] = posture, loops.following(posture)[:, 0] * v
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        result.append(data.energy.sum())
    return np.array(result)


@pytest.mark.slow
def test_what_gravity_takes_is_the_slope_of_the_potential_energy(model):
    position, still = np.linspace(-0.3, 0.6, 901)[:, None], np.zeros((901, 1))
    torque = LinkMotion.of(model, ROOT, position, still, still).torque()[:, 0]
    slope = np.gradient(_energy(model, position[:, 0], still[:, 0]), position[:, 0])
    np.testing.assert_allclose(torque[1:-1], slope[1:-1], atol=1e-4 * np.abs(slope).max())


@pytest.mark.slow
def test_the_power_of_the_torque_is_the_change_of_the_energy(model):
    time = np.linspace(0.0, 1.0, 2001)
    position = 0.2 + 0.3 * np.sin(2 * np.pi * 3 * time)[:, None]
    speed = np.gradient(position, time, axis=0)
    acceleration = np.gradient(speed, time, axis=0)
    power = (LinkMotion.of(model, ROOT, position, speed, acceleration).torque() * speed)[:, 0]
    change = np.gradient(_energy(model, position[:, 0], speed[:, 0]), time)
    np.testing.assert_allclose(power[5:-5], change[5:-5], atol=1e-3 * np.abs(change).max())
