"""The small cases of ../shared/cases: what a fit finds of each, beside what is true.

    python benchmarks/cases.py ../shared/cases --folder /tmp/cases            # all rows, one after another
    python benchmarks/cases.py ../shared/cases --folder /tmp/cases --rows plain leg_mcap
    python benchmarks/cases.py ../shared/cases --folder /tmp/cases --table    # of what has been run

Each row is the command line of a user, run as it stands; what it said and found is kept in the folder, so that a run
that was broken off goes on. Maps that state gains a log does not hold are written there too.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
BENCH = {"armature": 0.05, "viscous_friction": 0.5, "friction": 0.3, "encoder_bias": 0.01, "delay_ms": 5.0}
LEG = {"armature": 0.012, "viscous_friction": 0.1, "friction": 0.2, "encoder_bias": 0.02, "delay_ms": 6.0}
FOUR_BAR = {"armature": 0.004, "viscous_friction": 0.05, "friction": 0.04, "encoder_bias": 0.01, "delay_ms": 5.0}
ARM = {
    "armature": (0.1, 0.1, 0.02), "viscous_friction": (4.0, 4.0, 0.4), "friction": (1.5, 1.0, 0.2),
    "encoder_bias": (0.004, -0.003, 0.002), "delay_ms": 0.0,
}  # fmt: skip
LEG_FACTS = "[facts]\nstiffness = 40.0\ndamping = 1.0\n"
BENCH_FACTS = (
    "[facts]\nstiffness = 40.0\ndamping = 1.0\nload_mass = 1.0\nload_length = 0.2\narm_mass = 0.0\n"
    "saturation_effort = 1000.0\neffort_limit = 900.0\nvelocity_limit = 100.0\n"
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One row."""

    task: str = "Pace-TestBench-v0"
    """The robot: a name, or a model file below the folder of cases."""
    logs: tuple[str, ...] = ()
    """Files below the folder of cases; none: a motion that is simulated with the task's own sample parameters."""
    facts: str | None = None
    """What the log does not hold, put before the column map that ``import_log`` guesses."""
    corrected: Mapping[str, float] = field(default_factory=dict)
    """Facts that the file beside a recording states otherwise: the row is run on a copy."""
    right: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    """True values; one number stands for every joint."""
    says: str = ""
    """What must be said (a regular expression), where that is what is right."""
    options: tuple[str, ...] = ("--optimizer", "least_squares", "--no_consistency")
    """Of the fit."""
    compare: bool = False
    """Whether ``compare`` must run on it too."""


def _bench(name: str, **more: object) -> Case:
    return Case(logs=(f"bench/{name}.csv",), **{"right": BENCH, **more})  # type: ignore[arg-type]


CASES = {
    "plain": _bench("plain"),
    "velocity_target": _bench("velocity_target"),
    "feed_forward": _bench("feed_forward"),
    "one_way": _bench("one_way", right={}, compare=True),
    "two_clocks": Case(
        logs=("bench/two_clocks_states.csv", "bench/two_clocks_commands.csv"), facts=BENCH_FACTS, right=BENCH
    ),
    "wheel": _bench("wheel", right={name: BENCH[name] for name in BENCH if name != "encoder_bias"}),
    "wheel_without_load": _bench(
        "wheel", corrected={"load_mass": 0.0}, right={name: BENCH[name] for name in BENCH if name != "encoder_bias"}
    ),
    "timer_19_9_hz": _bench("timer_19_9_hz"),
    "faster_than_stated": _bench("faster_than_stated", right={}, says="velocity_limit|no-load speed"),
    "slash_names": Case(task="models/slash_names.xml", compare=True),
    "balanced_slide": Case(task="models/balanced_slide.xml", says=r"armature \[kg\]", compare=True),
    "four_bar": Case(task="models/four_bar.xml", logs=("models/four_bar.csv",), right=FOUR_BAR),
    "arm_file_gains": Case(task="models/arm_file_gains.xml", logs=("models/arm_file_gains.csv",), right=ARM),
    **{
        name: Case(task="models/leg.urdf", logs=(f"logs/{file}",), facts=LEG_FACTS, right=LEG)
        for name, file in (
            ("leg_mcap", "leg_mcap"), ("leg_sqlite3", "leg_sqlite3"), ("odd_names", "odd_names.csv"),
            ("lerobot_leg", "lerobot_leg"),
        )
    },
}  # fmt: skip


