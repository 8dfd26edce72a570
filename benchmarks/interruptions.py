"""Kill and interrupt the commands at random instants, go on, and hold the result against that of one left alone.

    python benchmarks/interruptions.py --trials 50 --output interruptions.jsonl   # goes on where it was stopped

Each trial runs a command in a process of its own and sends SIGKILL, SIGINT or SIGTERM: every other time after a random
part of the time that it takes, else just before or after it puts a file in place. Then the command is resumed (fit,
train) or repeated (compare, diagnose). What it wrote must equal what one that was left alone wrote, but for the times;
no temporary file and no process may be left. A training that is resumed draws other episodes than one that was left
alone: its checkpoints up to the interruption must be equal bit for bit, and all those after it be there and readable.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import runpy
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
TIMES = ("wall_time_s", "search_time_s", "refine_time_s", "run", "runs")
"""Keys that say when and where, not what."""
LIMIT_S = 300

BENCH = ["--task", "Pace-TestBench-v0"]
COMMANDS: dict[str, list[str]] = {
    "fit": ["fit", *BENCH, "--data", "r.npz", "--num_envs", "64", "--max_iteration", "30", "--log_dir", "runs"],
    "compare": ["compare", "base"],
    "diagnose": ["diagnose", "base", "--effects", "stribeck_friction", "--only", "--max_effects", "1", "--no_refit"],
    "train": [
        "train",
        "--task",
        "Pace-Go2-Velocity-v0",
        "--num_envs",
        "2",
        "--max_iterations",
        "3",
        "--log_dir",
        "runs",
    ],
}
NEEDED = ("fit", "compare", "diagnose", "train", "data_collection")


def start(words: list[str], folder: Path, prepare: Callable[[], None] = lambda: None) -> int:
    """Start a command in a folder, in a forked process: everything is imported already. Returns its number."""
    pid = os.fork()
    if pid:
        return pid
    status = 99
    try:
        os.setsid()
        os.chdir(folder)
        for number, name in ((1, ".out"), (2, ".err")):
            os.dup2(os.open(folder.parent / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.argv = [f"scripts/{words[0]}.py", *words[1:]]
        prepare()
        runpy.run_path(str(ROOT / "scripts" / f"{words[0]}.py"), run_name="__main__")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    with contextlib.suppress(BaseException):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def wait(pid: int, seconds: float = LIMIT_S) -> int | None:
    """The status of a process that ended within some time."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        done, code = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(code)
        time.sleep(0.005)
    return None


def finish(words: list[str], folder: Path, prepare: Callable[[], None] = lambda: None) -> None:
    """Run a command to its end; it must succeed."""
    pid = start(words, folder, prepare)
    status = wait(pid)
    if status != 0:
        if status is None:
            os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        text = (folder.parent / ".err").read_text(errors="replace")
        raise RuntimeError(f"{' '.join(words)}: {status} {text[-500:]}")


def at_file(number: int, signal_: int, after: bool) -> Callable[[], None]:
    """Let a process send itself a signal when it puts its nth file in place."""

    def prepare() -> None:
        replace, count = os.replace, 0

        def counting(*args: Any, **kwargs: Any) -> None:
            nonlocal count
            count += 1
            if count == number and not after:
                os.kill(os.getpid(), signal_)
            replace(*args, **kwargs)
            if count == number and after:
                os.kill(os.getpid(), signal_)

        os.replace = counting

    return prepare


def counting_files(into: Path) -> Callable[[], None]:
    """Let a process write how many files it puts in place."""

    def prepare() -> None:
        replace = os.replace

        def counting(*args: Any, **kwargs: Any) -> None:
            replace(*args, **kwargs)
            with into.open("a") as file:
                file.write("x")

        os.replace = counting

    return prepare


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
        content["exported"] = sorted(path.name for path in (run / "exported").iterdir())
        content["iterations"] = {path.name: torch.load(path)["iter"] for path in sorted(run.glob("model_*.pt"))}
    return content


def first_difference(one: Any, other: Any, where: str = "") -> str | None:
    """Where two contents differ first."""
    if isinstance(one, dict) and isinstance(other, dict) and set(one) == set(other):
        found = (first_difference(one[key], other[key], f"{where}/{key}") for key in one)
        return next((each for each in found if each), None)
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        found = (first_difference(a, b, f"{where}[{i}]") for i, (a, b) in enumerate(zip(one, other, strict=True)))
        return next((each for each in found if each), None)
    return None if one == other else f"{where}: {str(one)[:80]} and then {str(other)[:80]}"


def weights(run: Path) -> dict[str, str]:
    """The bytes that each checkpoint's tensors are, as a number that tells them apart."""
    found = {}
    for path in sorted(run.glob("model_*.pt")):
        content = torch.load(path)
        tensors = [*content["actor_state_dict"].values(), *content["critic_state_dict"].values()]
        found[path.name] = str(hash(b"".join(tensor.numpy().tobytes() for tensor in tensors)))
    return found


def _without_times(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _without_times(value) for key, value in content.items() if key not in TIMES}
    return [_without_times(value) for value in content] if isinstance(content, list) else content


def prepare_start(folder: Path) -> None:
    """A recording and a run of it."""
    words = ["data_collection", *BENCH, "--duration", "4", "--max_frequency", "3", "--noise", "1e-4", "--no_plot"]
    finish([*words, "--output", "r.npz"], folder)
    finish([*COMMANDS["fit"][:-1], "first"], folder)
    shutil.move(next(path.parent for path in folder.glob("first/*/*/settings.json")), folder / "base")
    shutil.rmtree(folder / "first")


