"""Several processes that share a search, by gloo on the processor."""

from __future__ import annotations

import ast
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pace_optim.problem.processes import Processes

HERE = Path(__file__).parent


def test_shares_are_disjoint_and_complete_whatever_their_number():
    for count in (1, 2, 3, 7):
        for size in (7, 12, 48):
            rows = [i for rank in range(count) for i in range(size)[Processes(rank, count).share(size)]]
            assert rows == list(range(size))


def test_one_process_alone_keeps_its_scores():
    scores = torch.rand(6, 3)
    assert Processes().gather(scores, 6) is scores
    assert Processes().agree("x") == "x"


def _start(count: int, **environ: str) -> list[subprocess.Popen[str]]:
    """One process per rank, as torchrun would start them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    paths = os.pathsep.join(filter(None, [str(HERE.parent), os.environ.get("PYTHONPATH", "")]))
    common = {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "PYTHONPATH": paths}
    return [
        subprocess.Popen(
            [sys.executable, str(HERE / "sharing.py")],
            env={**os.environ, **common, **environ, "OMP_NUM_THREADS": "1", "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(count)
    ]


@pytest.mark.slow
def test_two_processes_score_what_one_scores():
    """Exactly: each candidate is simulated by one process."""
    processes = [*_start(1), *_start(2)]
    texts = [process.communicate(timeout=200)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], texts
    alone, first, second = (ast.literal_eval(text.strip().splitlines()[-1]) for text in texts)
    assert alone == first == second


@pytest.mark.slow
def test_a_lost_process_ends_the_others_with_one_line():
    stays, lost = _start(2, LOSE="1")
    text = stays.communicate(timeout=200)[0]
    lost.communicate(timeout=200)
    assert stays.returncode == 2, text
    line = text.strip().splitlines()[-1]
    assert line.startswith("error: A process that shares this job was lost") and "--resume" in line
