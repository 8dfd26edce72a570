"""Control steps of an environment on a GPU against bare MuJoCo Warp along the same motion, in the same run.

    python benchmarks/gpu_throughput.py [--task Pace-AnymalD-v0] [--num_envs 512 4096 16384 65536] [--steps 200]
        [--effect stribeck_friction] [--own_reward]

The environment steps on random targets and its torques are kept; then both start from the same state again and
again, in turns: ``env.simulate`` (action, drives, physics), and the physics alone with those torques copied in.
``env.step`` is timed, too (rewards, ends, resets, commands, observations), against the physics along its motion:
torques are copied in, and before each control step the state that the environment had, resets included. What the GPU
takes for the copies of the state, and of the friction that effects write, is measured alone and taken off. ``--effect``
gives the drives an effect at its start values, ``--own_reward`` the task a reward that is not this package's.
``--plain`` leaves every operation of torch a kernel of its own.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable

import torch

from pace_actuators.effects import EffectCfg, get_effect
from pace_envs import ManagerBasedRLEnv, load_env_cfg
from pace_envs.managers import RewardTermCfg
from pace_envs.managers.manager_base import term_items
from pace_envs.warp_simulation import WarpSimulation

REPEATS, COPIES = 5, 50
STATE = ("qpos", "qvel", "qacc_warmstart")
PASSIVE = ("dof_frictionloss", "dof_damping")


def seconds(call: Callable[[int], object], count: int) -> float:
    """Time of one of so many calls on the device."""
    torch.cuda.synchronize()
    start = time.perf_counter()
    for k in range(count):
        call(k)
    torch.cuda.synchronize()
    return (time.perf_counter() - start) / count


def smooth_torques(env: ManagerBasedRLEnv, scale: float) -> torch.Tensor:
    """A user's reward: torques shall not be large, (num_envs,)."""
    torque = env.scene["robot"].data.applied_torque
    return torch.exp(-(torque / scale).square().mean(dim=1))


def environment(args: argparse.Namespace, num_envs: int) -> ManagerBasedRLEnv:
    """The task as the options have it."""
    cfg = load_env_cfg(args.task)
    cfg.scene.num_envs, cfg.seed, cfg.sim.device, cfg.sim.fused = num_envs, 0, args.device, not args.plain
    if args.effect:
        values = {each.name: each.start for each in get_effect(args.effect).parameters}
        for drive in cfg.scene.robot.actuators.values():
            drive.effects = [EffectCfg(effect=args.effect, values=values)]
    if args.own_reward:
        own = RewardTermCfg(func=smooth_torques, weight=0.1, params={"scale": 50.0})
        cfg.rewards = {**term_items(cfg.rewards), "smooth_torques": own}
    return ManagerBasedRLEnv(cfg)


class Motion:
    """What the physics is given along a motion of an environment: states, and torques and frictions step by step."""

    def __init__(self, env: ManagerBasedRLEnv):
        """Look at an environment's simulation."""
        assert isinstance(env.sim, WarpSimulation)
        self._sim, self._step, self._decimation = env.sim, env.sim.step, env.cfg.decimation
        self._state = [env.sim.bind(name) for name in STATE]
        passive = [env.sim.expand(name) for name in PASSIVE]
        drives = env.scene["robot"].actuators.values()
        self._inputs = [env.sim.qfrc_applied, *(passive if any(drive.changes_passive for drive in drives) else [])]
        self._states, self._given = list[list[torch.Tensor]](), list[list[torch.Tensor]]()

    def record(self, call: Callable[[], object]) -> None:
        """Keep what a control step starts from, and what its physics is given."""
        self._states.append([field.clone() for field in self._state])
        self._sim.step = self._keep  # type: ignore[method-assign]
        call()
        self._sim.step = self._step  # type: ignore[method-assign]

    def put(self, k: int) -> None:
        """The state before a control step."""
        for field, value in zip(self._state, self._states[k], strict=True):
            field.copy_(value)

    def bare(self, k: int) -> None:
        """The physics of a control step alone, from its state."""
        self.put(k)
        for i in range(self._decimation):
            self._copy(k * self._decimation + i, 0)
            self._step()

    def extra_s(self) -> float:
        """Time that a GPU takes for the copies in it that are no torques [s]."""
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            for _ in range(COPIES):
                self.put(0)
                for i in range(self._decimation):
                    self._copy(i, 1)
        return seconds(lambda _: graph.replay(), COPIES) / COPIES

    def _keep(self) -> None:
        self._given.append([field.clone() for field in self._inputs])
        self._step()

    def _copy(self, i: int, first: int) -> None:
        for field, value in zip(self._inputs[first:], self._given[i][first:], strict=True):
            field.copy_(value)


def part_of_bare(
    env: ManagerBasedRLEnv, call: Callable[[torch.Tensor], object], actions: torch.Tensor
) -> tuple[float, float, float]:
    """Physics steps per second of calls of the environment and of the physics along their motion, and their ratio."""
    count, steps = len(actions), env.num_envs * env.cfg.decimation
    for action in [*actions, *actions]:  # graphs are captured, robots have found their feet or fallen
        call(action)
    motion = Motion(env)
    graphs = env.cfg.sim.graphs
    env.cfg.sim.graphs = False  # its physics is called step by step
    for action in actions:
        motion.record(lambda action=action: call(action))  # type: ignore[misc]
    env.cfg.sim.graphs = graphs
    for action in actions[:20]:
        call(action)
    extra, whole, alone = motion.extra_s(), [], []
    for _ in range(REPEATS):
        motion.put(0)
        whole.append(seconds(lambda k: call(actions[k]), count))
        alone.append(seconds(motion.bare, count) - extra)
    ratio = statistics.median(a / b for a, b in zip(alone, whole, strict=True))
    return steps / statistics.median(whole), steps / statistics.median(alone), ratio


def measure(args: argparse.Namespace, num_envs: int) -> dict[str, object]:
    """Physics steps per second, bare and with the environment around them."""
    begin = time.perf_counter()
    env = environment(args, num_envs)
    env.reset(seed=0)
    size = 0.1 if env.cfg.sim.contacts else 0.3
    actions = size * torch.randn(args.steps, num_envs, env.action_manager.total_action_dim, device=args.device)
    env.step(actions[0])
    torch.cuda.synchronize()
    row: dict[str, object] = {
        "task": args.task,
        "effect": args.effect,
        "own_reward": args.own_reward,
        "num_envs": num_envs,
        "first_step_after_s": time.perf_counter() - begin,
    }
    for name, call in (("control", env.simulate), ("env", env.step)):
        own, bare, ratio = part_of_bare(env, call, actions)
        row |= {f"{name}_steps_per_s": own, f"bare_along_{name}": bare, f"{name}_part_of_bare": ratio}
    env.close()
    return row


def main() -> None:
    """Print one line per width, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", default="Pace-AnymalD-v0")
    parser.add_argument("--num_envs", type=int, nargs="+", default=[512, 4096, 16384, 65536])
    parser.add_argument("--steps", type=int, default=200, help="control steps (fewer for walking at large widths)")
    parser.add_argument("--effect", help="name of an effect that the drives get")
    parser.add_argument("--own_reward", action="store_true", help="a reward that is not this package's")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--plain", action="store_true", help="every operation of torch is a kernel of its own")
    args = parser.parse_args()
    print(torch.cuda.get_device_name(args.device))
    for num_envs in args.num_envs:
        print(json.dumps(measure(args, num_envs)), flush=True)


if __name__ == "__main__":
    main()
