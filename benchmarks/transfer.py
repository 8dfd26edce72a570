"""Does a policy walk better on the real robot when its training had the identified drives?

    python benchmarks/transfer.py --seeds 3 --workers 2
    python benchmarks/transfer.py --table

A "real" ANYmal D has drives with a delay and a hidden effect (transfer_robot.py; the plant shares no code with the
model). It is recorded in the air, identified and diagnosed. Of every seed a policy learns to walk with the task's own
drives, and goes on four times: with the same drives (nominal), with those under the usual randomisation, with the
identified base model, and with the diagnosed effect added. Each of the four then walks in the world it was trained in
and on the "real" robot. Everything is kept in --folder: what is done is not done again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as scripts/train.py does

import numpy as np
import torch
from transfer_robot import make_real
from transfer_table import make_table, plot_transfer

from pace_envs.rl import Evaluation, PlaySettings, play
from pace_optim.diagnosis import DiagnosisSettings, diagnose
from pace_optim.fit import fit
from pace_optim.fit_settings import FitSettings
from pace_optim.plant import PlantCfg, Truth, draw_base, make_suite, plant_robot, simulate_runs
from pace_optim.recording import save_recording

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
ROBOT, TASK = "Pace-AnymalD-v0", "Pace-AnymalD-Velocity-v0"
HIDDEN = {"torque_gain": {"gain": -0.25}}
"""All drives give a quarter less torque than they say."""
TRAINED_ON = ("chirp_medium", "triangle", "steps", "chirp_mass")
"""Recordings of the battery that are fitted; its multisine and other steps validate."""
START = "start"
"""The policy of a seed that all its others go on from, with the task's own drives."""
VARIANTS = {
    "a nominal": [],
    "b randomised": ["--randomize"],
    "c identified": ["--identified", "base"],
    "d diagnosed": ["--identified", "diagnosed"],
}
"""Policy -> options of scripts/train.py; the last word names a fit."""


def truth_of(seed: int) -> Truth:
    """What the "real" robot is like: drawn around PACE's sample parameters of ANYmal D."""
    return Truth(base=draw_base(plant_robot(ROBOT), np.random.default_rng(seed)), effects=HIDDEN)


def record(folder: Path, seed: int) -> dict[str, list[str]]:
    """Recordings of the "real" robot with its base held."""
    robot = plant_robot(ROBOT)
    suite = make_suite(robot, "battery", seed=seed)
    runs = [run for run in suite.train if run.name in TRAINED_ON]
    made = simulate_runs(robot, [*runs, *suite.validation], truth_of(seed), PlantCfg(seed=seed))
    files = [str(save_recording(folder / f"{each.name}.npz", each)) for each in made]
    return {"data": files[: len(runs)], "validation": files[len(runs) :]}


def identify(folder: Path, seed: int) -> dict[str, str]:
    """Fit and diagnose; the folders of both models' runs."""
    done = folder / "identified.json"
    if done.is_file():
        return json.loads(done.read_text())
    files = record(folder, seed)
    _, base = fit(FitSettings(task=ROBOT, optimizer="least_squares", log_dir=str(folder / "fits"), **files))
    diagnosis = diagnose(DiagnosisSettings(run=base, max_effects=2))
    print(diagnosis.summary)
    runs = {"base": str(base), "diagnosed": str(diagnosis.runs[-1]), "verdict": diagnosis.verdict}
    done.write_text(json.dumps(runs, indent=2))
    return runs


def train(folder: Path, policy: str, seed: int, iterations: int, options: list[str], processors: set[int]) -> None:
    """Train one policy on some of the processors."""
    if run_of(folder, policy, seed) is not None:
        return
    log = policies(folder, policy, seed)
    command = [sys.executable, str(SCRIPTS / "train.py"), "--task", TASK, "--seed", str(seed), "--log_dir", str(log)]
    command += ["--max_iterations", str(iterations), *options]
    log.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with (log / "train.log").open("w") as out:
        subprocess.run(
            command, stdout=out, stderr=out, check=True, preexec_fn=lambda: os.sched_setaffinity(0, processors)
        )
    print(f"{policy}, seed {seed}: trained in {(time.perf_counter() - start) / 60:.1f} min", flush=True)


