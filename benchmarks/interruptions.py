"""Kill and interrupt the commands at random instants, go on, and hold the result against that of one left alone.

    python benchmarks/interruptions.py --trials 50 --output interruptions.jsonl   # goes on where it was stopped

Each trial runs a command in a process of its own, sends SIGKILL, SIGINT or SIGTERM after a random part of the time that
it takes, then resumes (fit, train) or repeats (compare, diagnose) it. What it wrote must equal what one that was left
alone wrote, but for the times; no temporary file may be left.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
TIMES = ("wall_time_s", "search_time_s", "refine_time_s", "run", "runs")
"""Keys that say when and where, not what."""

WALK = "Pace-Go2-Velocity-v0"
BENCH = ["--task", "Pace-TestBench-v0"]
COMMANDS: dict[str, list[str]] = {
    "fit": ["fit", *BENCH, "--data", "r.npz", "--num_envs", "64", "--max_iteration", "60", "--log_dir", "runs"],
    "compare": ["compare", "base"],
    "diagnose": ["diagnose", "base", "--effects", "stribeck_friction", "--only", "--max_effects", "1", "--no_refit"],
    "train": [
        "train",
        "--task",
        "Pace-Go2-Velocity-v0",
        "--num_envs",
        "4",
        "--max_iterations",
        "4",
        "--log_dir",
        "runs",
    ],
}


def start(words: list[str], folder: Path) -> subprocess.Popen:
    """Start a command in a folder."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "scripts" / f"{words[0]}.py"), *words[1:]],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def finish(words: list[str], folder: Path) -> None:
    """Run a command to its end; it must succeed."""
    process = start(words, folder)
    error = process.communicate()[1].decode(errors="replace")
    if process.returncode:
        raise RuntimeError(f"{' '.join(words)}: {process.returncode} {error[-300:]}")


def made(folder: Path) -> list[Path]:
    """Folders of runs that a command began."""
    return sorted(path.parent for path in folder.glob("runs/*/*/settings.json"))


def outcome(command: str, run: Path) -> dict[str, Any]:
    """What a run says, without times and places."""
    names = {
        "fit": ("result.json", "history.json"),
        "compare": ("comparison.json",),
        "diagnose": ("diagnosis.json",),
        "train": (),
    }[command]
    content = {name: _without_times(json.loads((run / name).read_text())) for name in names}
    if command == "train":
        content["checkpoints"] = sorted(path.name for path in run.glob("model_*.pt"))
    return content


def _without_times(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _without_times(value) for key, value in content.items() if key not in TIMES}
    return [_without_times(value) for value in content] if isinstance(content, list) else content


def prepare(folder: Path) -> None:
    """A recording and a run of it."""
    words = ["data_collection", *BENCH, "--duration", "6", "--max_frequency", "3", "--noise", "1e-4", "--no_plot"]
    finish([*words, "--output", "r.npz"], folder)
    finish([*COMMANDS["fit"][:-1], "first"], folder)
    shutil.move(next(path.parent for path in folder.glob("first/*/*/settings.json")), folder / "base")
    shutil.rmtree(folder / "first")


def alone(command: str, start_folder: Path, scratch: Path) -> tuple[dict[str, Any], float]:
    """Outcome and time of a command that nobody disturbs [s]."""
    folder = scratch / "alone"
    shutil.copytree(start_folder, folder)
    begin = time.monotonic()
    finish(COMMANDS[command], folder)
    seconds = time.monotonic() - begin
    run = made(folder)[0] if command in ("fit", "train") else folder / "base"
    found = outcome(command, run)
    shutil.rmtree(folder)
    return found, seconds


def disturb(command: str, seconds: float, rng: random.Random, start_folder: Path, scratch: Path) -> dict[str, Any]:
    """Interrupt a command, go on, and say what came of it."""
    folder = scratch / "disturbed"
    shutil.copytree(start_folder, folder)
    number, after = rng.choice(SIGNALS), rng.uniform(0.3, 1.0) * seconds
    process = start(COMMANDS[command], folder)
    try:
        process.communicate(timeout=after)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
        process.communicate(timeout=120)
    runs = made(folder)
    going_on = command in ("fit", "train") and bool(runs)
    ready = going_on and (command == "fit" or any(runs[0].glob("model_*.pt")))
    if going_on and not (runs[0] / "checkpoint.npz").exists() and command == "fit":
        ready = False  # it had not begun: nothing is there to go on with
    if not ready:
        shutil.rmtree(folder / "runs", ignore_errors=True)
    finish([command, "--resume", str(runs[0])] if ready else COMMANDS[command], folder)
    run = made(folder)[0] if command in ("fit", "train") else folder / "base"
    found = outcome(command, run)
    left = [str(path.relative_to(folder)) for path in folder.rglob(".*.tmp")]
    shutil.rmtree(folder)
    status = process.returncode
    return {"signal": number.name, "after_s": round(after, 2), "status": status, "went_on": ready, "left": left} | {
        "outcome": found
    }


def main() -> int:
    """Run the trials, print the table; 1 if one came out otherwise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=50, help="of each command")
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="a line of JSON for each trial; those there are not run again")
    args = parser.parse_args()
    lines = args.output.read_text().splitlines() if args.output and args.output.exists() else []
    done = {(trial["command"], trial["number"]): trial for trial in map(json.loads, lines)}
    with tempfile.TemporaryDirectory() as place:
        start_folder = Path(place) / "start"
        start_folder.mkdir()
        prepare(start_folder)
        for command in args.commands:
            expected, seconds = alone(command, start_folder, Path(place))
            for number in range(args.trials):
                if (command, number) in done:
                    continue
                rng = random.Random(f"{args.seed}/{command}/{number}")
                trial = disturb(command, seconds, rng, start_folder, Path(place))
                equal = trial.pop("outcome") == expected
                done[command, number] = trial = {"command": command, "number": number, "equal": equal, **trial}
                if args.output:
                    with args.output.open("a") as file:
                        file.write(json.dumps(trial) + "\n")
    print("| command | trials | went on | equal | temporary files left |\n|---|---|---|---|---|")
    for command in args.commands:
        own = [trial for (name, _), trial in done.items() if name == command]
        counts = (len(own), *(sum(bool(t[key]) for t in own) for key in ("went_on", "equal", "left")))
        print(f"| {command} | " + " | ".join(map(str, counts)) + " |")
    return int(not all(trial["equal"] and not trial["left"] for trial in done.values()))


if __name__ == "__main__":
    sys.exit(main())
