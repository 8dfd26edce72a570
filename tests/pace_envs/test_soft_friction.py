"""Soft friction is that of MuJoCo's own constraint, in steps of second order, beside hard friction too."""

import mujoco
import numpy as np
import pytest
import torch

from pace_envs.simulation import SimulationCfg, make_simulation

ARM = """
<mujoco><worldbody><body>
  <joint name="shoulder" axis="0 1 0" armature="0.05" frictionloss="0.6" damping="0.4"/>
  <inertial pos="0 0 -0.2" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
  <body pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" armature="0.02" frictionloss="0.3" damping="0.05"/>
    <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body>
</body></worldbody></mujoco>
"""
EVERY, STEPS = 0.0025, 400
"""Time for which torques are held [s], and how often they change."""


def torques():
    """(STEPS, 2) [N m]; at times less than what friction holds."""
    time = np.arange(STEPS)[:, None] * EVERY
    return np.array([2.5, 0.9]) * np.sin(2 * np.pi * (np.array([1.1, 1.7]) * time + [0.0, 0.2]))


def plain(soft, dt=1e-5):
    """Positions in plain MuJoCo, (STEPS, 2): friction as by default on some joints, hard on others."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.timestep, model.opt.integrator = dt, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    hard = [j for j in (0, 1) if j not in soft]
    model.dof_solref[hard, 0], model.dof_solimp[hard, :2] = 2 * dt, 0.999
    data, seen = mujoco.MjData(model), []
    for torque in torques():
        data.qfrc_applied[:] = torque
        for _ in range(round(EVERY / dt)):
            mujoco.mj_step(model, data)
        seen.append(data.qpos.copy())
    return np.array(seen)


def ours(soft, dt, integrator="leapfrog"):
    """The same in a simulation of this project, of the second of two environments; all is hard in the first."""
    cfg = SimulationCfg(dt=dt, integrator=integrator)
    sim, seen = make_simulation(cfg, mujoco.MjSpec.from_string(ARM), 2), []
    if soft:
        time = torch.zeros(2, 2, dtype=torch.float64)
        time[1, list(soft)] = 0.02
        sim.soften_friction(slice(None), time)
    for torque in torques():
        sim.qfrc_applied[:] = torch.as_tensor(torque)
        for _ in range(round(EVERY / dt)):
            sim.step()
        seen.append(sim.qpos.clone())
    sim.close()
    return torch.stack(seen, dim=1).numpy()


@pytest.mark.slow
@pytest.mark.parametrize("soft", [(0, 1), (0,), (1,)], ids=["both", "shoulder", "elbow"])
def test_soft_friction_moves_as_plain_mujoco_with_fine_steps(soft):
    expected, hard = plain(soft), ours((), EVERY)[1]
    coarse, fine = (np.abs(ours(soft, EVERY / parts)[1] - expected).max() for parts in (1, 4))
    shows = np.abs(hard - expected).max()
    assert shows > 5e-3
    assert coarse < 0.03 * shows and fine < 0.005 * shows


def test_hard_environments_beside_soft_ones_stay_hard():
    alone, beside = ours((), EVERY)[0], ours((0, 1), EVERY)[0]
    assert np.abs(beside - alone).max() < 1e-5


def test_steps_of_mujoco_with_soft_friction_are_mujocos_own():
    """With the constraint's law at the step that it has here."""
    found = ours((0, 1), EVERY, "implicitfast")[1]
    model = mujoco.MjModel.from_xml_string(ARM)
    rate = 2 / (0.95 * 0.02)
    late = 1 + rate * EVERY / 2
    impedance = 1 / (1 + 1 / 9 / late)
    model.dof_solref[:, 0], model.dof_solimp[:, :2] = 2 * late / (impedance * rate), impedance
    model.opt.timestep, model.opt.integrator = EVERY, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, seen = mujoco.MjData(model), []
    for torque in torques():
        data.qfrc_applied[:] = torque
        mujoco.mj_step(model, data)
        seen.append(data.qpos.copy())
    assert np.abs(found - np.array(seen)).max() < 1e-9
