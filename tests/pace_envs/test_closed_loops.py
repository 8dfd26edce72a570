"""Closed chains: passive joints start where the loops close."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from models import FINGER, FOUR_BAR

from pace_envs import ManagerBasedRLEnv
from pace_envs.from_model import cfg_from_model
from pace_envs.from_model.robot import at_rest
from pace_optim.problem.kinematic_trees import independent_trees
from pace_optim.problem.log_and_robot import refuse_open_loops
from pace_optim.recording import Recording


@pytest.fixture
def four_bar(tmp_path):
    path = tmp_path / "four_bar.xml"
    path.write_text(FOUR_BAR)
    cfg = cfg_from_model(path)
    cfg.scene.num_envs = 3
    env = ManagerBasedRLEnv(cfg)
    yield env
    env.close()


def test_a_closed_chain_starts_closed_wherever_its_crank_is(four_bar):
    robot, sim = four_bar.scene["robot"], four_bar.sim
    for position in (0.31, 0.8, 1.29):
        robot.write_joint_state_to_sim(
            torch.tensor([[position], [position - 1e-3], [position]], dtype=torch.double), torch.zeros(3, 1)
        )
        assert sim.qpos[:, 0].tolist() == pytest.approx([position, position - 1e-3, position], abs=1e-7)
        for row in sim.qpos.numpy():
            assert robot.closed_loops.gap(row)[0] < 1e-8


def test_passive_speeds_keep_the_chain_closed(four_bar):
    robot, sim = four_bar.scene["robot"], four_bar.sim
    robot.write_joint_state_to_sim(torch.full((3, 1), 0.8), torch.full((3, 1), 2.0))
    before, speed = sim.qpos[0].numpy().copy(), sim.qvel[0].numpy()
    assert np.abs(speed[1:]).min() > 0.1
    assert robot.closed_loops.gap(before + 1e-5 * speed)[0] < 1e-9


def test_the_assembly_is_the_one_that_the_model_or_the_configuration_has(four_bar):
    robot, sim = four_bar.scene["robot"], four_bar.sim
    robot.write_joint_state_to_sim(torch.full((3, 1), 0.8), torch.zeros(3, 1))
    own = sim.qpos[0].clone()
    cfg = four_bar.cfg
    cfg.scene.robot.init_state.joint_pos = {"crank": 0.8, "coupler": 0.2, "rocker": -2.8}
    other = ManagerBasedRLEnv(cfg)
    assert other.scene["robot"].closed_loops.gap(other.sim.qpos[0].numpy())[0] < 1e-8
    assert (other.sim.qpos[0, 1:] - own[1:]).abs().min() > 0.3
    other.close()


def test_what_a_spring_holds_against_a_stop_is_there_wherever_the_crank_is(tmp_path):
    """The loop leaves it free. It fell from the middle of its range at the beginning of every recording."""
    path = tmp_path / "finger.xml"
    path.write_text(FINGER)
    cfg = cfg_from_model(path)
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg)
    robot, sim = env.scene["robot"], env.sim
    tip = int(sim.model.joint("tip").qposadr[0])
    for position in (0.8, 0.7, 1.0):
        robot.write_joint_state_to_sim(torch.tensor([[position]]), torch.zeros(1, 1))
        assert robot.closed_loops.gap(sim.qpos[0].numpy())[0] < 1e-8
        assert float(sim.qpos[0, tip]) == pytest.approx(0.0, abs=1e-2)  # it was at -0.64
    resting = robot.closed_loops.following(sim.qpos[0].numpy())[:, 0]
    assert resting[tip] == 0.0 and np.abs(resting[1:]).max() > 0.1
    for off, still in ((-0.004, True), (-0.1, False)):  # it rattles; it has been pushed away
        moved = sim.qpos[0].numpy().copy()
        moved[tip] = off
        there = robot.closed_loops.following(robot.closed_loops.close(moved))[:, 0]
        assert (there[tip] == 0.0) == still and np.abs(there - resting).max() < (0.02 if still else 1.0)
    env.close()


def test_joints_without_drives_are_at_rest_where_a_robot_begins():
    """A pendulum on a held arm hangs, a spring has its own angle, and what is held stays."""
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><compiler angle="radian"/><default><joint axis="0 1 0"/><geom size="0.01"/></default><worldbody>
      <body><joint name="arm"/><geom type="capsule" fromto="0 0 0 0.2 0 0"/>
        <body pos="0.2 0 0"><joint name="swing"/><geom type="capsule" fromto="0 0 0 0.1 0 0"/></body></body>
      <body pos="0 1 0"><joint name="spring" axis="0 0 1" stiffness="1" springref="0.3"/><geom pos="0.1 0 0"/></body>
    </worldbody></mujoco>""")
    rest = at_rest(model, np.array([0.4, 0.0, 0.0]), ["arm"])
    assert rest.tolist() == pytest.approx([0.4, np.pi / 2 - 0.4, 0.3], abs=1e-4)
    assert at_rest(model, rest, ["arm", "swing", "spring"]) is rest


def test_a_loop_that_no_bias_closes_is_refused_with_its_distance(tmp_path):
    path = tmp_path / "short.xml"
    path.write_text(FOUR_BAR.replace("0 0 0 0.2 0 0", "0 0 0 0.12 0 0").replace('"tip" pos="0.2', '"tip" pos="0.12'))
    env = ManagerBasedRLEnv(cfg_from_model(path))
    good = Recording(
        name="reach", joint_names=("crank",), time=np.arange(30) / 400, dof_pos=np.full((30, 1), 0.8),
        des_dof_pos=np.full((30, 1), 0.8),
    )  # fmt: skip
    refuse_open_loops(env, [good])
    far = dataclasses.replace(good, dof_pos=np.full((30, 1), -1.57))
    with pytest.raises(ValueError, match=r"reach: .*\(connect of tip and end\) is open by 0\.0"):
        refuse_open_loops(env, [far])
    env.close()


TWO_ARMS = """
<mujoco><default><geom size="0.02"/></default><worldbody>{bodies}</worldbody>
  <equality><joint joint1="a1" joint2="a0"/><joint joint1="b0" joint2="c0"/></equality></mujoco>
""".format(
    bodies="".join(
        f'<body pos="{i} 0 0"><joint name="{arm}0"/><geom pos="0.1 0 0"/>'
        f'<body pos="0.2 0 0"><joint name="{arm}1" axis="0 1 0"/><geom pos="0.1 0 0"/></body></body>'
        for i, arm in enumerate("abc")
    )
)


def test_constraints_couple_the_trees_that_they_tie_and_no_others(tmp_path):
    path = tmp_path / "arms.xml"
    path.write_text(TWO_ARMS)
    env = ManagerBasedRLEnv(cfg_from_model(path))
    assert independent_trees(env) == [["a0"], ["b1", "c0", "c1"]]  # a1 and b0 follow
    env.close()
