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
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as scripts/train.py does

import numpy as np
import torch
from transfer_robot import make_real
from transfer_table import make_table, plot_transfer
from workers import pinned_pool

from pace_envs.rl import Evaluation, PlaySettings, play
from pace_envs.rl.training import EditCfg
from pace_optim.data_collection.plant import PlantCfg, Truth, draw_base, make_suite, plant_robot, simulate_runs
from pace_optim.diagnosis import DiagnosisSettings, diagnose
from pace_optim.identification.fit import fit
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
ROBOT, TASK = "Pace-AnymalD-v0", "Pace-AnymalD-Velocity-v0"
HIDDEN = {"torque_gain": {"gain": 0.75}}
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
    print(diagnosis.summary, *diagnosis.evidence, sep="\n")
    runs = {"base": str(base), "diagnosed": str(diagnosis.runs[-1]), "verdict": diagnosis.verdict}
    done.write_text(json.dumps(runs, indent=2))
    return runs


@dataclass(frozen=True, kw_only=True)
class Job:
    """A policy to train and to judge."""

    policy: str
    seed: int
    settings: argparse.Namespace
    """The command line."""
    options: tuple[str, ...] = ()
    """More options of scripts/train.py."""
    iterations: int = 0
    """Of its training, in all."""


def train(job: Job) -> str:
    """Train a policy on the processors of this process."""
    log = policies(job.settings.folder, job.policy, job.seed)
    log.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(SCRIPTS / "train.py"), "--task", TASK, "--seed", str(job.seed)]
    command += ["--log_dir", str(log), "--max_iterations", str(job.iterations), *job.options]
    start = time.perf_counter()
    with (log / "train.log").open("w") as out:
        subprocess.run(command, stdout=out, stderr=out, check=True)
    return f"{job.policy}, seed {job.seed}: trained in {(time.perf_counter() - start) / 60:.1f} min"


def judge(job: Job) -> dict[str, Any]:
    """Let a policy walk in its own world and on the "real" robot."""
    run = run_of(job.settings.folder, job.policy, job.seed)
    robot, truth = plant_robot(ROBOT), truth_of(job.settings.robot_seed)
    play_settings = PlaySettings(checkpoint=str(run), num_envs=job.settings.robots, seed=100 + job.seed)

    def walk(edit: EditCfg | None) -> dict[str, float]:
        result = play(play_settings, edit)
        if not isinstance(result, Evaluation):
            raise RuntimeError(f"{run} was not judged.")
        return asdict(result)

    worlds = {"own": walk(None), "real": walk(lambda cfg: make_real(cfg, robot, truth))}
    return {"policy": job.policy, "seed": job.seed, **worlds}


def run_all(settings: argparse.Namespace, fits: dict[str, str], results: Path) -> None:
    """Train and judge what is not done yet, as many at once as there are workers."""
    folder, seeds, common = settings.folder, range(settings.seeds), settings.start_iterations

    def jobs_of(policy: str, options: Sequence[str], iterations: int) -> list[Job]:
        return [
            Job(
                policy=policy,
                seed=seed,
                settings=settings,
                options=(*options, *([] if policy == START else ["--start_from", str(run_of(folder, START, seed))])),
                iterations=iterations,
            )
            for seed in seeds
        ]

    def train_missing(jobs: list[Job]) -> None:
        for told in pool.imap_unordered(train, [j for j in jobs if run_of(folder, j.policy, j.seed) is None], 1):
            print(told, flush=True)

    with pinned_pool(settings.workers) as pool:
        train_missing(jobs_of(START, [], common))
        jobs = [
            job
            for policy, options in VARIANTS.items()
            for job in jobs_of(policy, [fits.get(word, word) for word in options], common + settings.iterations)
        ]
        train_missing(jobs)
        known = {(line["policy"], line["seed"]) for line in read(results)}
        for line in pool.imap_unordered(judge, [job for job in jobs if (job.policy, job.seed) not in known], 1):
            with results.open("a") as file:
                file.write(json.dumps(line) + "\n")
            print(f"{line['policy']}, seed {line['seed']}: judged", flush=True)


def policies(folder: Path, policy: str, seed: int) -> Path:
    """Where a policy's training is kept."""
    return folder / "policies" / f"{policy.split()[0]}_{seed}"


def run_of(folder: Path, policy: str, seed: int) -> Path | None:
    """The folder of a finished training."""
    done = sorted(policies(folder, policy, seed).glob("*/*/exported/policy.json"))
    return done[-1].parents[1] if done else None


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
        run_all(args, fits, results)
    lines = read(results)
    print(make_table(lines))
    plot_transfer(lines, args.plot or args.folder / "transfer.png")


def read(results: Path) -> list[dict[str, Any]]:
    """What was judged so far."""
    return [json.loads(line) for line in results.read_text().splitlines()] if results.is_file() else []


if __name__ == "__main__":
    main()
