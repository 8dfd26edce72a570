"""The environments on a GPU; left out where there is none."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from problems import BENCH, record
from test_masked_resets import NUM_ENVS, without_chance

from pace_envs import ManagerBasedRLEnv, load_env_cfg
from pace_envs.simulation import SimulationCfg, make_simulation
from pace_optim.comparison import compare
from pace_optim.identification.fit import fit
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings

NO_GPU = "torch finds no CUDA here"
on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason=NO_GPU)


def _env(task: str, device: str, graphs: bool = True, num_envs: int = 8) -> ManagerBasedRLEnv:
    cfg = load_env_cfg(task)
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
@pytest.mark.parametrize("task", ["Pace-AnymalD-v0", "Pace-AnymalD-Velocity-v0"])
def test_both_devices_and_both_ways_move_the_same(task: str):
    cpu, graphs, plain = _env(task, "cpu"), _env(task, "cuda:0"), _env(task, "cuda:0", graphs=False)
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
    assert graphs._drive_graphs is not None and graphs._drive_graphs.num_graphs


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
    assert envs[0]._manager_graph is not None and envs[0]._manager_graph.is_captured
    assert envs[0]._manager_graph._fused.launched  # by kernels of several operations
    assert envs[1]._manager_graph is None and bool(graph[3].any() or (envs[0].episode_length_buf < 25).any())


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
