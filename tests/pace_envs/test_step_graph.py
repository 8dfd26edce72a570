"""Tensors that a step replaces come back to where a CUDA graph finds them; here without a graph."""

from types import SimpleNamespace

import torch

from pace_envs.step_graph import Homes


def test_what_a_step_replaces_comes_home_and_nothing_shares_its_place():
    drive = SimpleNamespace(
        torque=torch.zeros(2), last={"fell": torch.ones(2)}, gain=torch.ones(2), silent=set(), held=None
    )
    drive.shown = drive.torque
    env = SimpleNamespace(before=torch.zeros(1), steps=0)
    homes = Homes([drive], env)
    keys = []
    for _ in range(5):
        keys.append(homes.key())
        old = drive.torque
        drive.torque, drive.shown = old + drive.gain, old * 1.0
        drive.last["fell"], drive.held = drive.torque * 2.0, drive.torque + 5.0
        env.before, env.steps = env.before + 1.0, env.steps + 1
        homes.settle()
    assert keys[2] == keys[3] == keys[4]  # the first steps give each tensor a place of its own
    assert drive.torque.tolist() == [5.0, 5.0] and drive.shown.tolist() == [4.0, 4.0] and env.before.tolist() == [5.0]
    assert drive.last["fell"].tolist() == [10.0, 10.0] and drive.held.tolist() == [10.0, 10.0]
    home, drive.torque = drive.torque, torch.full((2,), 9.0)  # somebody else replaces it
    assert homes.key() == keys[-1] and drive.torque is home and home.tolist() == [9.0, 9.0]


def test_a_graph_is_of_no_use_after_another_number_name_or_parameter():
    drive = SimpleNamespace(mode="on", calls=0, gain=torch.ones(2), silent=set())
    homes = Homes([drive])
    key = homes.key()
    assert homes.key() == key
    drive.silent.add("efforts")
    drive.calls = 3
    changes = {name: value for _, name, value in homes.changes()}
    assert changes == {"calls": 3, "silent": frozenset({"efforts"})}
    assert homes.key() != key
    drive.silent.clear()
    drive.calls = 0
    assert homes.key() == key
    drive.gain = torch.ones(2)
    assert homes.key() != key
