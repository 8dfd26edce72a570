"""The environments on a GPU; left out where there is none."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from problems import BENCH, record
from without_chance import NUM_ENVS, without_chance

from pace_actuators.effects import EffectCfg, get_effect
from pace_envs import ManagerBasedRLEnv, load_env_cfg
from pace_envs.managers import ManagerTermBase, RewardTermCfg
from pace_envs.simulation import SimulationCfg, make_simulation
from pace_optim.comparison import compare
from pace_optim.identification.fit import fit
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings

NO_GPU = "torch finds no CUDA here"
on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason=NO_GPU)


def _env(
    task: str, device: str, graphs: bool = True, num_envs: int = 8, integrator: str = "implicitfast"
) -> ManagerBasedRLEnv:
    cfg = load_env_cfg(task)
    cfg.sim.integrator = integrator
    cfg.scene.num_envs, cfg.seed, cfg.sim.device, cfg.sim.graphs = num_envs, 0, device, graphs
    return ManagerBasedRLEnv(cfg)


@pytest.fixture(autouse=True)
def _needs_warp(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("skipif"):
        pytest.importorskip("mujoco_warp", reason="MuJoCo Warp is not installed: pip install 'pace-mujoco[gpu]'")


def test_a_missing_gpu_or_package_is_told_in_one_sentence():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    with pytest.raises(ValueError, match=r"MuJoCo Warp, which is not installed|torch finds no GPU"):
        make_simulation(SimulationCfg(device="cuda:0"), None, 1)  # type: ignore[arg-type]


@on_gpu
@pytest.mark.parametrize(
    ("task", "integrator"),
    [
        ("Pace-AnymalD-v0", "implicitfast"),
        ("Pace-AnymalD-v0", "leapfrog"),
        ("Pace-AnymalD-Velocity-v0", "implicitfast"),
    ],
)
def test_both_devices_and_both_ways_move_the_same(task: str, integrator: str):
    cpu = _env(task, "cpu", integrator=integrator)
    graphs, plain = (_env(task, "cuda:0", graphs=each, integrator=integrator) for each in (True, False))
    for env in (cpu, graphs, plain):
        env.reset(seed=1)
    for env in (graphs, plain):
        env.sim.qpos.copy_(cpu.sim.qpos)
        env.sim.qvel.copy_(cpu.sim.qvel)
    generator = torch.Generator().manual_seed(0)
    for k in range(20):  # on its feet, rounding grows with every contact
        if k % 10 == 0:
            action = 0.3 * torch.randn(8, cpu.action_manager.total_action_dim, generator=generator)
        for env in (cpu, graphs, plain):
            env.simulate(action.to(env.device))
    reference = cpu.sim.qpos.float()
    assert torch.allclose(graphs.sim.qpos.cpu(), reference, rtol=0.0, atol=2e-5)
    assert torch.allclose(plain.sim.qpos.cpu(), reference, rtol=0.0, atol=2e-5)
    assert graphs._graphs["simulate"].is_captured and not plain._graphs


@on_gpu
def test_reset_environments_forget_their_delayed_commands_in_graphs_too():
    env, plain = _env("Pace-AnymalD-v0", "cuda:0"), _env("Pace-AnymalD-v0", "cuda:0", graphs=False)
    for each in (env, plain):
        for drive in each.scene["robot"].actuators.values():
            drive.update_time_lags(2.5)
        each.reset(seed=0)
    for k in range(60):
        if k in (20, 41):
            for each in (env, plain):
                each.reset(env_ids=torch.tensor([1, 5], device=each.device))
        action = torch.full((8, 12), 0.01 * k, device="cuda:0")
        env.simulate(action)
        plain.simulate(action)
        assert torch.equal(env.sim.qpos, plain.sim.qpos), k


@on_gpu
def test_a_step_of_walking_robots_waits_for_nothing():
    env = _env("Pace-AnymalD-Velocity-v0", "cuda:0", num_envs=64)
    assert env.masks_resets
    env.reset(seed=0)
    action = 0.5 * torch.randn(64, 12, device="cuda:0")
    for _ in range(40):  # graphs are captured
        env.step(action)
    env.episode_length_buf.copy_(torch.arange(64, device="cuda:0") + env.max_episode_length - 40)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(30):
            obs, reward, _, _, extras = env.step(action)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert bool(obs["policy"].isfinite().all()) and bool(reward.isfinite().all())
    assert float(extras["log"]["Episode_Termination/time_out"]) >= 0.0 and bool((env.episode_length_buf < 40).any())


@on_gpu
def test_what_follows_the_physics_is_the_same_from_a_graph():
    envs = []
    for graphs in (True, False):
        cfg = without_chance()
        cfg.sim.device, cfg.sim.graphs = "cuda:0", graphs
        env = ManagerBasedRLEnv(cfg)
        env.reset(seed=1)
        env.episode_length_buf.copy_(torch.arange(NUM_ENVS, device="cuda:0") % 7 + env.max_episode_length - 9)
        envs.append(env)
    action = 0.3 * torch.ones(NUM_ENVS, 12, device="cuda:0")
    for k in range(25):  # on its feet, rounding grows with every contact; every few steps they start anew
        graph, plain = (env.step(action) for env in envs)
        assert torch.allclose(graph[0]["policy"], plain[0]["policy"], rtol=0.0, atol=1e-2), k
        assert torch.allclose(graph[1], plain[1], rtol=0.0, atol=1e-2) and torch.equal(graph[3], plain[3]), k
        for name, value in graph[4]["log"].items():
            assert float(value) == pytest.approx(float(plain[4]["log"][name]), abs=2e-2), (k, name)
    assert envs[0]._graphs["step"].is_captured and not envs[1]._graphs
    assert envs[0]._graphs["step"]._fused.launched  # by kernels of several operations
    assert bool(graph[3].any() or (envs[0].episode_length_buf < 25).any())


class Smooth(ManagerTermBase):
    """A user's reward that remembers torques."""

    before: torch.Tensor | None = None

    def __call__(self, env: ManagerBasedRLEnv) -> torch.Tensor:
        torque = env.scene["robot"].data.applied_torque
        change = torch.zeros_like(torque) if self.before is None else torque - self.before
        self.before = torque.clone()
        return -change.square().mean(dim=1)


