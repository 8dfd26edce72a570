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
    assert len(fitting) == 2  # every third time anew
    assert sum(line.startswith("search: ") for line in lines) <= 2


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
    monkeypatch.setattr(command, "replay_in_training", lambda run, cfg: SimpleNamespace(table=[]))
    monkeypatch.setattr(command, "play", lambda settings: None)
    monkeypatch.setattr(sys, "argv", ["play", *options])
    command.main()
    assert shown == said
