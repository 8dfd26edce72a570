"""Environments as their users meet them: through Gymnasium, with resets, wrappers and robots of their own."""

import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import NumpyToTorch, RecordEpisodeStatistics

import pace_envs
from pace_actuators import PaceDCMotorCfg
from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_envs import ArticulationCfg, InitialStateCfg, ManagerBasedRLEnv, load_env_cfg
from pace_envs.tasks.pace import PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg

BOUNDS = {**dict.fromkeys(BASE_PARAMETERS, (0.0, 1.0)), "delay": (0.0, 10.0)}
TASKS = {"Pace-AnymalD-v0": 12, "Pace-Go2-v0": 12, "Pace-SO101-v0": 6, "Pace-TestBench-v0": 1}


@pytest.mark.parametrize(("task", "joints"), TASKS.items())
def test_make_gives_batched_tensors(task, joints):
    env = gym.make(task, num_envs=3)
    obs, _ = env.reset(seed=0)
    assert obs["policy"].shape == (3, 2 * joints)
    assert env.unwrapped.step_dt == env.unwrapped.physics_dt == 0.0025
    assert env.action_space.shape == (3, joints) and env.unwrapped.single_action_space.shape == (joints,)
    assert env.observation_space["policy"].shape == (3, 2 * joints)
    obs, reward, terminated, truncated, _ = env.step(torch.zeros(3, joints))
    assert obs["policy"].shape == (3, 2 * joints) and obs["policy"].dtype == torch.float32
    assert reward.shape == terminated.shape == truncated.shape == (3,)
    assert terminated.dtype == truncated.dtype == torch.bool
    env.close()


@pytest.mark.parametrize(("task", "joints"), TASKS.items())
def test_make_vec_gives_gymnasiums_vector_environment_over_the_same_object(task, joints):
    env = gym.make_vec(task, num_envs=3)
    assert isinstance(env, gym.vector.VectorEnv) and isinstance(env.unwrapped, ManagerBasedRLEnv)
    obs, info = env.reset(seed=0)
    assert env.observation_space.contains(obs) and info == {}
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(obs) and info == {}
    assert [type(x) for x in (reward, terminated, truncated)] == [np.ndarray] * 3
    assert env.single_observation_space.shape == (2 * joints,) and env.spec.id == task
    env.close()


def test_gymnasiums_wrappers_run_on_it():
    cfg = load_env_cfg("Pace-AnymalD-v0")
    cfg.episode_length_s = 0.0125
    env = NumpyToTorch(RecordEpisodeStatistics(gym.make_vec("Pace-AnymalD-v0", num_envs=8, cfg=cfg)))
    obs, _ = env.reset(seed=0)
    assert obs.shape == (8, 24) and isinstance(obs, torch.Tensor)
    for _ in range(5):
        obs, reward, _, truncated, info = env.step(torch.zeros(8, 12))
    assert isinstance(reward, torch.Tensor) and truncated.all()
    assert info["episode"]["l"].tolist() == [5] * 8
    env.close()


def test_gymnasiums_wrappers_run_without_an_end_of_the_episode():
    env = NumpyToTorch(RecordEpisodeStatistics(gym.make_vec("Pace-AnymalD-v0", num_envs=8)))
    env.reset(seed=0)
    for _ in range(10):
        *_, truncated, info = env.step(torch.zeros(8, 12))
    assert not truncated.any() and info == {}
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("line", ["import pace_envs", "gym.make('pace_envs:Pace-AnymalD-v0')"])
def test_importing_registers_by_name_or_by_prefix(line, tmp_path):
    code = f"import gymnasium as gym; {line}; assert gym.make('Pace-Go2-v0', num_envs=2).unwrapped.num_envs == 2"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_an_unknown_task_is_answered_with_the_nearest_name():
    with pytest.raises(
        ValueError, match=r"'Pace-AnymalC-v0'\. Did you mean 'Pace-AnymalD-v0'\? Available: .*Pace-Go2-v0"
    ):
        load_env_cfg("Pace-AnymalC-v0")