def _with_terms_of_ones_own(graphs: bool, reward: object, effects: tuple[str, ...] = ()) -> ManagerBasedRLEnv:
    cfg = load_env_cfg("Pace-AnymalD-v0")
    cfg.scene.num_envs, cfg.seed, cfg.sim.device, cfg.sim.graphs = 8, 0, "cuda:0", graphs
    cfg.episode_length_s = 0.1
    cfg.rewards = {"smooth": RewardTermCfg(func=reward, weight=1.0)}
    for drive in cfg.scene.robot.actuators.values():
        drive.effects = [
            EffectCfg(effect=name, values={each.name: each.start for each in get_effect(name).parameters})
            for name in effects
        ]
        drive.delay = 2.5
    env = ManagerBasedRLEnv(cfg)
    env.reset(seed=0)
    env.episode_length_buf.copy_(torch.arange(8, device="cuda:0"))
    return env


@on_gpu
@pytest.mark.parametrize("effects", [(), ("stribeck_friction", "drive_bandwidth", "command_filter", "velocity_filter")])
def test_effects_and_rewards_with_memory_are_the_same_from_a_graph(effects: tuple[str, ...]):
    graph, plain = (_with_terms_of_ones_own(graphs, Smooth, effects) for graphs in (True, False))
    rewards, ended = [], 0
    for k in range(90):
        action = torch.full((8, 12), 0.3 * (-1) ** (k // 7), device="cuda:0")
        got, expected = graph.step(action), plain.step(action)
        assert torch.allclose(graph.sim.qpos, plain.sim.qpos, rtol=0.0, atol=1e-5), k
        assert torch.allclose(got[1], expected[1], rtol=1e-3, atol=1e-6), k
        rewards.append(got[1])
        ended += int(got[3].sum())
    assert graph._graphs["step"].is_captured and ended >= 8
    assert len({float(reward[0]) for reward in rewards[20:]}) > 20


@on_gpu
def test_a_reward_that_waits_for_the_gpu_is_told_and_runs_without_a_graph():
    def waits(env: ManagerBasedRLEnv) -> torch.Tensor:
        torque = env.scene["robot"].data.applied_torque
        return torque.sum(dim=1) * float(torque.max() > 0.0)

    env = _with_terms_of_ones_own(True, waits)
    with pytest.warns(UserWarning, match=r"waits for the GPU.*\[W26\]"):
        for _ in range(8):
            env.step(torch.full((8, 12), 0.3, device="cuda:0"))
    assert env._graphs["step"].is_refused


@on_gpu
def test_memory_that_is_garbage_stays_while_a_step_is_captured():
    warp = pytest.importorskip("warp")
    unused, captures = [warp.zeros(8, device="cuda:0")], []

    def makes_garbage(env: ManagerBasedRLEnv) -> torch.Tensor:
        if torch.cuda.is_current_stream_capturing():
            captures.append(len(unused))
            circle: list = [unused.pop()] if unused else []
            circle.append(circle)
            del circle
            [[] for _ in range(100_000)]  # enough for Python to collect what it finds
        return env.sim.qpos[:, 0] * 0.0

    env = _with_terms_of_ones_own(True, makes_garbage)
    for _ in range(8):
        env.step(torch.zeros(8, 12, device="cuda:0"))
    assert captures and env._graphs["step"].is_captured


@on_gpu
def test_draws_from_a_graph_are_new_every_step_and_repeat_with_the_seed():
    env = _env("Pace-AnymalD-Velocity-v0", "cuda:0", num_envs=64)
    action = torch.zeros(64, 12, device="cuda:0")
    for _ in range(4):
        env.step(action)
    seen = []
    for _ in range(2):
        env.seed(7)
        env.sim.qpos[:], env.sim.qvel[:] = env.sim.qpos[:1].clone(), 0.0
        noise = [env.step(action)[0]["policy"][:, :3].std(dim=0) for _ in range(2)]
        assert bool((noise[0] > 0.02).all()) and not torch.equal(*noise)
        seen.append(env.uniform((8,)))
    assert torch.equal(*seen)


@on_gpu
def test_a_comparison_on_a_gpu_tells_the_same_error(tmp_path: Path):
    save_recording(tmp_path / "bench.npz", record(name="bench", noise=1e-4))
    settings = FitSettings(
        task=BENCH, data=[str(tmp_path / "bench.npz")], optimizer="least_squares", log_dir=str(tmp_path / "runs")
    )
    _, run = fit(settings)
    here, there = compare([run])["rmse"], compare([run], device="cuda:0")["rmse"]
    assert there == pytest.approx(here, rel=1e-3)
