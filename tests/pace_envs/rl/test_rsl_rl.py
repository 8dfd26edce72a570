"""Training with rsl-rl: the wrapper keeps rsl-rl's contract, and a training can be run, resumed, played, exported."""

import copy
import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from command_lines import run_script
from PIL import Image
from places import ROOT
from rsl_rl.env import VecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pace_envs import mdp
from pace_envs.registration import load_env_cfg
from pace_envs.rl import (
    PaceOnPolicyRunner,
    PlaySettings,
    RunSettings,
    evaluate,
    latest_checkpoint,
    make_env,
    play,
    resume,
    train,
)
from pace_envs.rl.export import describe_policy
from pace_envs.rl.playing import write_video
from pace_envs.rl.run_folder import new_run_folder
from pace_envs.rl.training import load_cfg
from pace_envs.rsl_rl_cfg import RslRlOnPolicyRunnerCfg
from pace_envs.rsl_rl_wrapper import RslRlVecEnvWrapper
from pace_envs.tasks.velocity import VelocityEnvCfg, fix_command, play_cfg

TASKS = ["Pace-AnymalD-Velocity-v0", "Pace-Go2-Velocity-v0"]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("reward", ["velocity", "energy"])
def test_the_wrapper_keeps_rsl_rls_contract(task, reward):
    env = make_env(load_cfg(RunSettings(task=task, num_envs=4, reward=reward)))
    assert isinstance(env, VecEnv) and env.num_actions == 12 and env.max_episode_length == 1000
    obs = env.get_observations()
    assert obs.batch_size == (4,) and obs["policy"].shape == (4, 48) and obs["policy"].dtype == torch.float32
    obs, reward, dones, extras = env.step(torch.zeros(4, 12))
    assert obs["policy"].shape == (4, 48) and reward.shape == dones.shape == extras["time_outs"].shape == (4,)
    assert reward.dtype == torch.float32 and dones.dtype == torch.long and extras["time_outs"].dtype == torch.bool
    assert isinstance(env.cfg, VelocityEnvCfg) and env.unwrapped.step_dt == 0.02
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_the_robot_stands_on_its_drives(task):
    env = make_env(load_cfg(RunSettings(task=task, num_envs=8)))
    height = env.cfg.scene.robot.init_state.pos[2]
    for _ in range(100):
        _, _, dones, _ = env.step(torch.zeros(8, 12))
        assert not dones.any()
    assert (env.unwrapped.scene["robot"].data.root_pos_w[:, 2] > 0.75 * height).all()


def test_time_outs_are_told_from_falls():
    env = make_env(load_cfg(RunSettings(task=TASKS[0], num_envs=3)))
    lengths = env.episode_length_buf
    env.episode_length_buf = torch.tensor([0, env.max_episode_length - 1, 5])
    assert env.episode_length_buf is lengths  # rsl-rl sets it: written in place
    flat_on_its_back = torch.tensor([0, 0, 0.3, 0, 1.0, 0, 0, *[0.0] * 6], dtype=torch.float64)
    env.unwrapped.scene["robot"].write_root_state_to_sim(flat_on_its_back, [2])
    _, _, dones, extras = env.step(torch.zeros(3, 12))
    assert dones.tolist() == [0, 1, 1] and extras["time_outs"].tolist() == [False, True, False]
    assert env.episode_length_buf.tolist() == [1, 0, 0]
    log = extras["log"]
    assert log["Episode_Termination/time_out"] == 1 and log["Episode_Termination/bad_orientation"] == 1
    assert "Episode_Reward/track_velocity" in log and "Curriculum/command_range" in log


def test_actions_are_clipped():
    cfg = load_cfg(RunSettings(task=TASKS[0], num_envs=1))
    cfg.runner.clip_actions = 0.5
    env = make_env(cfg)
    env.step(torch.full((1, 12), 3.0))
    assert (env.unwrapped.action_manager.action == 0.5).all()


def test_only_batched_environments_can_be_wrapped():
    with pytest.raises(ValueError, match="expected a ManagerBasedRLEnv"):
        RslRlVecEnvWrapper(gym.Env())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "Pace-AnymalD-v0"}, "no training task"),
        ({"task": "Pace-Anymal-Velocity-v0"}, "Did you mean 'Pace-AnymalD-Velocity-v0'"),
        ({"task": TASKS[0], "reward": "enrgy"}, "no reward set 'enrgy'. Available: velocity, energy"),
        ({"task": TASKS[0], "max_iterations": 0}, "max_iterations is 0"),
    ],
)
def test_unusable_settings_are_answered_with_what_there_is(settings, message):
    with pytest.raises(ValueError, match=message):
        load_cfg(RunSettings(**settings))


