"""Control steps of an environment on a GPU against bare MuJoCo Warp along the same motion, in the same run.

    python benchmarks/gpu_throughput.py [--task Pace-AnymalD-v0] [--num_envs 512 4096 16384 65536] [--steps 200]

The environment steps on random targets and its torques are kept; then both start from the same state again and
again, in turns: ``env.simulate`` (action, drives, physics), and the physics alone with those torques copied in.
For walking tasks ``env.step`` is timed, too: rewards, ends, resets, commands, observations.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable

import torch

from pace_envs import ManagerBasedRLEnv, load_env_cfg
from pace_envs.warp_simulation import WarpSimulation

REPEATS = 5
STATE = ("qpos", "qvel", "qacc_warmstart")


def seconds(call: Callable[[int], object], count: int) -> float:
    """Time of one of so many calls on the device."""
    torch.cuda.synchronize()
    start = time.perf_counter()
    for k in range(count):
        call(k)
    torch.cuda.synchronize()
    return (time.perf_counter() - start) / count


def measure(task: str, num_envs: int, steps: int, device: str) -> dict[str, object]:
    """Physics steps per second, bare and with the environment around them."""
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.seed, cfg.sim.device = num_envs, 0, device
    env = ManagerBasedRLEnv(cfg)
    env.reset(seed=0)
    sim, decimation = env.sim, cfg.decimation
    assert isinstance(sim, WarpSimulation)
    size = 0.1 if cfg.sim.contacts else 0.3
    actions = size * torch.randn(steps, num_envs, env.action_manager.total_action_dim, device=device)
    for k in range(60):  # kernels are loaded, graphs captured
        env.simulate(actions[k % steps])
    state = [sim.bind(name) for name in STATE]
    start = [field.clone() for field in state]
    torques, step = [], sim.step

    def keep() -> None:
        torques.append(sim.qfrc_applied.clone())
        step()

    sim.step = keep  # type: ignore[method-assign]
    for action in actions:
        env.simulate(action)
    sim.step = step  # type: ignore[method-assign]

    def bare(k: int) -> None:
        sim.qfrc_applied.copy_(torques[k])
        step()

    with_env, alone = [], []
    for _ in range(REPEATS):
        for field, value in zip(state, start, strict=True):
            field.copy_(value)
        with_env.append(seconds(lambda k: env.simulate(actions[k]), steps) / decimation)
        for field, value in zip(state, start, strict=True):
            field.copy_(value)
        alone.append(seconds(bare, steps * decimation))
    row: dict[str, object] = {
        "task": task,
        "num_envs": num_envs,
        "bare_steps_per_s": num_envs / statistics.median(alone),
        "control_steps_per_s": num_envs / statistics.median(with_env),
        "part_of_bare": statistics.median(a / b for a, b in zip(alone, with_env, strict=True)),
    }
    if cfg.sim.contacts:
        env.reset(seed=0)
        for action in actions[:5]:
            env.step(action)
        row["env_steps_per_s"] = num_envs * decimation / seconds(lambda k: env.step(actions[k % steps]), 60)
    env.close()
    return row


def main() -> None:
    """Print one line per width, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", default="Pace-AnymalD-v0")
    parser.add_argument("--num_envs", type=int, nargs="+", default=[512, 4096, 16384, 65536])
    parser.add_argument("--steps", type=int, default=200, help="control steps (fewer for walking at large widths)")
    parser.add_argument("--device", default="cuda:0")
    args = parser.parse_args()
    print(torch.cuda.get_device_name(args.device))
    for num_envs in args.num_envs:
        print(json.dumps(measure(args.task, num_envs, args.steps, args.device)), flush=True)


if __name__ == "__main__":
    main()
