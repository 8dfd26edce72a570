"""Off a terminal, progress is never silent for long, and no flood."""

import importlib
import io
import sys
import time
import warnings
from types import SimpleNamespace

import pytest

from pace_optim.terminal.cli import run_cli
from pace_optim.terminal.progress import ProgressLine

BETWEEN = 0.15
"""Seconds between times here; ten elsewhere."""


def test_off_a_terminal_a_step_has_a_line_at_once_and_then_times():
    stream = io.StringIO()
    progress = ProgressLine(stream, BETWEEN)
    progress.say("fitting")
    assert stream.getvalue() == "fitting  0 s"
    time.sleep(4.5 * BETWEEN)
    for done in range(1000):  # a counter is no reason for a line each
        progress.show("search", done, 2000, "error 1 mrad", None, 10)
    progress.close()
    lines = stream.getvalue().splitlines()
    fitting = [line for line in lines if line.startswith("fitting")]
    assert 4 <= sum(line.count(" s") for line in fitting) <= 5
    assert len(fitting) == 1  # nothing is printed twice
    assert sum(line.startswith("search: ") for line in lines) <= 2


def test_a_long_step_goes_on_below_itself_and_a_counter_anew():
    stream = io.StringIO()
    progress = ProgressLine(stream, 0.0)
    for _ in range(10):
        progress.say("fitting")
    for done in range(5):
        progress.show("search", done, 9, "error 1 mrad", None, 10)
    progress.close()
    first, more, *counted = stream.getvalue().splitlines()
    assert first.startswith("fitting") and first.count(" s") == 8 and more == "      0 s  0 s"
    assert [line.split("/")[0] for line in counted] == ["search: 0", "search: 3"]


SHARES = {"reading": 0.05, "fit on pieces": 0.2, r"fitting .* alone": 0.9, "fit on whole": 0.6}


@pytest.mark.parametrize(
    ("seconds", "half"),
    [
        ({"reading": 10, "fit on pieces": 40, "fit on whole": 30, "fitting log alone": 20}, "fit on whole"),
        ({"reading": 10, "fit on pieces": 90, "fit on whole": 20, "fitting log alone": 10}, "fit on pieces"),
        ({"reading": 30, "fit on pieces": 10, "fit on whole": 50, "fitting log alone": 40}, "fit on whole"),
        ({"reading": 5, "fit on whole": 60, "fitting log alone": 30}, "fit on whole"),
    ],
)
def test_half_way_the_time_left_is_within_a_factor_of_three(monkeypatch, seconds, half):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    progress = ProgressLine(io.StringIO(), 1e9)
    progress.expect(SHARES)
    total = sum(seconds.values())
    for step, duration in seconds.items():
        progress.say(step)
        for _ in range(duration):
            if now[0] >= total / 2:
                assert step == half and total / 6 <= progress.left <= 1.5 * total
                return
            now[0] += 1.0


def test_the_time_left_is_stated_with_the_step_that_began(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    stream = io.StringIO()
    progress = ProgressLine(stream, 60.0)
    progress.say("fit on pieces")  # nothing is expected yet
    progress.expect(SHARES)
    for now[0], step in ((60.0, "fit on whole"), (540.0, "fitting log alone")):
        progress.say(step)
    progress.close()
    assert stream.getvalue().splitlines() == [
        "fit on pieces  0 s",
        "fit on whole  60 s, about 40 s left",
        "fitting log alone  540 s, about 60 s left",
    ]


def test_a_line_of_a_file_is_ended_before_another_step_or_a_message():
    stream = io.StringIO()
    progress = ProgressLine(stream, 60.0)
    progress.say("fitting")
    progress.say("fitting")
    progress.say("checking")
    progress.tell("note: done")
    progress.say("writing")
    progress.close()
    assert stream.getvalue() == "fitting  0 s  0 s\nchecking  0 s\nnote: done\nwriting  0 s\n"


def test_an_error_begins_a_line_of_its_own(capsys):
    def main():
        ProgressLine(sys.stderr, 60.0).say("reading")
        sys.stderr.write(warnings.formatwarning("soon", UserWarning, "this.py", 1))  # as pytest catches them
        raise ValueError("It is gone.")

    assert run_cli(main) == 2
    assert capsys.readouterr().err == "reading  0 s\nwarning: soon\nerror: It is gone.\n"


class DoneError(Exception):
    """Enough of the command has run."""


@pytest.mark.parametrize(
    ("verb", "work", "words"),
    [
        ("compare", "compare", ["run"]),
        ("data_collection", "collect", ["--task", "Pace-TestBench-v0"]),
        ("demo", "record", []),
    ],
)
def test_a_command_that_simulates_shows_it(monkeypatch, tmp_path, verb, work, words):
    stream, module = io.StringIO(), importlib.import_module(f"pace_optim.commands.{verb}")

    def slow(*_):
        time.sleep(2.5 * BETWEEN)
        raise DoneError

    monkeypatch.setattr(module, work, slow)
    monkeypatch.setattr(module, "ProgressLine", lambda: ProgressLine(stream, BETWEEN))
    monkeypatch.setattr(sys, "argv", [f"pace {verb}", *words])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DoneError):
        module.main()
    assert stream.getvalue().startswith("simulating the recordings")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--replay", "run"], ["replaying the recordings"]),
        (["--checkpoint", "model_0.pt", "--num_envs", "16"], ["playing 16 robots for 20 s"]),
        (["--checkpoint", "model_0.pt", "--viewer"], []),
    ],
)
def test_play_is_not_silent_unless_a_window_shows_it(monkeypatch, options, said):
    """With the fine steps of a model file's fit, 256 robots took four minutes without a line."""
    monkeypatch.setenv("DISPLAY", ":0")
    command, shown = importlib.import_module("pace_optim.commands.play"), []
    monkeypatch.setattr(command.ProgressLine, "wait_for", lambda self, text: shown.append(text))
    replay = "pace_optim.run.training_replay.replay_in_training"
    monkeypatch.setattr(replay, lambda run, cfg: SimpleNamespace(table=[]))
    monkeypatch.setattr(command, "play", lambda settings: None)
    monkeypatch.setattr(sys, "argv", ["play", *options])
    command.main()
    assert shown == said