def test_a_robot_that_stands_is_judged_as_one_that_stands():
    cfg = load_cfg(RunSettings(task=TASKS[0], num_envs=4))
    play_cfg(cfg)
    fix_command(cfg, (0.5, 0.0, 0.3))
    env = make_env(cfg)
    result = evaluate(env, lambda obs: torch.zeros(4, 12), steps=150)
    assert result.velocity_error == pytest.approx(0.5, abs=0.05)
    assert result.yaw_rate_error == pytest.approx(0.3, abs=0.05)
    assert result.falls_per_episode == 0.0 and result.speed < 0.1
    weight = 9.81 * float(env.unwrapped.sim.model.body_mass.sum())
    assert result.cost_of_transport == pytest.approx(result.power / (weight * result.speed))


def test_falls_are_counted_per_20_seconds():
    cfg = load_cfg(RunSettings(task=TASKS[0], num_envs=4))
    cfg.terminations["base_height"].params["minimum_height"] = 10.0  # everyone falls at every step
    env = make_env(cfg)
    assert evaluate(env, lambda obs: torch.zeros(4, 12), steps=5).falls_per_episode == pytest.approx(1000.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    settings = RunSettings(
        task=TASKS[0], num_envs=16, max_iterations=2, seed=3, log_dir=str(tmp_path_factory.mktemp("runs"))
    )
    return train(settings)


def scalars(folder: Path) -> dict[str, list[float]]:
    events = EventAccumulator(str(folder))
    events.Reload()
    return {tag: [e.value for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


@pytest.mark.slow
def test_training_writes_checkpoints_logs_and_the_policy(run):
    assert {p.name for p in run.glob("model_*.pt")} == {"model_0.pt", "model_1.pt"}
    logged = scalars(run)
    for name in ("Loss/value", "Loss/surrogate", "Loss/entropy", "Perf/total_fps"):
        assert len(logged[name]) == 2 and np.isfinite(logged[name]).all()
    assert {p.name for p in (run / "exported").iterdir()} == {"policy.pt", "policy.onnx", "policy.json"}


def test_the_exported_policies_agree_and_say_what_they_mean(run):
    onnx = pytest.importorskip("onnx.reference")
    described = json.loads((run / "exported" / "policy.json").read_text())
    assert [term["name"] for term in described["observations"]][:3] == [
        "base_lin_vel",
        "base_ang_vel",
        "projected_gravity",
    ]
    assert sum(term["dim"] for term in described["observations"]) == 48
    assert described["joint_names"][:3] == ["LF_HAA", "LF_HFE", "LF_KFE"] and described["scale"] == [0.5] * 12
    obs = torch.randn(1, 48)
    torch_action = torch.jit.load(run / "exported" / "policy.pt")(obs)
    (onnx_action,) = onnx.ReferenceEvaluator(str(run / "exported" / "policy.onnx")).run(None, {"obs": obs.numpy()})
    np.testing.assert_allclose(onnx_action, torch_action.detach().numpy(), atol=1e-5)


@pytest.mark.parametrize(
    ("terms", "targets"),
    [
        ({"speeds": mdp.JointVelocityActionCfg(scale=0.5)}, ["speed target = action * scale + offset [rad/s]"]),
        (
            {
                "hips": mdp.JointPositionActionCfg(joint_names=".*HAA"),
                "torques": mdp.JointEffortActionCfg(joint_names=".*_[HK]FE"),
            },
            ["target = action * scale + offset, in the encoder's coordinates [rad]", "torque beside the controller's"],
        ),
    ],
)
def test_an_exported_policy_says_what_actions_of_any_name_and_kind_mean(terms, targets):
    """A term of another name than joint_pos stopped the export after the training; speeds were called targets."""
    cfg = load_cfg(RunSettings(task=TASKS[0], num_envs=2))
    cfg.actions = terms
    env = make_env(cfg)
    described = describe_policy(SimpleNamespace(env=env))
    env.close()
    own = [described] if len(terms) == 1 else [described["actions"][name] for name in terms]
    assert all(each["target"].startswith(target) for each, target in zip(own, targets, strict=True))
    assert sum(len(each["joint_names"]) for each in own) == 12 and json.dumps(described)


@pytest.mark.slow
def test_the_same_seed_trains_the_same_policy(run, tmp_path, no_export):
    settings = RunSettings.read(run)
    settings.log_dir = str(tmp_path)
    again = train(settings)
    first, second = (torch.load(latest_checkpoint(p), weights_only=False)["actor_state_dict"] for p in (run, again))
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.slow
def test_a_training_goes_on_where_it_stopped(run, no_export):
    before = torch.load(run / "model_1.pt", weights_only=False)
    assert before["infos"]["env"]["command_scale"] == {"base_velocity": 0.5}
    assert resume(run, max_iterations=3) == run
    assert latest_checkpoint(run).name == "model_2.pt" and RunSettings.read(run).max_iterations == 3
    with pytest.raises(ValueError, match="ends after 3 iterations"):
        resume(run)


@pytest.mark.slow
def test_a_training_with_other_options_starts_from_another_s_policy(run, tmp_path, monkeypatch):
    onnx = run / "exported" / "policy.onnx"  # another takes seconds
    monkeypatch.setattr(PaceOnPolicyRunner, "export_policy_to_onnx", lambda _, folder: shutil.copy(onnx, folder))
    started = copy.deepcopy(RunSettings.read(run))
    started.start_from, started.log_dir, started.randomize = str(run / "model_0.pt"), str(tmp_path), True
    started.max_iterations = 2
    folder = train(started)
    assert folder != run and {p.name for p in folder.glob("model_*.pt")} == {"model_1.pt"}
    assert RunSettings.read(folder).randomize and (folder / "exported" / "policy.pt").is_file()
    first, other = (torch.load(p / "model_1.pt", weights_only=False) for p in (run, folder))
    assert other["iter"] == first["iter"] == 1
    started.start_from = str(tmp_path / "nothing.pt")
    with pytest.raises(ValueError, match="does not exist"):
        train(started)


def test_the_curriculum_goes_on_where_it_stopped_and_a_judge_has_none(run, tmp_path):
    cfg = load_cfg(RunSettings.read(run))
    env = make_env(cfg)
    command = env.unwrapped.command_manager.get_term("base_velocity")
    runner = PaceOnPolicyRunner(env, cfg.runner.to_dict())
    command.scale = 0.8
    runner.save(str(tmp_path / "model_0.pt"))
    command.scale = 0.5
    runner.load(str(tmp_path / "model_0.pt"))
    assert command.scale == 0.8 and runner.current_learning_iteration == 1
    play_cfg(cfg)
    env = make_env(cfg)
    PaceOnPolicyRunner(env, cfg.runner.to_dict()).load(str(tmp_path / "model_0.pt"))
    assert env.unwrapped.command_manager.get_term("base_velocity").scale == 1.0


def _drawing(*command: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: without OpenGL, MuJoCo ends the process."""
    environ = {"MUJOCO_GL": "egl", **os.environ}
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, env=environ)


@cache
def _without_opengl() -> str:
    """Why nothing can be drawn here; empty if it can."""
    draws = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()"
    done = _drawing("-c", draws)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


@pytest.mark.slow
def test_a_policy_is_played_and_filmed_without_a_screen(run, tmp_path):
    film = tmp_path / "walk.gif"
    options = ["--checkpoint", str(run), "--num_envs", "2", "--seconds", "0.2", "--video", str(film)]
    script = ROOT / "scripts" / "play.py"
    done = _drawing(str(script), *options)
    if done.returncode and (why_not := _without_opengl()):
        pytest.skip(f"no OpenGL here: {why_not}")
    assert done.returncode == 0, done.stderr
    assert film.stat().st_size > 5000
    assert "falls per 20 s" in done.stdout
    assert Image.open(film).n_frames == 5


def test_a_film_is_an_mp4_where_there_is_an_ffmpeg(tmp_path):
    pictures = np.random.default_rng(0).integers(0, 255, (10, 64, 64, 3), dtype=np.uint8)
    try:
        write_video(tmp_path / "walk.mp4", list(pictures), 25)
    except ValueError as error:
        pytest.skip(str(error))
    assert (tmp_path / "walk.mp4").stat().st_size > 5000


@pytest.mark.parametrize(
    ("seconds", "message"),
    [(1e99, r"--seconds 1e\+99: expected more than 0, at most 3600"), (0.0, "--seconds 0: expected more than 0")],
)
def test_nobody_plays_for_ever(run, seconds, message):
    with pytest.raises(ValueError, match=message):
        play(PlaySettings(checkpoint=str(run), seconds=seconds))


def test_a_film_that_memory_cannot_hold_is_refused(run, tmp_path, monkeypatch):
    monkeypatch.setattr("pace_actuators.memory.available_memory", lambda: 1e9)
    with pytest.raises(ValueError, match=r"--video would take .* Give fewer --seconds"):
        play(PlaySettings(checkpoint=str(run), num_envs=2, seconds=3600.0, video=str(tmp_path / "walk.gif")))


def test_the_window_needs_a_screen(run, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if sys.platform != "linux":
        pytest.skip("other systems always have a screen")
    with pytest.raises(ValueError, match="no screen"):
        play(PlaySettings(checkpoint=str(run), num_envs=1, viewer=True))


def test_a_checkpoint_of_another_robot_or_none_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        play(PlaySettings(checkpoint=str(tmp_path / "model_7.pt")))
    wrong = tmp_path / "model_0.pt"
    wrong.write_bytes((run / "model_0.pt").read_bytes())
    with pytest.raises(ValueError, match="say with --task"):
        play(PlaySettings(checkpoint=str(wrong)))
    cfg = load_env_cfg(TASKS[0])
    assert cfg.runner.to_dict()["actor"]["hidden_dims"] == (128, 128, 128)


def test_a_training_does_not_begin_with_an_optimizer_that_lacks_a_moment(run, tmp_path):
    """It was missed in the first update, when the folder had been written to."""
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    path = latest_checkpoint(folder)
    content = torch.load(path, weights_only=True)
    state = content["optimizer_state_dict"]["state"]
    state[0]["mean"] = state[0].pop("exp_avg")
    torch.save(content, path)
    before = {each.name: each.stat().st_mtime_ns for each in folder.iterdir()}
    with pytest.raises(ValueError, match="the optimizer's exp_avg is missing"):
        resume(folder, max_iterations=9)
    assert {each.name: each.stat().st_mtime_ns for each in folder.iterdir()} == before


@pytest.mark.parametrize(("key", "value"), [("mlp.2.weight", 1e160), ("mlp.2.weight", 1e38), ("mlp.0.bias", 1e160)])
def test_a_training_does_not_begin_with_a_policy_whose_actions_are_not_finite(run, tmp_path, key, value):
    """It was missed in the first step, when the folder had been made, and the checkpoint was not named."""
    content = torch.load(latest_checkpoint(run), weights_only=True)
    weights = content["actor_state_dict"]
    weights[key] = torch.full_like(weights[key], value, dtype=torch.float64)
    torch.save(content, tmp_path / "model_2.pt")
    settings = RunSettings(task=TASKS[0], num_envs=2, start_from=str(tmp_path / "model_2.pt"), log_dir=str(tmp_path))
    with pytest.raises(ValueError, match=r"model_2\.pt is no checkpoint .*what they say is not finite"):
        train(settings)
    assert [each.name for each in tmp_path.iterdir()] == ["model_2.pt"]


def test_a_film_needs_a_known_ending_and_pictures(tmp_path):
    with pytest.raises(ValueError, match=r"expected \.mp4 or \.gif"):
        write_video(tmp_path / "walk.avi", [np.zeros((4, 4, 3), np.uint8)], 25)
    with pytest.raises(ValueError, match="no pictures"):
        write_video(tmp_path / "walk.gif", [], 25)


@pytest.mark.slow
def test_the_command_lines_train_and_play(tmp_path, monkeypatch):
    def call(*words):
        done = run_script(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    with monkeypatch.context() as patch:  # the policy's files are those that play writes
        patch.setattr("pace_envs.rl.training.export_policy", lambda *_: None)
        lines = call("train", "--task", TASKS[1], "--num_envs", "8", "--max_iterations", "1")
    run = lines[-1].removeprefix("run: ")
    lines = call(
        *("play", "--checkpoint", run, "--num_envs", "2", "--seconds", "0.2"),
        *("--command", "0.5", "0", "0", "--export", "out"),
    )
    assert lines[0].startswith("velocity error") and (tmp_path / "out" / "policy.onnx").is_file()


def test_a_training_without_a_checkpoint_is_told_which_file_is_expected(tmp_path):
    with pytest.raises(ValueError, match=r"holds no checkpoint: expected model_0\.pt"):
        latest_checkpoint(tmp_path)


def test_a_training_s_folder_has_the_name_of_its_task(tmp_path):
    """A quadruped's and an arm's runs were both in `velocity`."""
    for experiment, name in (("my_robot.py:My-Arm-v0", "My-Arm-v0"), ("go2_velocity", "go2_velocity")):
        assert new_run_folder(tmp_path, experiment).parent == tmp_path / name
    assert RslRlOnPolicyRunnerCfg().experiment_name == ""
