"""What a fit costs and how close it comes, on the reference recording of ANYmal D (49 parameters, noise-free).

    python benchmarks/identification.py
    python benchmarks/identification.py --cmaes_seconds      # and PACE's own search in the hybrid's wall time

Runs ``pace_optim.fit`` as scripts/fit.py does, by the hybrid and by least squares alone from the centre of the bounds,
for each delay mode. Command delay takes the robot's own recording; for effort delay one is simulated with the same
truth and commands. Times are those of the whole fit: loading, error bars and report included. With ``--split`` each
fit is run once more with the physics timed. Prints a table and writes ``identification.json``; exits 1 where a fit
misses what ``--check`` asks for.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from solver_trace import machine, table, write_json

from pace_envs.simulation import Simulation
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.estimate.search import search
from pace_optim.identification.fit import fit
from pace_optim.problem.problem import Problem, load_problem
from pace_optim.problem.rollout import Rollout
from pace_optim.recording import load_recording
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.cli import run_cli
from pace_optim.terminal.progress import ProgressLine

TASK = "Pace-AnymalD-v0"
LARGEST_SCORE, LARGEST_ERROR = 1e-12, 1e-3
LIMITS = {"hybrid": (30.0, 8e6), "least_squares": (15.0, 2.5e6)}
"""Largest wall time [s] and number of simulated steps."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One fit's cost and accuracy."""

    optimizer: str
    delay_mode: str
    seconds: float
    """Wall time [s]."""
    simulated_steps: int
    """Steps of all simulations together."""
    score: float
    """[rad²]."""
    largest_error: float
    """Largest |value - truth| / range of the bounds."""
    worst: str
    """The parameter that has it."""
    physics_seconds: float | None = None
    """Time inside MuJoCo, in another run [s]."""
    python_seconds: float | None = None
    """The rest of that run [s]."""

    @property
    def passed(self) -> bool:
        """Whether it is as fast and as exact as it should be."""
        seconds, steps = LIMITS[self.optimizer]
        exact = self.score <= LARGEST_SCORE and self.largest_error <= LARGEST_ERROR
        return exact and self.seconds <= seconds and self.simulated_steps <= steps


def run_fit(optimizer: str, delay_mode: str, recording: Path, log_dir: Path, seed: int = 0) -> Run:
    """Fit once and compare with the truth."""
    settings = FitSettings(
        task=TASK, data=[str(recording)], optimizer=optimizer, delay_mode=delay_mode, seed=seed, log_dir=str(log_dir)
    )
    start = time.perf_counter()
    result, _ = fit(settings, ProgressLine(StringIO()))
    seconds = time.perf_counter() - start
    problem = load_problem(TASK, data=[recording], delay_mode=delay_mode)
    space = problem.space
    truth = space.from_dict(problem.env_cfg.sim2real.sample_params)
    error = ((space.from_dict(result.parameters) - truth) / (space.upper - space.lower)).abs()
    return Run(
        optimizer=optimizer,
        delay_mode=delay_mode,
        seconds=seconds,
        simulated_steps=result.simulated_steps,
        score=result.score,
        largest_error=float(error.max()),
        worst=space.labels[int(error.argmax())],
    )


@contextlib.contextmanager
def physics_timed() -> Iterator[list[float]]:
    """Collect the time inside ``Simulation.step`` in the yielded list's only entry [s]."""
    spent, step = [0.0], Simulation.step

    def timed(self: Simulation) -> None:
        start = time.perf_counter()
        step(self)
        spent[0] += time.perf_counter() - start

    Simulation.step = timed  # type: ignore[method-assign]
    try:
        yield spent
    finally:
        Simulation.step = step  # type: ignore[method-assign]


def reference_recording(delay_mode: str, folder: Path) -> Path:
    """The robot's own recording, or for effort delay one simulated with its commands and truth."""
    problem = load_problem(TASK, delay_mode=delay_mode)
    own = Path(problem.env_cfg.sim2real.data_dir)
    if delay_mode == "command":
        return own
    space, env = problem.space, problem.make_env(1)
    truth = space.from_dict(problem.env_cfg.sim2real.sample_params)
    rollout = Rollout(env, problem.dataset, space)
    rollout.start(truth[None], problem.dataset.sampled)
    encoder = [(sim_dof_pos - truth[space["encoder_bias"]])[0].numpy().copy() for sim_dof_pos, _ in rollout]
    env.close()
    content = dict(np.load(own))
    path = folder / f"chirp_{delay_mode}.npz"
    np.savez(path, **{**content, "dof_pos": np.stack(encoder), "name": f"chirp_{delay_mode}"})
    load_recording(path)
    return path