def test_every_configuration_is_a_fresh_one():
    load_env_cfg("Pace-AnymalD-v0").scene.robot.actuators["legs"].stiffness = -1.0
    cfg = load_env_cfg("Pace-AnymalD-v0")
    assert cfg.scene.robot.actuators["legs"].stiffness == 85.0
    env = gym.make("Pace-AnymalD-v0", cfg=cfg, num_envs=7, physics_dt=0.0005, delay_mode="effort", seed=3)
    assert env.unwrapped.num_envs == 7 and env.unwrapped.cfg.decimation == 5
    assert env.unwrapped.scene["robot"].actuators["legs"].cfg.delay_mode == "effort"
    assert (cfg.scene.num_envs, cfg.decimation, cfg.seed) == (1, 1, None)
    assert cfg.scene.robot.actuators["legs"].delay_mode == "command"


# ---- episodes


def short_episodes(num_envs=3, steps=4, integrator="implicitfast", **kwargs) -> ManagerBasedRLEnv:
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.sim.integrator = integrator
    cfg.episode_length_s, cfg.scene.num_envs = steps * 0.0025, num_envs
    return ManagerBasedRLEnv(cfg, **kwargs)


def test_an_environment_starts_anew_in_the_step_that_ends_it():
    env = short_episodes()
    env.final_observations = True
    env.reset()
    env.episode_length_buf[1] = 2  # two steps ahead of the others
    action, steps = torch.full((3, 1), 0.5), [env.step(torch.full((3, 1), 0.5)) for _ in range(4)]
    fresh = short_episodes(1)
    fresh.reset()
    first, second = (fresh.step(action[:1])[0]["policy"][0] for _ in range(2))

    assert not any(terminated.any() for _, _, terminated, _, _ in steps)
    truncated = [truncated.tolist() for _, _, _, truncated, _ in steps]
    assert truncated == [[False] * 3, [False, True, False], [False] * 3, [True, False, True]]
    assert ["final_obs" in extras for *_, extras in steps] == [False, True, False, True]
    assert steps[1][-1]["_final_obs"].tolist() == [False, True, False]
    assert torch.equal(steps[1][-1]["final_obs"]["policy"][1], second)
    seen = torch.stack([obs["policy"][1] for obs, *_ in steps])
    assert torch.equal(seen, torch.stack([first, torch.zeros(2), first, second]))
    assert torch.equal(steps[1][0]["policy"][0], second)
    assert env.episode_length_buf.tolist() == [0, 2, 0]


def test_the_vector_environment_hands_out_the_last_observation():
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.episode_length_s = 4 * 0.0025
    env = gym.make_vec("Pace-TestBench-v0", num_envs=2, cfg=cfg)
    env.reset()
    env.unwrapped.episode_length_buf[1] = 1
    for _ in range(3):
        obs, _, _, truncated, info = env.step(np.full((2, 1), 0.5))
    assert truncated.tolist() == [False, True] == info["_final_obs"].tolist()
    assert (info["final_obs"][1] == obs[0]).all()
    assert obs[1].tolist() == [0.0, 0.0]


def test_a_reset_mask_resets_some():
    env = gym.make_vec("Pace-TestBench-v0", num_envs=3)
    env.reset()
    env.step(np.full((3, 1), 0.5))
    obs, _ = env.reset(options={"reset_mask": np.array([True, False, True])})
    assert obs[:, 0].astype(bool).tolist() == [False, True, False]


@pytest.mark.parametrize("env_ids", [[2, 0], torch.tensor([True, False, True]), np.array([0, 2])], ids=repr)
@pytest.mark.parametrize("task", ["Pace-AnymalD-v0", "Pace-Go2-v0"])
def test_a_partial_reset_leaves_the_others_bit_identical(task, env_ids):
    reset, never = (gym.make(task, num_envs=3, seed=0).unwrapped for _ in range(2))
    targets = 0.2 * torch.randn(40, 3, 12, generator=torch.Generator().manual_seed(0))
    for env in (reset, never):
        env.reset()
        for actuator in env.scene["robot"].actuators.values():
            actuator.update_time_lags(2.5)
        env.scene["robot"].write_joint_friction_coefficient_to_sim(0.05)
    for k, target in enumerate(targets):
        if k == 20:
            reset.reset(env_ids=env_ids)
        (a, *_), (b, *_) = reset.step(target), never.step(target)
        assert torch.equal(a["policy"][1], b["policy"][1])
    assert not torch.equal(a["policy"][[0, 2]], b["policy"][[0, 2]])


