"""How fast a training environment is, and where a training's time goes.

    python benchmarks/rl_throughput.py --num_envs 512

Steps Pace-AnymalD-Velocity-v0 (--task) through ``env.step`` and, in turns with it, a bare ``mujoco.batch`` loop over
the same model, contacts and targets, whose torques are one NumPy expression; then Gymnasium's ``AsyncVectorEnv`` of
single MuJoCo environments with the same model. Then trains for a few iterations with every part timed. Exits 1 below
the ratio to the bare loop that ``--at_least`` asks for.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as scripts/train.py does

import gymnasium as gym
import mujoco
import numpy as np
import torch
from mujoco import batch

from pace_envs.rl import PaceOnPolicyRunner, RunSettings, make_env
from pace_envs.rl.training import load_cfg
from pace_envs.rsl_rl_wrapper import RslRlVecEnvWrapper

NOISE = 0.3  # standard deviation of the actions: the robots sway on their feet


class PdLaw:
    """Targets to torques in NumPy: gains and limits of the environment's drives, in the model's joint order."""

    def __init__(self, env: RslRlVecEnvWrapper):
        robot = env.unwrapped.scene["robot"]
        order = np.argsort(robot.dof_columns.numpy())
        values: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(robot.num_joints))
        for drive in robot.actuators.values():
            for name in ("stiffness", "damping", "saturation_effort", "effort_limit", "velocity_limit"):
                values[name][drive.joint_indices] = getattr(drive, name)[0].numpy()
        self.kp, self.kd, self.stall, self.limit, self.speed = (v[order] for v in values.values())
        self.offset = robot.data.default_joint_pos[0].numpy()[order]
        self.scale = float(env.unwrapped.action_manager.get_term("joint_pos").scale[0])

    def torque(self, target: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """[N m]."""
        drop = self.stall / self.speed * v
        within = np.clip(self.kp * (target - q) - self.kd * v, -self.stall - drop, self.stall - drop)
        return np.clip(within, -self.limit, self.limit)


def stance(env: RslRlVecEnvWrapper) -> np.ndarray:
    """The initial state's positions, (nq,)."""
    env.unwrapped.sim.reset([0])
    env.unwrapped.scene["robot"].reset([0])
    return env.unwrapped.sim.qpos[0].numpy().copy()


def plain_model(env: RslRlVecEnvWrapper) -> mujoco.MjModel:
    """The model of environment 0, with what the drives have written to it."""
    return env.unwrapped.sim.batch.get_model(0)


def time_bare(env: RslRlVecEnvWrapper, law: PdLaw, start: np.ndarray, actions: np.ndarray, decimation: int) -> float:
    """Seconds of the bare loop."""
    bare = batch.Batch(plain_model(env), env.num_envs)
    q, v, torque = bare.bind("qpos"), bare.bind("qvel"), bare.bind("qfrc_applied")
    q[:] = start
    bare.forward()
    begin = time.perf_counter()
    for action in actions:
        target = action * law.scale + law.offset
        for _ in range(decimation):
            torque[:, 6:] = law.torque(target, q[:, 7:], v[:, 6:])
            bare.step()
    return time.perf_counter() - begin


def time_env(env: RslRlVecEnvWrapper, actions: np.ndarray) -> float:
    """Seconds of ``env.step``."""
    env.reset()
    tensors = torch.as_tensor(actions, dtype=torch.float32)
    with torch.inference_mode():
        begin = time.perf_counter()
        for action in tensors:
            env.step(action)
        return time.perf_counter() - begin


