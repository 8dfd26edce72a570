"""What a user is told when something goes wrong: one line, in any terminal, with the place where it arose."""

import io
import os
import subprocess
import sys
import textwrap
import warnings
from types import SimpleNamespace

import pytest
from command_lines import run_script
from places import ROOT
from problems import BENCH, record

from pace_actuators import memory
from pace_actuators.delay_buffer import DelayBuffer
from pace_actuators.files import remove_leftovers, write_together
from pace_actuators.memory import available_memory, check_memory
from pace_optim.identification.setup import search_population
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.cli import make_parser, one_line, readable, run_cli, safe_streams
from pace_optim.terminal.progress import ProgressLine


def said(error: BaseException, capsys) -> tuple[int, str]:
    def main():
        raise error

    status = run_cli(main)
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1
    return status, err


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (ValueError("a\x1b[31mb\u202ec\nd\udc80"), 2, "error: a\\x1b[31mb\\u202ec d\\udc80\n"),
        (KeyError("armature"), 2, "error: there is no 'armature'\n"),
        (OSError(28, "No space left on device", "run/result.json"), 2, "run/result.json: No space left on device"),
        (MemoryError(), 2, "not enough memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 2, "not enough memory"),
        (ValueError("x" * 5000), 2, "xxx…xxx"),
    ],
)
def test_an_error_is_one_line_that_steers_no_terminal(error, status, text, capsys):
    found, err = said(error, capsys)
    assert found == status and text in err and len(err) < 400


def test_a_fault_of_the_program_is_told_as_one():
    def main():
        check_memory("many", "", "")  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        err = io.StringIO()
        patch.setattr(sys, "stderr", err)
        assert run_cli(main) == 1
    assert "fault of the program" in err.getvalue() and "TypeError" in err.getvalue()


def test_words_of_names_are_written_out():
    assert readable("good\ttab é×") == "good\ttab é×"
    assert readable("\rname\x07\nrun: x") == "\\rname\\x07\\nrun: x"
    assert one_line("a\n\n b") == "a b"