def test_an_episode_that_ends_leaves_the_others_bit_identical():
    cfg = load_env_cfg("Pace-AnymalD-v0")
    cfg.scene.robot.actuators["legs"].friction, cfg.episode_length_s = 0.3, 1.0
    ends, goes_on = (gym.make("Pace-AnymalD-v0", num_envs=3, cfg=cfg).unwrapped for _ in range(2))
    for env in (ends, goes_on):
        env.reset()
    ends.episode_length_buf[[0, 2]] = 390  # of 400
    for target in 0.2 * torch.randn(30, 3, 12, generator=torch.Generator().manual_seed(0)):
        (a, *_), (b, *_) = ends.step(target), goes_on.step(target)
        assert torch.equal(a["policy"][1], b["policy"][1])
    assert ends.episode_length_buf.tolist() == [20, 30, 20]


@pytest.mark.parametrize("integrator", ["implicitfast", "leapfrog"])
def test_it_steps_in_and_out_of_inference_mode(integrator):
    """A training with a model file's fit, whose steps are leapfrogs, ended after its first rollout."""
    with torch.inference_mode():
        env = short_episodes(integrator=integrator)
        env.reset()
        env.step(torch.zeros(3, 1))
    env.reset(env_ids=[1])
    for _ in range(5):
        env.step(torch.zeros(3, 1))
    env.scene["robot"].actuators["servo"].update_encoder_bias(0.1)


def test_a_task_of_a_module_that_is_not_imported_says_so():
    """The message claimed that the module had been imported, which commands alone do."""
    with pytest.raises(ValueError, match=r"my_arm registered no environment 'Mine-v0'.*In Python, import my_arm first"):
        load_env_cfg("my_arm:Mine-v0")


def test_an_environment_step_must_hold_whole_control_steps():
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.scene.robot.actuators["servo"].control_decimation = 2
    with pytest.raises(ValueError, match="decimation is 1, expected a multiple"):
        ManagerBasedRLEnv(cfg)


# ---- a robot of one's own

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 0.1">
      <freejoint/>
      <geom type="box" size="0.05 0.05 0.05" mass="2"/>
      <body name="upper">
        <joint name="shoulder" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.6"/>
        <body name="fore" pos="0.3 0 0">
          <joint name="elbow" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.015" mass="0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
  <sensor><actuatorfrc actuator="elbow"/></sensor>
  <keyframe><key qpos="0 0 1 1 0 0 0 0.5 0.5" ctrl="1 1"/></keyframe>