def train_all(args: argparse.Namespace, fits: dict[str, str]) -> None:
    """Train what is not trained yet, as many at once as there are workers."""
    free = [set(share.tolist()) for share in np.array_split(sorted(os.sched_getaffinity(0)), args.workers)]

    def run(job: tuple[str, int]) -> None:
        policy, seed = job
        options, iterations = [], args.start_iterations
        if policy != START:
            options = [fits.get(word, word) for word in VARIANTS[policy]]
            options += ["--start_from", str(run_of(args.folder, START, seed))]
            iterations += args.iterations
        processors = free.pop()
        try:
            train(args.folder, policy, seed, iterations, options, processors)
        finally:
            free.append(processors)

    with ThreadPoolExecutor(args.workers) as pool:
        list(pool.map(run, [(START, seed) for seed in range(args.seeds)]))
        list(pool.map(run, [(policy, seed) for seed in range(args.seeds) for policy in VARIANTS]))


def policies(folder: Path, policy: str, seed: int) -> Path:
    """Where a policy's training is kept."""
    return folder / "policies" / f"{policy.split()[0]}_{seed}"


def run_of(folder: Path, policy: str, seed: int) -> Path | None:
    """The folder of a finished training."""
    done = sorted(policies(folder, policy, seed).glob("*/*/exported/policy.json"))
    return done[-1].parents[1] if done else None


def judge(folder: Path, seed: int, robots: int, variant: str, policy_seed: int) -> dict[str, Any]:
    """Let a policy walk in its own world and on the "real" robot."""
    run = run_of(folder, variant, policy_seed)
    robot, truth = plant_robot(ROBOT), truth_of(seed)

    def walk(**options: Any) -> dict[str, float]:
        result = play(PlaySettings(checkpoint=str(run), num_envs=robots, seed=100 + policy_seed), **options)
        if not isinstance(result, Evaluation):
            raise RuntimeError(f"{run} was not judged.")
        return asdict(result)

    own = walk()
    return {
        "policy": variant,
        "seed": policy_seed,
        "own": own,
        "real": walk(edit=lambda cfg: make_real(cfg, robot, truth)),
    }


def main() -> None:
    """Record, identify, train, judge, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="policies of each kind (default 3)")
    parser.add_argument("--start_iterations", type=int, default=400, help="of the common start (default 400)")
    parser.add_argument("--iterations", type=int, default=100, help="of each policy after it (default 100)")
    parser.add_argument("--robots", type=int, default=96, help="that walk 20 s each (default 96)")
    parser.add_argument("--robot_seed", type=int, default=0, help='draws the "real" robot')
    parser.add_argument("--workers", type=int, default=2, help="trainings at once (default 2)")
    parser.add_argument("--folder", type=Path, default=Path("logs/transfer"), help="where all goes")
    parser.add_argument("--plot", type=Path, help="picture of the table (default: transfer.png in --folder)")
    parser.add_argument("--table", action="store_true", help="only print what is done")
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.folder = args.folder.resolve()
    args.folder.mkdir(parents=True, exist_ok=True)
    results = args.folder / "results.jsonl"
    if not args.table:
        fits = identify(args.folder, args.robot_seed)
        train_all(args, fits)
        known = {(line["policy"], line["seed"]) for line in read(results)}
        for job in ((policy, seed) for seed in range(args.seeds) for policy in VARIANTS):
            if job not in known:
                line = judge(args.folder, args.robot_seed, args.robots, *job)
                with results.open("a") as file:
                    file.write(json.dumps(line) + "\n")
                print(f"{job[0]}, seed {job[1]}: judged", flush=True)
    lines = read(results)
    print(make_table(lines))
    plot_transfer(lines, args.plot or args.folder / "transfer.png")


def read(results: Path) -> list[dict[str, Any]]:
    """What was judged so far."""
    return [json.loads(line) for line in results.read_text().splitlines()] if results.is_file() else []


if __name__ == "__main__":
    main()