def test_no_name_begins_a_line_of_its_own(monkeypatch, capsys):
    forged = "elbow\nrun: theirs\r\x85\u2028\x0bwarning: no\n"
    with safe_streams():
        print(f"warning: {forged}")
        print("two", forged, sep="\n")
        print(f"{forged}\n", end="")
        sys.stderr.write(warnings.formatwarning(UserWarning(forged), UserWarning, "this.py", 1))
        progress = ProgressLine()
        progress.say(forged)
        progress.tell(forged, "end")
        parser = make_parser("Does this.", example="scripts/this.py")
        parser.print_help()
    said = capsys.readouterr()
    lines = [line.strip() for line in (said.out + said.err).splitlines()]
    assert len([line for line in lines if "elbow" in line]) == 6
    assert not [line for line in lines if line.startswith(("run:", "warning: no"))]
    assert "example:" in lines and any(line.startswith("usage:") for line in lines)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_live_line_is_overwritten_and_a_name_in_it_overwrites_nothing(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with safe_streams():
        stream = sys.stderr
        progress = ProgressLine()
        progress.say("fitting \r\nrun: theirs")
        progress.tell("kept")
    text = stream.getvalue()
    assert text.startswith("\rfitting \\r\\nrun: theirs ") and text.endswith("\nkept\n") and text.count("\r") == 1


def test_an_ascii_terminal_gets_plain_letters(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    with safe_streams():
        print("4 × 1 mrad² → ű")
        sys.stdout.flush()
    assert raw.getvalue() == b"4 x 1 mrad^2 -> \\u0171\n"


def test_a_closed_stream_swallows_what_it_gets(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    assert run_cli(lambda: print("x", file=sys.stderr)) == 0


OWN = """
import torch
from pace_actuators.effects import Effect, EffectParameter

class Raises(Effect):
    name = "raises_{0}"
    stage = "drive"
    parameters = (EffectParameter(name="a", unit="1", lower=0.0, upper=1.0, null=0.0, start=0.5),)

    def drive(self, s):
        {1}
"""


@pytest.mark.parametrize(
    ("number", "line", "expected"),
    [
        (0, "raise RuntimeError('boom')", r"own_0.py:11, in raises_0.drive: RuntimeError: boom"),
        (1, "s.effort = torch.zeros(3, 7, 5)", r"own_1.py:11, in raises_1.drive: RuntimeError: "),
        (
            2,
            "s.effort = s.effort * float('nan')",
            "not finite within 4 steps from the start with the effect own_2",
        ),
    ],
)
def test_an_effect_of_ones_own_is_named(number, line, expected, tmp_path):
    (tmp_path / f"own_{number}.py").write_text(OWN.format(number, line))
    save_recording(tmp_path / "r.npz", record())
    done = run_script("fit", "--task", BENCH, "--data", "r.npz", "--effects", f"own_{number}:Raises", cwd=tmp_path)
    assert done.returncode == 2 and expected in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "logs").exists()


def test_memory_is_looked_at_before_it_is_asked_for(tmp_path, monkeypatch):
    assert 1e6 < available_memory() < 1e15
    with pytest.raises(ValueError, match=r"would take 1e\+09 GB of memory, and .* GB are free"):
        check_memory(1e18, "It", "")
    with pytest.raises(ValueError, match="max_delay = 1e\\+12 steps in 8 environments would take"):
        DelayBuffer(1e12, 8)
    save_recording(tmp_path / "r.npz", record())
    many = ("--task", BENCH, "--data", "r.npz", "--num_envs", "1000000000", "--optimizer", "cmaes")
    done = run_script("fit", *many, cwd=tmp_path)
    assert done.returncode == 2 and "--num_envs 1000000000 would take" in done.stderr, done.stderr
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("optimizer", "device", "expected"),
    [("cmaes", "cpu", 5 * 10**8), ("hybrid", "cuda:0", 5 * 10**8), ("hybrid", "cpu", 48)],
)
def test_memory_is_asked_for_by_what_a_search_simulates(optimizer, device, expected):
    settings = FitSettings(task=BENCH, optimizer=optimizer, device=device, num_envs=10**9)
    problem = SimpleNamespace(dataset=SimpleNamespace(trained=lambda: ["a", "b"]))
    assert search_population(problem, settings) == expected


def test_the_limit_of_a_container_counts(tmp_path):
    for name, text in (("memory.max", "3000"), ("memory.current", "2500"), ("memory.stat", "inactive_file 100\n")):
        (tmp_path / name).write_text(text)
    assert memory._left_in(tmp_path, "memory.max", "memory.current", "inactive_file") == 600


def test_files_that_belong_together_are_written_all_or_not_at_all(tmp_path):
    (tmp_path / "a").write_text("old")
    (tmp_path / "b").mkdir()
    with pytest.raises(IsADirectoryError):
        write_together({tmp_path / "a": b"new", tmp_path / "b": b"new"})
    assert (tmp_path / "a").read_text() == "old" and sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_temporary_files_of_killed_processes_are_removed(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    left, own = tmp_path / f".x.0.{dead.pid}.tmp", tmp_path / f".x.0.{os.getpid()}.tmp"
    other = tmp_path / ".other.tmp"
    for path in (left, own, other):
        path.write_text("half")
    remove_leftovers(tmp_path)
    assert not left.exists() and own.exists() and other.exists()


def test_a_full_disk_is_told_with_the_files_name(warm, tmp_path):
    code = f"""
        import resource, signal
        from pathlib import Path
        import torch
        from pace_actuators.files import write_json, write_tensors
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
        for write, content, name in ((write_json, [0] * 9000, "a.json"), (write_tensors, torch.zeros(9000), "b.pt")):
            try:
                write(Path({str(tmp_path)!r}) / name, content)
            except OSError as error:
                assert name in str(error), error
            else:
                raise SystemExit("written")
    """
    done = warm.run("-c", textwrap.dedent(code), cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_exists_is_not_replaced_by_a_simulation_unless_asked_to(tmp_path):
    words = ("--task", BENCH, "--duration", "0.5", "--no_plot", "--output", "leg.csv")
    (tmp_path / "leg.json").write_text("measured")
    done = run_script("data_collection", *words, cwd=tmp_path)
    assert done.returncode == 2 and "leg.json exists, and may be yours" in done.stderr, done.stderr
    assert (tmp_path / "leg.json").read_text() == "measured" and not (tmp_path / "leg.csv").exists()
    assert run_script("data_collection", *words, "--overwrite", cwd=tmp_path).returncode == 0
