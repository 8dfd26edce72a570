"""Control steps of an environment on a GPU against bare MuJoCo Warp along the same motion, in the same run.

    python benchmarks/gpu_throughput.py [--task Pace-AnymalD-v0] [--num_envs 512 4096 16384 65536] [--steps 200]

The environment steps on random targets and its torques are kept; then both start from the same state again and
again, in turns: ``env.simulate`` (action, drives, physics), and the physics alone with those torques copied in.
For walking tasks ``env.step`` is timed, too (rewards, ends, resets, commands, observations), against the physics along
its motion: torques are copied in, and before each control step the state that the environment had, resets included;
what these copies of the state take is measured alone and taken off. ``--plain`` leaves every operation of torch a
kernel of its own.
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


def measure(task: str, num_envs: int, steps: int, device: str, plain: bool) -> dict[str, object]:
    """Physics steps per second, bare and with the environment around them."""
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.seed, cfg.sim.device, cfg.sim.fused = num_envs, 0, device, not plain
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
        torques.clear()
        row |= measure_step(env, actions[:60])
    env.close()
    return row


def measure_step(env: ManagerBasedRLEnv, actions: torch.Tensor) -> dict[str, object]:
    """Physics steps per second of ``env.step``, and of the physics alone along its motion."""
    sim, decimation, count = env.sim, env.cfg.decimation, len(actions)
    assert isinstance(sim, WarpSimulation)
    state, step = [sim.bind(name) for name in STATE], sim.step
    env.reset(seed=0)
    for action in actions:  # graphs are captured, robots have found their feet or fallen
        env.step(action)
    states, torques = list[list[torch.Tensor]](), list[torch.Tensor]()

    def keep() -> None:
        torques.append(sim.qfrc_applied.clone())
        step()

    sim.step = keep  # type: ignore[method-assign]
    for action in actions:
        states.append([field.clone() for field in state])
        env.step(action)
    sim.step = step  # type: ignore[method-assign]

    def put(k: int) -> None:
        for field, value in zip(state, states[k], strict=True):
            field.copy_(value)

    def bare(k: int) -> None:
        put(k)
        for i in range(decimation):
            sim.qfrc_applied.copy_(torques[k * decimation + i])
            step()

    whole, alone = [], []
    for _ in range(REPEATS):
        put(0)
        whole.append(seconds(lambda k: env.step(actions[k]), count))
        alone.append(seconds(bare, count) - seconds(put, count))
    return {
        "env_steps_per_s": env.num_envs * decimation / statistics.median(whole),
        "bare_along_env_steps_per_s": env.num_envs * decimation / statistics.median(alone),
        "env_part_of_bare": statistics.median(a / b for a, b in zip(alone, whole, strict=True)),
    }


def main() -> None:
    """Print one line per width, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", default="Pace-AnymalD-v0")
    parser.add_argument("--num_envs", type=int, nargs="+", default=[512, 4096, 16384, 65536])
    parser.add_argument("--steps", type=int, default=200, help="control steps (fewer for walking at large widths)")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--plain", action="store_true", help="every operation of torch is a kernel of its own")
    args = parser.parse_args()
    print(torch.cuda.get_device_name(args.device))
    for num_envs in args.num_envs:
        print(json.dumps(measure(args.task, num_envs, args.steps, args.device, args.plain)), flush=True)


if __name__ == "__main__":
    main()
