"""Which joints influence each other is read off the model."""

import dataclasses

import pytest
from problems import env_cfg, pendulums_cfg

from pace_envs import ManagerBasedRLEnv
from pace_optim.problem.kinematic_trees import independent_trees


def trees(cfg):
    env = ManagerBasedRLEnv(cfg)
    found = independent_trees(env)
    env.close()
    return found


@pytest.mark.parametrize("task", ["Pace-AnymalD-v0", "Pace-Go2-v0"])
def test_the_legs_of_a_robot_whose_base_is_fixed_are_four_trees_of_three_joints(task):
    cfg = env_cfg(task)
    found = trees(cfg)
    assert [len(tree) for tree in found] == [3, 3, 3, 3]
    assert all(len({name.split("_")[0] for name in tree}) == 1 for tree in found)
    assert sorted(name for tree in found for name in tree) == sorted(cfg.sim2real.joint_order)


def test_an_arm_is_one_tree():
    assert trees(env_cfg("Pace-SO101-v0")) == [list(env_cfg("Pace-SO101-v0").sim2real.joint_order)]


def test_trees_follow_the_joint_order_and_not_the_model():
    cfg = env_cfg("Pace-AnymalD-v0")
    order = tuple(reversed(cfg.sim2real.joint_order))
    cfg.sim2real = dataclasses.replace(cfg.sim2real, joint_order=order)
    assert trees(cfg)[0] == ["RH_KFE", "RH_HFE", "RH_HAA"]


def test_legs_on_a_floating_base_are_one_tree(monkeypatch):
    cfg = env_cfg("Pace-AnymalD-v0")
    cfg.prepare()
    monkeypatch.setattr(type(cfg), "prepare", lambda self: None)  # which fixes the base
    cfg.scene.robot = dataclasses.replace(cfg.scene.robot, fix_base=False)
    assert [len(tree) for tree in trees(cfg)] == [12]


def test_pendulums_side_by_side_are_two_trees(tmp_path):
    assert trees(pendulums_cfg(tmp_path)) == [["left"], ["right"]]


@pytest.mark.parametrize(
    "more",
    [
        '<equality><joint joint1="left" joint2="right"/></equality>',
        '<equality><connect site1="left_tip" site2="right_tip"/></equality>',
        '<tendon><fixed><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed></tendon>',
    ],
)
def test_equality_constraints_and_tendons_tie_trees_together(more, tmp_path):
    assert trees(pendulums_cfg(tmp_path, more)) == [["left", "right"]]


def test_contacts_tie_trees_together(tmp_path):
    cfg = pendulums_cfg(tmp_path)
    cfg.sim.contacts = True
    assert trees(cfg) == [["left", "right"]]
