"""Off a terminal, progress is never silent for long, and no flood."""

import importlib
import io
import sys
import time

import pytest

from pace_optim.terminal.progress import ProgressLine

BETWEEN = 0.15
"""Seconds between lines here; ten elsewhere."""


def test_off_a_terminal_a_step_is_printed_at_once_and_then_from_time_to_time():
    stream = io.StringIO()
    progress = ProgressLine(stream, BETWEEN)
    progress.say("fitting")
    assert stream.getvalue() == "fitting  0 s\n"
    time.sleep(3.5 * BETWEEN)
    for done in range(1000):  # a counter is no reason for a line each
        progress.show("search", done, 2000, 1.0, None, 10)
    progress.close()
    lines = stream.getvalue().splitlines()
    assert 3 <= sum(line.startswith("fitting") for line in lines) <= 4
    assert sum(line.startswith("search: ") for line in lines) <= 2


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
