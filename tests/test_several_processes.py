"""Several processes that share a fit, by gloo on the processor."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from pace_optim.problem.processes import Processes

ROOT = Path(__file__).parents[1]
FIT = ("--task", "Pace-TestBench-v0", "--optimizer", "cmaes", "--num_envs", "9")


def test_shares_are_disjoint_and_complete_whatever_their_number():
    for count in (1, 2, 3, 7):
        for size in (7, 12, 48):
            rows = [i for rank in range(count) for i in range(size)[Processes(rank, count).share(size)]]
            assert rows == list(range(size))


def test_one_process_alone_keeps_its_scores():
    scores = torch.rand(6, 3)
    assert Processes().gather(scores, 6) is scores
    assert Processes().agree("x") == "x"


def _start(script: str, count: int, log_dir: Path, *options: str) -> list[subprocess.Popen[str]]:
    """One process per rank, as torchrun would start them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    common = {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / "scripts" / script), *options, "--log_dir", str(log_dir)]
    return [
        subprocess.Popen(
            command,
            env={**os.environ, **common, "PYTHONPATH": paths, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=log_dir.parent,
        )
        for rank in range(count)
    ]


def _run_of(text: str) -> Path:
    return Path(text.strip().splitlines()[-1].removeprefix("run: "))


def _parameters(run: Path) -> dict:
    return json.loads((run / "result.json").read_text())["parameters"]


@pytest.mark.slow
def test_two_processes_find_what_one_finds_and_a_lost_one_ends_both(tmp_path):
    """Exactly: each candidate is simulated by one process. The end of the run is that of one process alone."""
    logs = tmp_path / "logs"
    one = _start("fit.py", 1, logs, *FIT, "--max_iteration", "4")[0]
    two = _start("fit.py", 2, tmp_path / "two", *FIT, "--max_iteration", "4")
    alone, first, second = (process.communicate(timeout=120)[0] for process in (one, *two))
    assert [p.returncode for p in (one, *two)] == [0, 0, 0], alone + first + second
    assert "run: " not in second
    assert len(list((tmp_path / "two" / "test_bench").iterdir())) == 1
    assert _parameters(_run_of(first)) == _parameters(_run_of(alone))

    lost = _start("fit.py", 2, tmp_path / "lost", *FIT, "--max_iteration", "200", "--epsilon", "1e-12")
    try:
        deadline = time.monotonic() + 90
        while not list((tmp_path / "lost").glob("*/*/mean_010.pt")) and time.monotonic() < deadline:
            time.sleep(0.2)
        lost[1].send_signal(signal.SIGKILL)
        text = lost[0].communicate(timeout=60)[0]
    finally:
        for process in lost:
            process.kill()
    assert lost[0].returncode == 2, text
    line = text.strip().splitlines()[-1]
    assert "error: A process that shares this job was lost" in line and "--resume" in line
    run = next((tmp_path / "lost" / "test_bench").iterdir())
    resumed = _start("fit.py", 1, tmp_path / "lost", "--resume", str(run), "--max_iteration", "12")[0]
    assert resumed.wait(timeout=90) == 0
    assert (run / "result.json").is_file()