class SingleEnv(gym.Env):
    """The same robot as one plain MuJoCo environment: 48 observations, a tracking reward, a fall ends it."""

    def __init__(self, model_bytes: bytes, law: PdLaw, start: np.ndarray, decimation: int):
        self.model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": model_bytes})
        self.data, self.law, self.start, self.decimation = mujoco.MjData(self.model), law, start, decimation
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (48,), np.float32)
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (12,), np.float32)
        self.command, self.action, self.time = np.zeros(3), np.zeros(12), 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Stand."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.start
        self.command, self.action, self.time = self.np_random.uniform(-1, 1, 3), np.zeros(12), 0
        return self._obs()[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Four physics steps."""
        self.action, target = action, action * self.law.scale + self.law.offset
        for _ in range(self.decimation):
            self.data.qfrc_applied[6:] = self.law.torque(target, self.data.qpos[7:], self.data.qvel[6:])
            mujoco.mj_step(self.model, self.data)
        self.time += 1
        obs, velocity, down = self._obs()
        reward = float(np.exp(-np.sum((velocity[:2] - self.command[:2]) ** 2) / 0.25))
        return obs, reward, bool(down[2] > -0.5), self.time >= 1000, {}

    def _obs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, self.data.qpos[3:7])
        world = rotation.reshape(3, 3)
        velocity, down = world.T @ self.data.qvel[:3], -world[2]
        joints = self.data.qpos[7:] - self.law.offset
        parts = [velocity, self.data.qvel[3:6], down, self.command, joints, self.data.qvel[6:], self.action]
        return np.concatenate(parts).astype(np.float32), velocity, down


def async_rate(
    env: RslRlVecEnvWrapper, law: PdLaw, start: np.ndarray, decimation: int, count: int, steps: int
) -> float:
    """Environment steps per second of ``AsyncVectorEnv`` with ``count`` processes."""
    model = plain_model(env)
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    data = buffer.tobytes()
    vector = gym.vector.AsyncVectorEnv([lambda: SingleEnv(data, law, start, decimation) for _ in range(count)])
    vector.reset(seed=0)
    actions = np.random.default_rng(0).normal(0.0, NOISE, (steps, count, 12)).astype(np.float32)
    for action in actions[: steps // 5]:
        vector.step(action)
    begin = time.perf_counter()
    for action in actions:
        vector.step(action)
    rate = steps * count / (time.perf_counter() - begin)
    vector.close()
    return rate


class Stopwatch:
    """Time inside methods, each without the timed methods that it calls."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._stack: list[list[Any]] = []

    def watch(self, owner: Any, method: str, label: str) -> None:
        """Time a method from now on."""
        inner: Callable = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._stack.append([time.perf_counter(), 0.0])
            try:
                return inner(*args, **kwargs)
            finally:
                begin, inside = self._stack.pop()
                elapsed = time.perf_counter() - begin
                self.seconds[label] += elapsed - inside
                if self._stack:
                    self._stack[-1][1] += elapsed

        setattr(owner, method, timed)


def breakdown(settings: RunSettings, iterations: int, learning_threads: int | None) -> tuple[dict[str, float], float]:
    """Seconds of each part of a training, and environment steps per second."""
    cfg = load_cfg(settings)
    env = make_env(cfg)
    base = env.unwrapped
    with contextlib.redirect_stdout(io.StringIO()):
        runner = PaceOnPolicyRunner(env, cfg.runner.to_dict(), learning_threads=learning_threads)
        runner.learn(1)  # warms up
    watch = Stopwatch()
    watch.watch(base.sim, "step", "physics")
    watch.watch(base.sim, "forward", "physics of resets")
    watch.watch(base.scene, "write_data_to_sim", "drives")
    watch.watch(base.action_manager, "process_taken", "action manager")
    watch.watch(base.action_manager, "apply_action", "action manager")
    watch.watch(base.scene, "update_sensors", "contact sensors")
    watch.watch(base.termination_manager, "compute", "termination manager")
    watch.watch(base.reward_manager, "compute", "reward manager")
    watch.watch(base.command_manager, "compute", "command manager")
    watch.watch(base.observation_manager, "compute", "observation manager")
    watch.watch(base, "_reset_idx", "resets")
    watch.watch(env, "step", "other parts of the environment")
    watch.watch(runner.alg, "act", "policy and value")
    watch.watch(runner.alg, "update", "learning")
    watch.watch(runner, "learn", "other parts of rsl-rl")
    with contextlib.redirect_stdout(io.StringIO()):
        begin = time.perf_counter()
        runner.learn(iterations)
        elapsed = time.perf_counter() - begin
    env.close()
    return dict(watch.seconds), iterations * cfg.runner.num_steps_per_env * base.num_envs / elapsed


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Pace-AnymalD-Velocity-v0")
    parser.add_argument("--num_envs", type=int, default=512)
    parser.add_argument("--steps", type=int, default=25, help="environment steps a repetition")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--async_envs", type=int, nargs="*", default=[2, 8, 32], help="processes of AsyncVectorEnv")
    parser.add_argument("--iterations", type=int, default=3, help="iterations of the timed training; 0 leaves it out")
    parser.add_argument("--learning_threads", type=int, help="torch's threads while learning (default: all processors)")
    parser.add_argument("--at_least", type=float, default=0.0, help="ratio to the bare loop that env.step must reach")
    args = parser.parse_args()

    settings = RunSettings(task=args.task, num_envs=args.num_envs, seed=0)
    cfg = load_cfg(settings)
    env, decimation = make_env(cfg), cfg.decimation
    law, start = PdLaw(env), stance(env)
    actions = np.random.default_rng(0).normal(0.0, NOISE, (args.steps, args.num_envs, 12))
    bare, ours = [], []
    for _ in range(args.repetitions + 1):
        bare.append(time_bare(env, law, start, actions, decimation))
        ours.append(time_env(env, actions))
    samples = args.num_envs * args.steps
    ratios = np.array(bare[1:]) / np.array(ours[1:])  # the first turn warms up
    rates = {"bare mujoco.batch loop": samples / np.median(bare[1:]), "env.step": samples / np.median(ours[1:])}
    for count in args.async_envs:
        rates[f"AsyncVectorEnv of {count}"] = async_rate(env, law, start, decimation, count, 4000 // count)
    env.close()

    load = os.getloadavg()[0]
    print(f"{args.task}, {args.num_envs} environments, {os.cpu_count()} processors, load {load:.1f}")
    print(f"{'':26}{'physics steps/s':>16}{'env steps/s':>14}{'of bare loop':>14}")
    for name, rate in rates.items():
        ratio = float(np.median(ratios)) if name == "env.step" else rate / rates["bare mujoco.batch loop"]
        print(f"{name:26}{rate * decimation:16,.0f}{rate:14,.0f}{ratio:14.3f}")
    if args.iterations:
        seconds, rate = breakdown(settings, args.iterations, args.learning_threads)
        print(f"\ntraining, {rate:,.0f} env steps/s")
        for name, value in sorted(seconds.items(), key=lambda item: -item[1]):
            print(f"  {name:32}{value / args.iterations:8.3f} s/iteration {100 * value / sum(seconds.values()):6.1f} %")
    return int(float(np.median(ratios)) < args.at_least)


if __name__ == "__main__":
    sys.exit(main())