</mujoco>
"""


@pytest.fixture
def arm_task(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    joints = ("elbow", "shoulder")

    def arm_env_cfg() -> PaceSim2realEnvCfg:
        robot = ArticulationCfg(
            mjcf_path=path,
            init_state=InitialStateCfg(pos=(0.0, 0.0, 1.0), joint_pos={"shoulder": 0.4, "elbow": -0.3}),
            actuators={
                "arm": PaceDCMotorCfg(
                    joint_names_expr=".*", stiffness=30.0, damping=0.5, armature=0.05, effort_limit=9.0
                )
            },
        )
        return PaceSim2realEnvCfg(
            scene=PaceSim2realSceneCfg(robot=robot),
            sim2real=PaceCfg(robot_name="arm", data_dir=tmp_path, joint_order=joints, bounds=BOUNDS),
        )

    pace_envs.register_task("Pace-RegisteredArm-v0", arm_env_cfg)
    yield "Pace-RegisteredArm-v0"
    del gym.registry["Pace-RegisteredArm-v0"]


def test_a_robot_of_ones_own_takes_a_model_a_configuration_and_one_call(arm_task):
    env = gym.make(arm_task, num_envs=4).unwrapped
    obs, _ = env.reset()
    robot = env.scene["robot"]
    assert robot.joint_names == ["elbow", "shoulder"] and robot.is_fixed_base
    assert obs["policy"][0].tolist() == pytest.approx([-0.3, 0.4, 0.0, 0.0])
    for _ in range(400):
        obs, *_ = env.step(torch.tensor([[0.2, -0.1]]).expand(4, 2))
    assert obs["policy"][0, 0].item() == pytest.approx(0.2, abs=0.05)
    assert arm_task in pace_envs.registered_tasks()
    assert gym.make_vec(arm_task, num_envs=2).reset()[0].shape == (2, 4)


def test_a_name_can_be_registered_only_once(arm_task):
    with pytest.raises(ValueError, match="'Pace-RegisteredArm-v0' is already registered"):
        pace_envs.register_task(arm_task, lambda: None)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"bounds_params": torch.zeros(8, 2)}, r"shape \(8, 2\), expected \(5, 2\)"),
        (
            {"bounds_params": torch.tensor([[0.0, 1.0]] * 4 + [[5.0, 1.0]])},
            r"delay on all are \(5, 1\), expected lower <= upper",
        ),
        ({"bounds": {"friction": (0.0, 1.0)}}, r"bounds has friction, expected a pair .* for each of armature"),
        ({"bounds": {**BOUNDS, "friction": (2.0, 1.0)}}, r"friction on servo are \(2, 1\), expected lower <= upper"),
        ({"bounds": {**BOUNDS, "friction": (0.0, 1.0, 2.0)}}, r"friction have shape \(3,\), expected one pair"),
        ({"bounds": {**BOUNDS, "friction": {"elbow": (0.0, 1.0)}}}, r"'elbow' matches no joint"),
    ],
)
def test_bounds_that_do_not_fit_the_joints_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        PaceCfg(robot_name="x", data_dir=".", joint_order=("servo",), **fields).prepare()


def test_bounds_are_a_pair_for_all_one_by_expression_or_paces_tensor():
    def prepared(**fields):
        cfg = PaceCfg(robot_name="x", data_dir=".", joint_order=("hip", "knee"), **fields)
        cfg.prepare()
        return cfg

    by_name = prepared(bounds={**BOUNDS, "friction": {"hip": (0.0, 1.0), "kn.*": (0.0, 2.0)}})
    assert by_name.bounds["friction"].tolist() == [[0.0, 1.0], [0.0, 2.0]]
    assert by_name.bounds["armature"].tolist() == [[0.0, 1.0]] * 2 and by_name.bounds["delay"].tolist() == [[0.0, 10.0]]
    rows = torch.cat([by_name.bounds[name] for name in BASE_PARAMETERS])
    pace = prepared(bounds_params=rows)
    assert pace.bounds_params is None
    assert all(torch.equal(pace.bounds[name], own) for name, own in by_name.bounds.items())
    pace.set_bounds("delay", 0.1, 0.3)
    assert pace.bounds["delay"].tolist() == [[0.1, 0.3]]  # to the last digit
    pace.set_bounds("friction", upper=[3.0, 4.0])
    assert pace.bounds["friction"].tolist() == [[0.0, 3.0], [0.0, 4.0]]


# ---- pictures

RENDER = """
import gymnasium as gym, torch, pace_envs
env = gym.make("Pace-AnymalD-v0", num_envs=2, render_mode="rgb_array")
env.reset()
before = env.render()
assert before.shape == (720, 1280, 3) and before.dtype == "uint8" and before.std() > 5
for _ in range(40):
    env.step(torch.zeros(2, 12))
assert (env.render() != before).any()
env.close()
"""
CAN_RENDER = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()"


@pytest.mark.slow
def test_a_picture_shows_the_robot_move():
    can, done = (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env={"MUJOCO_GL": "egl", **os.environ}
        )
        for code in (CAN_RENDER, RENDER)
    )
    if can.returncode != 0:
        pytest.skip(f"no OpenGL here: {can.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr


def test_without_a_render_mode_there_is_no_picture():
    assert short_episodes().render() is None
