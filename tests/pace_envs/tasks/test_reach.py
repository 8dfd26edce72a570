"""An arm reaches: places, rewards, training and judging."""

import pytest
import torch

from pace_envs import ManagerBasedRLEnv, load_env_cfg, robot_cfg_from_model
from pace_envs.rl import RunSettings, load_cfg, train
from pace_envs.rl.playing import PlaySettings, play
from pace_envs.tasks.reach.reach_env_cfg import (
    COMMAND,
    closeness,
    distance,
    reach_env_cfg,
    site_position,
    to_command,
)

TASK = "Pace-SO101-Reach-v0"
WHERE = {"command_name": COMMAND, "site": "gripper_frame"}


@pytest.fixture
def env():
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.sim.num_threads, cfg.seed = 4, 1, 0
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    yield env
    env.close()


def test_commands_are_places_above_the_table_that_differ(env):
    command = env.command_manager.get_command(COMMAND)
    assert command.shape == (4, 3) and float(command[:, 2].min()) >= 0.03
    assert float(torch.cdist(command, command).max()) > 0.05


def test_terms_are_the_way_its_length_and_a_bell(env):
    way = to_command(env, **WHERE)
    assert torch.allclose(way, env.command_manager.get_command(COMMAND) - site_position(env, "gripper_frame"))
    length = way.norm(dim=1)
    assert torch.allclose(distance(env, **WHERE), length)
    assert torch.allclose(closeness(env, **WHERE, std=0.1), 1 - torch.tanh(length / 0.1))


def test_a_command_is_reached_by_the_joint_positions_that_it_was_drawn_from(env):
    """The places are the model's own: some environment's site is at each of them for some joint positions."""
    robot = env.scene["robot"]
    robot.write_joint_state_to_sim(robot.data.default_joint_pos, torch.zeros(4, 6))
    at_rest = site_position(env, "gripper_frame")
    places = env.command_manager.get_term(COMMAND)._places
    assert float((places - at_rest[0]).norm(dim=1).min()) < 0.05


TURNING = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="turret"><joint name="turn" axis="0 0 1" range="-2 2"/><geom size="0.02"/>
    <body name="hand" pos="0.3 0 0.2"><joint name="wrist" axis="1 0 0" range="-1 1"/><geom size="0.02"/></body></body>
</worldbody></mujoco>"""


def test_places_are_in_the_frame_of_the_hand_where_a_joint_moves_the_first_body(tmp_path):
    """They were in that body's own frame, in which the hand does not turn: all were one place."""
    (tmp_path / "arm.xml").write_text(TURNING)
    robot = robot_cfg_from_model(tmp_path / "arm.xml")
    cfg = reach_env_cfg(robot, site="hand", action_scale=0.5, experiment_name="arm")
    cfg.scene.num_envs, cfg.sim.num_threads = 2, 1
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    places = env.command_manager.get_term(COMMAND)._places
    positions = torch.tensor([[-0.5, 0.0], [0.5, 0.0]], dtype=env.dtype)
    env.scene["robot"].write_joint_state_to_sim(positions, torch.zeros_like(positions))
    for place in site_position(env, "hand"):
        assert float((places - place).norm(dim=1).min()) < 0.01
    env.close()


def test_a_site_that_is_not_there_is_refused_by_name():
    cfg = load_env_cfg(TASK)
    cfg.commands[COMMAND].site = "hand"
    with pytest.raises(ValueError, match=r"Available: .*gripper_frame"):
        ManagerBasedRLEnv(cfg)


def test_options_of_walking_are_refused():
    with pytest.raises(ValueError, match="no velocity task"):
        load_cfg(RunSettings(task=TASK, randomize=True))
    with pytest.raises(ValueError, match=r"There is no reward set 'velocity'\. Available: reach"):
        load_cfg(RunSettings(task=TASK, reward="velocity"))


@pytest.mark.slow
def test_it_is_trained_played_and_judged(tmp_path, no_export):
    run = train(RunSettings(task=TASK, num_envs=16, max_iterations=1, log_dir=str(tmp_path)))
    result = play(PlaySettings(checkpoint=str(run), num_envs=4, seconds=4.0))
    assert 0 < result.distance < 1 and "within 20 mm" in str(result)
