"""Bad input of every kind to every command line: a seeded generator, and what must hold after each trial.

    python tests/support/bad_input.py --trials 2000 --seed 0          # from the root of the checkout
    PACE_ROOT=../other PYTHONPATH=../other python tests/support/bad_input.py --trials 200  # another checkout

A trial damages one file that a command reads, or one of its options, and runs the command in a forked process of its
own. It passes if the command ends within the time, with status 0 or with status 2 and one line `error: …`; if nothing
was executed that the input names; if no line of its output and no statement of the Python that it wrote is the input's;
and, with status 2, if not a byte of the folder has changed.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import bad_input_mutations as mutations
import bad_input_world as world_of

LIMIT_S = 60
"""Longest time of a trial on the processor, and of a wait in which it does nothing."""
MEMORY = 6 << 30
"""Most memory that a trial may ask for beyond what it starts with [bytes]."""
LONG = ("diagnose", "refit")
"""Options without a value that ask for minutes of work and nothing wrong."""
WORK = ("max_iterations",)
"""Options whose number is how long a training goes on: a large one is no fault, and no hang."""
FAULTS = ("hang", "crash", "traceback", "execution", "forged", "half-written", "message", "unnamed")


@dataclass(kw_only=True)
class Trial:
    """What was tried, and what came of it."""

    number: int
    command: str
    kind: str
    """``option``, or the suffix of the damaged file."""
    target: str
    what: str
    status: int = 0
    seconds: float = 0.0
    message: str = ""
    fault: str = ""
    """One of ``FAULTS``, or nothing."""


def options_of(command: str) -> list[Any]:
    """The actions of a command's parser, as argparse has them."""
    found: list[Any] = []

    def steal(parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        found.extend(parser._actions)
        raise SystemExit(0)

    original = argparse.ArgumentParser.parse_args
    argparse.ArgumentParser.parse_args = steal  # type: ignore[assignment,method-assign]
    try:
        world_of.run(world_of.COMMANDS[command][0])
    finally:
        argparse.ArgumentParser.parse_args = original  # type: ignore[method-assign]
    return [action for action in found if action.dest != "help"]


def plan(number: int, rng: random.Random) -> tuple[str, str | None]:
    """A command, and the file of it to damage; ``None`` for an option."""
    command = rng.choice(list(world_of.COMMANDS))
    files = world_of.COMMANDS[command][2]
    if command == "compare" and "diagnose" not in world_of.COMMANDS:
        files = [name for name in files if "diagnosis" not in name]
    return command, rng.choice(files) if files and rng.random() < 0.7 else None


def bad_words(command: str, rng: random.Random) -> tuple[list[str], str]:
    """A command line with one thing wrong."""
    words = list(world_of.COMMANDS[command][1])
    action = rng.choice([action for action in options_of(command) if action.dest not in LONG] or [None])
    word = rng.choice(mutations.WRONG_WORDS)
    if action is not None and action.dest in WORK and word.isdecimal() and int(word):
        word = "0"
    if action is None:
        return [*words, word], f"a word {word!r:.40}"
    if not action.option_strings:
        at = next((i for i, w in enumerate(words) if "/" in w), 0)
        return [*words[:at], word, *words[at + 1 :]], f"{action.dest} {word!r:.40}"
    option = action.option_strings[0]
    if option in words and action.nargs != 0:
        at = words.index(option)
        words[at + 1] = word
        return words, f"{option} {word!r:.40}"
    values = [] if action.nargs == 0 else [word] * (action.nargs if isinstance(action.nargs, int) else 1)
    return [*words, option, *values], f"{option} {word!r:.40}"


def attempt(number: int, seed: int, world: Path, scratch: Path) -> Trial:
    """Run one trial in a process of its own."""
    rng = random.Random(f"{seed}/{number}")
    marker = world.parent / "executed"
    copy, state = scratch / "copy", scratch / "state"
    world_of.restore(world, copy)
    world_of.restore(world.parent / world_of.STATE, state)  # what a trial names is trusted in that trial alone
    os.environ["XDG_STATE_HOME"] = str(state)
    command, target = plan(number, rng)
    environment = dict(os.environ)
    script, words, _ = world_of.COMMANDS[command]
    words = list(words)
    if target is None:
        (copy / "loop").symlink_to("loop")
        os.mkfifo(copy / "pipe.npz")
        words, what = bad_words(command, rng)
        trial = Trial(number=number, command=command, kind="option", target="", what=what)
    else:
        what = mutations.mutate_file(copy / target, rng, marker)
        trial = Trial(number=number, command=command, kind=Path(target).suffix, target=target, what=what)
        if what.startswith(mutations.FORGED) and rng.random() < 0.5:  # its own store lies in the present folder
            for name in ("HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME"):
                os.environ.pop(name, None)
    marker.unlink(missing_ok=True)
    before = world_of.snapshot(copy)
    begin = time.monotonic()
    out, err = scratch / "out", scratch / "err"
    pid = os.fork()
    if pid == 0:
        _child(script, words, copy, out, err)
    trial.status = _wait(pid)
    os.environ.update(environment)
    trial.seconds = round(time.monotonic() - begin, 2)
    text = err.read_bytes().decode(errors="surrogateescape") if err.exists() else ""
    trial.message = text[-400:]
    if target is None and any("trap" in word for word in words):
        marker.unlink(missing_ok=True)  # the command line names it: it may run
    after = world_of.snapshot(copy)
    told = [name for name in after if name not in before and name in text]  # as the map that was guessed of a log
    unchanged = {n: v for n, v in after.items() if n not in told} == before
    trial.fault = _judge(trial, text, out, marker, unchanged)
    new = [copy / name for name in after if name not in before and name.endswith(".py")]
    if not trial.fault and ((copy / "forged").exists() or any(_holds_code(path) for path in new)):
        trial.fault = "execution"
    return trial


def _holds_code(path: Path) -> bool:
    """Whether a page that was written calls what the input names, or is no Python."""
    try:
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    except (SyntaxError, ValueError):
        return True
    return any(ast.unparse(call.func) == "open" for call in calls)


def _child(script: str, words: list[str], folder: Path, out: Path, err: Path) -> None:
    """The forked process: it never returns."""
    status = 99
    try:
        os.setsid()
        os.chdir(folder)
        sys.path.append(str(folder))
        for number, path in ((1, out), (2, err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))
        sys.stdin = io.StringIO()
        if "PACE_ROOT" in os.environ:  # a checkout whose runs do not know the module of their task
            import_module("arm")
        status = world_of.run(script, *words)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def _wait(pid: int) -> int:
    """The trial's status; 1000 if it had to be killed: for as long as it gets on, it may take its time."""
    used, until = -1.0, time.monotonic() + LIMIT_S
    while True:
        done, code = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(code)
        if time.monotonic() > until:
            now = _processor_time(pid)
            if now < used + 0.5:
                break
            used, until = now, time.monotonic() + LIMIT_S
        time.sleep(0.005)
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return 1000


def _processor_time(group: int) -> float:
    """Of a trial and the processes that it started [s]."""
    total = 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, ValueError):
            words = stat.read_text().rpartition(")")[2].split()
            if int(words[2]) == group:
                total += sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK")
    return total


