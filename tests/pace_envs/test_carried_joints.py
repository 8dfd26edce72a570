"""A drive carries the joints that follow its own by a ratio, in every simulation of it."""

import mujoco
import numpy as np
import pytest
import torch

from pace_envs import ManagerBasedRLEnv
from pace_envs.compiler import host
from pace_envs.from_model import cfg_from_model
from pace_envs.from_model.robot import read_robot
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.problem.inverse_dynamics import LinkMotion
from pace_optim.problem.problem import load_problem

FINGER = """
<mujoco><compiler angle="radian"/><worldbody><body name="a">
  <joint name="root" axis="0 1 0" range="-1 1"/><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.006" mass="0.3"/>
  <body name="b" pos="0.2 0 0"><joint name="tip" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.005" mass="0.4"/></body></body></worldbody>
<equality><joint joint1="tip" joint2="root" polycoef="0.3 1.5 0 0 0"/></equality>
<actuator><position joint="root" kp="60" kv="1.5"/></actuator></mujoco>
"""


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "finger.xml"
    path.write_text(FINGER)
    return path


def test_the_load_of_a_driven_joint_is_that_of_inverse_dynamics(model):
    env = ManagerBasedRLEnv(cfg_from_model(model))
    robot = env.scene["robot"]
    still = np.zeros((1, 1))
    for position in (-0.5, 0.0, 0.7):
        robot.write_joint_state_to_sim(torch.tensor([[position]]), torch.zeros(1, 1))
        env.sim.step()  # the torques are those at its beginning
        expected = LinkMotion.of(env.sim.model, ["root"], np.array([[position]]), still, still).torque()
        assert -robot.load_effort.item() == pytest.approx(expected.item(), rel=1e-3)


def test_the_scale_of_a_joint_has_what_follows_it(model):
    (joint,), compiled = read_robot(model).joints, mujoco.MjModel.from_xml_path(str(model))
    at = np.array([[joint.home]])
    still, unit = np.zeros((1, 1)), np.ones((1, 1))
    gravity = LinkMotion.of(compiled, ["root"], at, still, still).torque().item()
    assert joint.gravity == pytest.approx(abs(gravity))
    assert joint.inertia == pytest.approx(LinkMotion.of(compiled, ["root"], at, still, unit).torque().item() - gravity)


@pytest.mark.slow
def test_compiled_drives_and_joints_alone_carry_them_too(model, tmp_path, monkeypatch):
    """What a controller compensates of gravity is the same in the environment, compiled, and of joints alone."""
    monkeypatch.setattr(host, "_PATIENCE", 0)
    time = np.arange(0, 2, 0.0025)
    target = 0.4 + 0.05 * np.sin(2 * np.pi * time)[:, None]
    np.savez(tmp_path / "log.npz", time=time, joint_names=["root"], dof_pos=target, des_dof_pos=target)
    log = tmp_path / "log.npz"
    problem = load_problem(str(model), data=[log], effects=["gravity_compensation"], tell=lambda _: None)
    values = problem.space.to_physical(problem.space.start)
    values[problem.space.labels.index("gravity_compensation.share/root")] = 0.9
    errors = []
    for compiled in (True, False):
        evaluator = problem.evaluator()
        rollout = evaluator.rollout(1)
        if not compiled:
            rollout._compiled.positions = lambda *_, **__: None
        errors.append(evaluator.residuals(values[None]).error)
    torch.testing.assert_close(*errors, atol=1e-9, rtol=0)
    twin = twin_problem(problem, reference_path(problem, values))
    alone = twin.evaluator().residuals(values[None]).error
    assert float((alone - errors[0]).abs().max()) < 0.02 * float(errors[0].abs().max())