def alone(command: str, start_folder: Path, scratch: Path) -> dict[str, Any]:
    """What a command that nobody disturbs does: its outcome, its time [s], how many files it puts in place."""
    folder, count = scratch / "trial", scratch / "count"  # results say in which folder they were made
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(start_folder, folder)
    count.write_text("")
    begin = time.monotonic()
    finish(COMMANDS[command], folder, counting_files(count))
    seconds = time.monotonic() - begin
    run = made(folder)[0] if command in ("fit", "train") else folder / "base"
    found = {"outcome": outcome(command, run), "seconds": seconds, "files": len(count.read_text())}
    found["weights"] = weights(run)
    shutil.rmtree(folder)
    return found


def disturb(
    command: str, number: int, expected: dict[str, Any], rng: random.Random, start_folder: Path, scratch: Path
) -> dict[str, Any]:
    """Interrupt a command, go on, and say what came of it."""
    folder = scratch / "trial"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(start_folder, folder)
    signal_ = SIGNALS[number // 2 % len(SIGNALS)]
    if number % 2:
        file, after = rng.randint(1, expected["files"]), rng.random() < 0.5
        pid = start(COMMANDS[command], folder, at_file(file, signal_, after))
        instant = f"{'after' if after else 'before'} file {file} of {expected['files']}"
    else:
        seconds = rng.uniform(0.0, 1.0) * expected["seconds"]
        pid = start(COMMANDS[command], folder)
        instant = f"after {seconds:.2f} s of {expected['seconds']:.2f} s"
    status = wait(pid, LIMIT_S if number % 2 else seconds)
    if status is None:
        os.kill(pid, signal_)
        status = wait(pid, 60)
    trial = {"signal": signal_.name, "instant": instant, "status": status, "hangs": status is None}
    time.sleep(0.5)
    trial["orphans"] = _living(pid)
    runs = made(folder)
    before = weights(runs[0]) if command == "train" and runs else {}
    ready = bool(runs) and (command != "train" or bool(before)) and command in ("fit", "train")
    if command == "fit" and ready and not (runs[0] / "checkpoint.npz").exists():
        ready = False  # it had not begun: nothing is there to go on with
    if command == "train" and set(before) == set(expected["weights"]):
        ready = False  # it had learned all: there is nothing to go on with
    if not ready:
        shutil.rmtree(folder / "runs", ignore_errors=True)
    finish([command, "--resume", str(runs[0])] if ready else COMMANDS[command], folder)
    run = made(folder)[0] if command in ("fit", "train") else folder / "base"
    difference = first_difference(expected["outcome"], outcome(command, run))
    same = difference is None
    if command == "train":
        left_alone = expected["weights"]
        same &= all(before[name] == left_alone[name] for name in before) and (ready or weights(run) == left_alone)
    left = [str(path.relative_to(folder)) for path in folder.rglob(".*")]
    return trial | {"went_on": ready, "equal": same, "difference": difference, "left": left}


def _living(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    os.killpg(group, signal.SIGKILL)
    return True


def main() -> int:
    """Run the trials, print the table; 1 if one came out otherwise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=50, help="of all commands together")
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="a line of JSON for each trial; those there are not run again")
    args = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    for name in NEEDED:
        import_module(f"pace_optim.commands.{name}")
    for name in ("pace_optim.identification.fit", "pace_optim.diagnosis", "pace_envs.rl.training"):
        import_module(name)
    lines = args.output.read_text().splitlines() if args.output and args.output.exists() else []
    done = {(trial["command"], trial["number"]): trial for trial in map(json.loads, lines)}
    with tempfile.TemporaryDirectory() as place:
        start_folder = Path(place) / "start"
        start_folder.mkdir()
        prepare_start(start_folder)
        for position, command in enumerate(args.commands):
            numbers = range((args.trials - position + len(args.commands) - 1) // len(args.commands))
            if all((command, number) in done for number in numbers):
                continue
            expected = alone(command, start_folder, Path(place))
            for number in numbers:
                if (command, number) in done:
                    continue
                rng = random.Random(f"{args.seed}/{command}/{number}")
                try:
                    found = disturb(command, number, expected, rng, start_folder, Path(place))
                except RuntimeError as error:
                    found = {"failed": str(error)}
                done[command, number] = trial = {"command": command, "number": number, **found}
                if args.output:
                    with args.output.open("a") as file:
                        file.write(json.dumps(trial) + "\n")
                if not _good(trial):
                    print(json.dumps(trial), flush=True)
    print("| command | trials | went on | equal | hangs | files left | processes left |\n|" + "---|" * 7)
    for command in args.commands:
        own = [trial for (name, _), trial in done.items() if name == command]
        keys = ("went_on", "equal", "hangs", "left", "orphans")
        counts = (len(own), *(sum(bool(t.get(key)) for t in own) for key in keys))
        print(f"| {command} | " + " | ".join(map(str, counts)) + " |")
    return int(not all(map(_good, done.values())))


def _good(trial: dict[str, Any]) -> bool:
    return bool(trial.get("equal")) and not (trial["left"] or trial["hangs"] or trial["orphans"])


if __name__ == "__main__":
    sys.exit(main())
