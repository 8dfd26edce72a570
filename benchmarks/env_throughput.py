"""How much of MuJoCo's own speed an environment keeps.

    python benchmarks/env_throughput.py --num_envs 512

Steps Pace-AnymalD-v0 through ``env.step`` and ``env.simulate`` and, in turns with them, a bare ``mujoco.batch`` loop
over the same model, parameters and chirp, whose torques are one NumPy expression. All three must arrive at the same
positions. Prints simulated steps per second (all environments together) and the ratio to the bare loop, median and
worst of the repetitions; exits 1 below the ratio that ``--at_least`` asks for.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import gymnasium as gym
import numpy as np
import torch
from mujoco import batch

import pace_envs

TASK = "Pace-AnymalD-v0"
ARMATURE, VISCOUS_FRICTION, FRICTION, ENCODER_BIAS, DELAY = 0.1, 4.5, 0.05, 0.05, 5


def chirp(steps: int, dt: float) -> np.ndarray:
    """Targets of a sweep from 0.1 to 10 Hz, as PACE excites this robot, (steps, 12) [rad]."""
    time_s = np.arange(steps) * dt
    signal = np.sin(2 * np.pi * (0.1 + 0.5 * 9.9 / 20.0 * time_s) * time_s)[:, None]
    excitation = pace_envs.load_env_cfg(TASK).sim2real.excitation
    return (signal + excitation.bias) * np.array(excitation.direction) * np.array(excitation.scale)


def environment(num_envs: int) -> pace_envs.ManagerBasedRLEnv:
    """The environment with the reference case's parameters."""
    env = gym.make(TASK, num_envs=num_envs, seed=0).unwrapped
    robot = env.scene["robot"]
    robot.write_joint_armature_to_sim(ARMATURE)
    robot.write_joint_viscous_friction_coefficient_to_sim(VISCOUS_FRICTION)
    robot.write_joint_friction_coefficient_to_sim(FRICTION)
    robot.actuators["legs"].update_encoder_bias(ENCODER_BIAS)
    robot.actuators["legs"].update_time_lags(float(DELAY))
    return env


def through(env: pace_envs.ManagerBasedRLEnv, advance: Callable, targets: np.ndarray) -> tuple[float, np.ndarray]:
    """Seconds, and final positions, of stepping the environment."""
    actions = torch.as_tensor(targets).unsqueeze(1).expand(-1, env.num_envs, -1)
    env.reset()
    with torch.inference_mode():
        start = time.perf_counter()
        for action in actions:
            advance(action)
        return time.perf_counter() - start, env.scene["robot"].data.joint_pos.numpy().copy()


class BareLoop:
    """The same simulations without an environment."""

    def __init__(self, env: pace_envs.ManagerBasedRLEnv):
        robot = env.scene["robot"]
        self.batch = batch.Batch(env.sim.model, env.num_envs)
        self.columns = robot.dof_columns.numpy()  # fixed base: hinges only, so these are qpos' columns too
        for field, value in [
            ("dof_armature", ARMATURE),
            ("dof_damping", VISCOUS_FRICTION),
            ("dof_frictionloss", FRICTION),
        ]:
            self.batch.expand(field)[:] = value
        self.batch.set_const()
        self.start = robot.data.default_joint_pos.numpy()[:, np.argsort(self.columns)]

    def run(self, targets: np.ndarray) -> tuple[float, np.ndarray]:
        """Seconds, and final positions."""
        delayed = targets[np.maximum(np.arange(len(targets)) - DELAY, 0)][:, np.argsort(self.columns)]
        self.batch.reset()
        q, v, torque = self.batch.bind("qpos"), self.batch.bind("qvel"), self.batch.bind("qfrc_applied")
        q[:] = self.start
        self.batch.forward()
        start = time.perf_counter()
        for target in delayed:
            torque[:] = np.clip(
                85.0 * (target - q + ENCODER_BIAS) - 0.6 * v,
                np.clip(-140.0 - 140.0 / 8.5 * v, -89.0, 89.0),
                np.clip(140.0 - 140.0 / 8.5 * v, -89.0, 89.0),
            )
            self.batch.step()
        return time.perf_counter() - start, q[:, self.columns].copy()


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_envs", type=int, default=512)
    parser.add_argument("--steps", type=int, default=400, help="steps a repetition")
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--at_least", type=float, default=0.0, help="ratio to the bare loop that env.step must reach")
    args = parser.parse_args()

    env = environment(args.num_envs)
    targets, bare = chirp(args.steps, env.step_dt), BareLoop(env)
    loops: dict[str, Callable[[], tuple[float, np.ndarray]]] = {
        "bare loop": lambda: bare.run(targets),
        "env.simulate": lambda: through(env, env.simulate, targets),
        "env.step": lambda: through(env, env.step, targets),
    }
    seconds: dict[str, list[float]] = {name: [] for name in loops}
    for _ in range(args.repetitions + 1):
        final = {}
        for name, loop in loops.items():
            elapsed, final[name] = loop()
            seconds[name].append(elapsed)
        for name, positions in final.items():
            if not np.allclose(positions, final["bare loop"], rtol=0, atol=1e-9):
                raise RuntimeError(f"{name} and the bare loop do not simulate the same.")

    simulated = args.num_envs * args.steps
    reference = np.array(seconds["bare loop"][1:])  # the first turn warms up
    print(f"{TASK}, {args.num_envs} environments, {args.steps} steps, {args.repetitions} repetitions in turns")
    print(f"{'':14}{'steps/s median':>16}{'min':>12}{'ratio median':>14}{'min':>8}")
    ratio = 1.0
    for name, values in seconds.items():
        rate, ratios = simulated / np.array(values[1:]), reference / np.array(values[1:])
        ratio = float(np.median(ratios))
        print(f"{name:14}{np.median(rate):16,.0f}{rate.min():12,.0f}{ratio:14.2f}{ratios.min():8.2f}")
    return int(ratio < args.at_least)


if __name__ == "__main__":
    sys.exit(main())