def _judge(trial: Trial, err: str, out: Path, marker: Path, unchanged: bool) -> str:
    if marker.exists():
        return "execution"
    if trial.status in (1000, -signal.SIGKILL, -signal.SIGXCPU):
        return "hang"
    if "Traceback" in err:
        return "traceback"
    said = out.read_bytes().decode(errors="surrogateescape") if out.exists() else ""
    if re.search(r"^(run|warning|error): forged", f"{said}\n{err}", re.MULTILINE):
        return "forged"
    if trial.status not in (0, 2):
        return "crash"
    if trial.status == 0:
        return ""
    if not unchanged:
        return "half-written"
    last = err.rstrip("\n").splitlines()[-1:] or [""]
    if not last[0].startswith("error: ") or len(last[0]) > 1500 or any(not c.isprintable() for c in last[0]):
        return "message"
    if "this is a fault of the program" in err or len(re.findall("^error: ", err, re.MULTILINE)) > 1:
        return "message"
    known = Path(trial.target).name in err or Path(trial.target).stem in err
    if trial.target and not known and "that was never named" not in err:  # a task's code, where HOME is not set
        return "unnamed"
    return ""


def run_trials(numbers: range, seed: int, world: Path) -> list[Trial]:
    """Run trials one after another, in a scratch folder of their own."""
    with tempfile.TemporaryDirectory() as scratch:
        return [attempt(number, seed, world, Path(scratch)) for number in numbers]


def table(trials: list[Trial]) -> str:
    """How many were tried and failed, by what was damaged."""
    kinds = sorted({t.kind for t in trials})
    lines = ["| damaged | tried | " + " | ".join(FAULTS) + " |", "|" + "---|" * (len(FAULTS) + 2)]
    for kind in [*kinds, "all"]:
        own = [t for t in trials if kind in (t.kind, "all")]
        count = Counter(t.fault for t in own)
        lines.append(f"| {kind} | {len(own)} | " + " | ".join(str(count[f]) for f in FAULTS) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first trial: one trial alone, again")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--world", type=Path, help="keep the files that are damaged here (default: made anew)")
    parser.add_argument("--quick", action="store_true", help="leave out diagnosis and training")
    parser.add_argument("--output", type=Path, help="a line of JSON for each trial; goes on with it")
    args = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as scratch:
        world = args.world or Path(scratch) / "world"
        if not world.exists():
            pid = os.fork()
            if pid == 0:  # the modules that it imports are not those of the trials
                os.environ["XDG_STATE_HOME"] = str(world.parent / world_of.STATE)
                world_of.build(world, quick=args.quick)
                os._exit(0)
            if os.waitpid(pid, 0)[1]:
                shutil.rmtree(world, ignore_errors=True)
                return 1
        if args.quick:
            slow = [name for name in world_of.COMMANDS if name.split()[0] in world_of.SLOW]
            for name in slow:
                del world_of.COMMANDS[name]
        _import_all()
        trials = _finished(args.output, range(args.first, args.first + args.trials))
        for number in sorted(set(range(args.first, args.first + args.trials)) - {t.number for t in trials}):
            trials += run_trials(range(number, number + 1), args.seed, world)
            if trials[-1].fault:
                print(json.dumps(asdict(trials[-1])), flush=True)
            if args.output:
                with args.output.open("a") as file:
                    file.write(json.dumps(asdict(trials[-1])) + "\n")
    print(table(trials))
    return int(any(t.fault for t in trials))


def _finished(output: Path | None, numbers: range) -> list[Trial]:
    """The trials of an earlier call that was broken off, from its lines."""
    if output is None or not output.exists():
        return []
    trials = [Trial(**json.loads(line)) for line in output.read_text().splitlines()]
    return [trial for trial in trials if trial.number in numbers]


def _import_all() -> None:
    """What every command imports, once and before the forks."""
    for command in world_of.COMMANDS:
        options_of(command)


if __name__ == "__main__":
    sys.exit(main())
