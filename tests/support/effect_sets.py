"""Random sets of effects within their bounds, side by side on a robot: nothing may blow up.

python tests/support/effect_sets.py --tasks Pace-SO101-v0 --rows 48 --seconds 20     # the long form of the test
"""

from __future__ import annotations

import argparse
import math
import random
import sys

import torch
from effect_envs import EFFECTS, Bench, long_chirp, null_values
from problems import BENCH, env_cfg

from pace_actuators.effects import PROBED_STIFFNESS, get_effect
from pace_optim.problem.parameter_space import ParameterSpace

TASKS = (BENCH, "Pace-SO101-v0", "Pace-AnymalD-v0", "Pace-Go2-v0")


def draw(rng: random.Random, effects: list[str], corners: bool) -> dict[str, float]:
    """Values of these effects within their bounds; at the bounds if ``corners``."""
    values = {}
    for name in effects:
        for p in get_effect(name).parameters:
            low, high = p.lower, p.upper
            if corners:
                values[f"{name}.{p.name}"] = rng.choice((low, high))
            elif p.scale == "log":
                values[f"{name}.{p.name}"] = math.exp(rng.uniform(math.log(low), math.log(high)))
            else:
                values[f"{name}.{p.name}"] = rng.uniform(low, high)
    return values


def rows_of(count: int, seed: int) -> list[dict[str, float]]:
    """Sets of effects: the one that blew up first, all effects at once, elasticity with backlash, and random ones.

    Without curves: their knots, drawn at random, are no physics. An inertia that a curve divides by 20 has another
    elasticity than a transmission knows of.
    """
    worst = {"quadratic_friction.coefficient": -1.0, "joint_elasticity.stiffness": 2e4, "joint_elasticity.damping": 0.0}
    rows: list[dict[str, float]] = [worst]
    for r in range(1, count):
        rng = random.Random(f"{seed}/{r}")
        every = [name for name in EFFECTS if not get_effect(name).free_form]
        chosen = every if r % 4 == 0 else rng.sample(every, rng.randint(2, 6))
        if r % 4 == 1:
            chosen += sorted({"joint_elasticity", "backlash"} - set(chosen))
        rows.append(draw(rng, chosen, corners=r % 2 == 0))
    return rows


def blown_up(task: str, rows: list[dict[str, float]], seconds: float, seed: int, largest: float) -> list[int]:
    """Rows whose joints end up somewhere that is not finite, or further away than anything could throw them [rad]."""
    cfg = env_cfg(task)
    space = ParameterSpace.of(cfg.sim2real)
    generator = torch.Generator().manual_seed(seed)
    base = {}
    for parameter in space.parameters:
        low, high = (torch.tensor([v]) if not torch.is_tensor(v) else v for v in (parameter.lower, parameter.upper))
        low, high = low.double().reshape(-1)[:1], high.double().reshape(-1)[:1]
        part = torch.rand(len(rows), generator=generator, dtype=torch.float64)
        part[0] = 0.0  # the lowest armature and friction
        base[parameter.name] = low + part * (high - low)
    values = {}
    nulls = {key: value for name in EFFECTS for key, value in null_values(name).items()}
    loop = min(float(drive.stiffness) for drive in cfg.scene.robot.actuators.values())
    scaled = {f"{name}.{p.name}" for name in EFFECTS for p in get_effect(name).parameters if p.follows_loop}
    for key, null in nulls.items():
        size = loop / PROBED_STIFFNESS if key in scaled else 1.0
        values[key] = torch.tensor([size * row.get(key, null) for row in rows], dtype=torch.float64)
    bench = Bench(list(EFFECTS), values, num_envs=len(rows), base=base, task=task)
    middle = torch.as_tensor(bench.robot.data.default_joint_pos[0]).numpy()
    targets = middle + 0.4 * long_chirp(seconds)
    reached = bench.follow(targets)
    bad = ~(reached.isfinite() & (reached.abs() < largest)).all(dim=2).all(dim=0)
    return bad.nonzero()[:, 0].tolist()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--rows", type=int, default=48)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    failed = 0
    for task in args.tasks:
        rows = rows_of(args.rows, args.seed)
        bad = blown_up(task, rows, args.seconds, args.seed, max(1e3, 400 * args.seconds))
        print(f"{task}: {len(bad)} of {len(rows)} sets blow up within {args.seconds:g} s", flush=True)
        for r in bad[:10]:
            print(" ", r, {k: float(f"{v:.3g}") for k, v in rows[r].items()} if len(rows[r]) < 30 else "all effects")
        failed += len(bad)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