def run(name: str, case: Case, cases: Path, folder: Path) -> None:
    """Run a row's commands, unless it was run; keep what they said and found."""
    done = folder / f"{name}.found.json"
    if done.exists():
        return
    started = time.monotonic()
    task = case.task if case.task.startswith("Pace-") else str(cases / case.task)
    files = [str(cases / each) for each in case.logs]
    said: list[str] = []
    right = dict(case.right)
    if not files:
        files = [str(folder / f"{name}.csv")]
        said.append(_call("data_collection", "--task", task, "--output", files[0], "--duration", "8"))
        truth = json.loads(Path(files[0]).with_suffix(".truth.json").read_text()) if _has_truth(files[0]) else {}
        right.update(truth)
    if case.corrected:
        copy, own = folder / f"{name}.csv", Path(files[0])
        shutil.copyfile(own, copy)
        facts = json.loads(own.with_suffix(".json").read_text()) | dict(case.corrected)
        copy.with_suffix(".json").write_text(json.dumps(facts))
        files = [str(copy)]
    if case.facts is not None:
        guess, stated, recording = (folder / f"{name}{end}" for end in (".guess.toml", ".toml", ".csv"))
        for each in (guess, recording):
            each.unlink(missing_ok=True)
        said.append(_call("import_log", *files, "--task", task, "--write_map", guess))
        stated.write_text(case.facts + guess.read_text())
        said.append(_call("import_log", *files, "--task", task, "--columns", stated, "--output", recording))
        files = [str(recording)]
    command = ["fit", "--task", task, "--data", *files, *case.options, "--log_dir", str(folder / "runs")]
    said.append(_call(*command))
    path = Path(re.findall(r"^run: (.*)$", said[-1], re.M)[-1])
    if case.compare:
        said.append(_call("compare", path))
    result = json.loads((path / "result.json").read_text())
    kept = {name: result[name] for name in ("parameters", "delay_s", "std", "rmse", "undetermined", "at_bound")}
    kept |= {name: result[name] for name in ("warnings", "notes", "times_noise")}
    kept["findings"] = result.get("findings", [])
    text = {"command": " ".join(command), "said": "\n".join(said), "wall_time_s": time.monotonic() - started}
    done.write_text(json.dumps({**kept, **text, "right": right}, indent=1))


def _has_truth(path: str) -> bool:
    return Path(path).with_suffix(".truth.json").exists()


def _call(script: str, *arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / f"{script}.py"), *map(str, arguments)], capture_output=True, text=True
    )
    if done.returncode:
        raise ValueError(f"{script} ended with {done.returncode}: {(done.stderr or done.stdout).strip()[-600:]}")
    return done.stdout + done.stderr


def table(folder: Path) -> str:
    """What was found of each row, beside what is right."""
    lines = [
        "| row | armature | viscous | Coulomb | bias | delay [ms] | error, train / validation [mrad] | right |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, case in CASES.items():
        if not (folder / f"{name}.found.json").exists():
            continue
        found = json.loads((folder / f"{name}.found.json").read_text())
        groups = ("armature", "viscous_friction", "friction", "encoder_bias")
        cells = [_values(found, group) for group in groups]
        right = [_listed(found["right"][group]) for group in groups if group in found["right"]]
        right += [f"{found['right']['delay_ms']:g} ms"] if "delay_ms" in found["right"] else []
        told = " · ".join(right)
        if case.says:
            told = f"says {case.says!r}: {'yes' if re.search(case.says, found['said']) else 'no'}"
        error = " / ".join(f"{1e3 * found['rmse'][which]['all']:.4g}" for which in ("train", "validation"))
        lines.append(f"| {name} | {' | '.join(cells)} | {1e3 * found['delay_s']:.2f} | {error} | {told or 'works'} |")
    return "\n".join(lines)


def _values(found: dict, group: str) -> str:
    values = found["parameters"][group]
    marked = {*found["undetermined"], *found["at_bound"]}
    return ", ".join(f"{value:.4g}{'?' if f'{group}/{joint}' in marked else ''}" for joint, value in values.items())


def _listed(value: float | list[float]) -> str:
    return ", ".join(f"{each:g}" for each in value) if isinstance(value, list) else f"{value:g}"


def main() -> None:
    """Run rows, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, help="the folder of cases")
    parser.add_argument("--rows", nargs="+", metavar="ROW", default=[], help=f"of {', '.join(CASES)} (default: all)")
    parser.add_argument("--folder", type=Path, required=True, help="where what was found is kept")
    parser.add_argument("--table", action="store_true", help="run nothing")
    args = parser.parse_args()
    if unknown := [name for name in args.rows if name not in CASES]:
        parser.error(f"There is no row {unknown[0]!r}. Available: {', '.join(CASES)}.")
    args.folder.mkdir(parents=True, exist_ok=True)
    for name, case in CASES.items():
        if not args.table and (not args.rows or name in args.rows):
            try:
                run(name, case, args.cases, args.folder)
            except ValueError as error:
                print(f"{name}: {error}", file=sys.stderr, flush=True)
    print(table(args.folder))


if __name__ == "__main__":
    main()