@dataclass(kw_only=True)
class SearchRun:
    """PACE's own search: one strategy over all 49 parameters."""

    population: int
    seconds: list[float]
    """Wall time after each generation [s]."""
    best: list[float]
    """Best score so far [rad²]."""
    simulated_steps: int = 0

    def at(self, seconds: float) -> float:
        """Best score at a wall time; infinite before the first generation's end."""
        return next(
            (b for t, b in zip(reversed(self.seconds), reversed(self.best), strict=True) if t <= seconds), np.inf
        )


def joint_search(problem: Problem, seconds: float, population: int, seed: int = 0) -> SearchRun:
    """Search from the centre of the bounds for that long; the generation under way is finished."""
    cfg = replace(CMAESOptimizerCfg.of(problem.env_cfg.sim2real), per_tree=False, max_iteration=10**9, epsilon=None)
    run = SearchRun(population=population, seconds=[], best=[])
    start = time.perf_counter()
    evaluator = problem.evaluator()
    optimizer = CMAESOptimizer(problem.space, population, cfg, trees=problem.trees, seed=seed)

    def after_generation(_: CMAESOptimizer) -> None:
        run.seconds.append(time.perf_counter() - start)
        run.best.append(optimizer.best_score)
        if run.seconds[-1] >= seconds:
            optimizer.stop("time")

    search(optimizer, evaluator.rollout(population), after_generation)
    run.simulated_steps = evaluator.simulated_steps
    return run


def report(runs: list[Run]) -> str:
    """The table."""
    rows = [
        [
            f"{run.optimizer}, {run.delay_mode} delay",
            f"{run.seconds:.1f}",
            f"{run.simulated_steps / 1e6:.2f}",
            f"{run.score:.1e}",
            f"{run.largest_error:.1e}",
            run.worst,
            "" if run.physics_seconds is None else f"{run.physics_seconds:.1f} + {run.python_seconds:.1f}",
            "yes" if run.passed else "NO",
        ]
        for run in runs
    ]
    header = ["", "wall time [s]", "M steps", "score [rad²]", "largest error/range", "of", "physics + Python [s]", "ok"]
    return table(header, rows)


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--optimizers", nargs="+", default=["hybrid", "least_squares"], choices=list(LIMITS))
    parser.add_argument("--delay_modes", nargs="+", default=["command", "effort"], choices=["command", "effort"])
    parser.add_argument("--split", action=argparse.BooleanOptionalAction, default=True, help="time the physics too")
    parser.add_argument(
        "--cmaes_seconds",
        nargs="?",
        type=float,
        const=0.0,
        help="search with one 49-dimensional CMA-ES too, for that long or, without a number, for the hybrid's time",
    )
    parser.add_argument("--cmaes_population", type=int, default=512, help="candidates per generation of that search")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("logs/benchmarks"), help="folder of the JSON")
    parser.add_argument("--check", action="store_true", help="exit 1 where a fit is too slow or not exact")
    args = parser.parse_args()

    content: dict[str, Any] = {"measured_on": machine()}
    runs: list[Run] = []
    with tempfile.TemporaryDirectory() as folder:
        for delay_mode in args.delay_modes:
            recording = reference_recording(delay_mode, Path(folder))
            for optimizer in args.optimizers:
                print(f"{optimizer}, {delay_mode} delay ...", file=sys.stderr)
                run = run_fit(optimizer, delay_mode, recording, Path(folder), args.seed)
                if args.split:
                    with physics_timed() as spent:
                        again = run_fit(optimizer, delay_mode, recording, Path(folder), args.seed)
                    run = replace(run, physics_seconds=spent[0], python_seconds=again.seconds - spent[0])
                runs.append(run)
    print(*report(runs).split("\n"), sep="\n")
    content["runs"] = [{**asdict(run), "passed": run.passed} for run in runs]
    if args.cmaes_seconds is not None:
        hybrid = [run.seconds for run in runs if run.optimizer == "hybrid" and run.delay_mode == "command"]
        seconds = args.cmaes_seconds or (hybrid[0] if hybrid else 0.0)
        if not seconds:
            raise ValueError("There is no hybrid fit with command delay to take the time of. Give --cmaes_seconds S.")
        searched = joint_search(load_problem(TASK), seconds, args.cmaes_population, args.seed)
        by_then = searched.at(seconds)
        print(
            f"\none 49-dimensional CMA-ES, population {searched.population}, after {seconds:.1f} s: "
            + (f"score {by_then:.1e} rad²" if np.isfinite(by_then) else "its first generation was not done")
            + f" (generation {len(searched.best)} ended at {searched.seconds[-1]:.1f} s with {searched.best[-1]:.1e})"
        )
        content["joint_cmaes"] = {"stopped_at_s": seconds, **asdict(searched)}
    write_json(args.output / "identification.json", content)
    print("", args.output / "identification.json", sep="\n")
    return int(args.check and not all(run.passed for run in runs))


if __name__ == "__main__":
    sys.exit(run_cli(main))
