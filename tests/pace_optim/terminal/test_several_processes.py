"""Several processes that share a search, by gloo on the processor."""

from __future__ import annotations

import ast
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from places import ROOT, SUPPORT
from problems import ANYMAL, BENCH, record
from sharing import searched

from pace_optim.identification.fit import fit
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.processes import Processes

FIT = str(ROOT / "scripts" / "fit.py")
SEARCH, TRAINING = (str(SUPPORT / name) for name in ("sharing.py", "sharing_training.py"))


def test_shares_are_disjoint_and_complete_whatever_their_number():
    for count in (1, 2, 3, 7):
        for size in (7, 12, 48):
            rows = [i for rank in range(count) for i in range(size)[Processes(rank, count).share(size)]]
            assert rows == list(range(size))


def test_one_process_alone_keeps_its_scores():
    scores = torch.rand(6, 3)
    assert Processes().gather(scores, 6) is scores
    assert Processes().agree("x") == "x"


def test_pieces_of_work_go_round_the_processes():
    owners = [[Processes(rank, 3).owns(number) for rank in range(3)].index(True) for number in range(7)]
    assert owners == [0, 1, 2, 0, 1, 2, 0] and Processes().exchange(["a", "b"]) == ["a", "b"]


def _start(count: int, *command: str, **environ: str) -> list[subprocess.Popen[str]]:
    """One process per rank, as torchrun would start them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    common = {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "PYTHONPATH": paths}
    return [
        subprocess.Popen(
            [sys.executable, *command],
            env={**os.environ, **common, **environ, "OMP_NUM_THREADS": "1", "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(count)
    ]


def _texts(processes: list[subprocess.Popen[str]]) -> list[str]:
    """What each has printed; all of them have ended well."""
    texts = [process.communicate(timeout=200)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), texts
    return texts


@pytest.mark.slow
def test_two_processes_score_what_one_scores():
    """Exactly: each candidate is simulated by one process."""
    processes = _start(2, SEARCH)
    alone = searched(BENCH, Processes())
    first, second = (ast.literal_eval(text.strip().splitlines()[-1]) for text in _texts(processes))
    assert alone == first == second


@pytest.mark.slow
def test_processes_that_share_four_strategies_search_as_one_does_with_all():
    """Each does the arithmetic of its own legs' strategies; of four, three processes have two, one and one."""
    processes = _start(3, SEARCH, ANYMAL)
    alone = searched(ANYMAL, Processes())
    shared = [ast.literal_eval(text.strip().splitlines()[-1]) for text in _texts(processes)]
    assert len(alone[0][0][0]) == 4 and shared == [alone] * 3


@pytest.mark.slow
def test_a_lost_process_ends_the_others_with_one_line():
    stays, lost = _start(2, SEARCH, LOSE="1")
    text = stays.communicate(timeout=200)[0]
    lost.communicate(timeout=200)
    assert stays.returncode == 2, text
    line = text.strip().splitlines()[-1]
    assert line.startswith("error: A process that shares this job was lost") and "--resume" in line


@pytest.mark.slow
def test_a_shared_fit_that_is_resumed_ends_as_one_that_nobody_shared(tmp_path):
    save_recording(tmp_path / "bench.npz", record(name="bench", noise=1e-4))
    common = {"task": BENCH, "data": [str(tmp_path / "bench.npz")], "num_envs": 9, "optimizer": "cmaes"}
    alone, _ = fit(FitSettings(**common, max_iteration=4, log_dir=str(tmp_path / "alone")))
    options = ["--task", BENCH, "--data", common["data"][0], "--num_envs", "9", "--optimizer", "cmaes"]
    writer, other = _texts(_start(2, FIT, *options, "--max_iteration", "2", "--log_dir", str(tmp_path / "shared")))
    run = writer.strip().splitlines()[-1].removeprefix("run: ")
    assert "run:" not in other and [str(p) for p in (tmp_path / "shared").glob("*/*")] == [run]
    _texts(_start(2, FIT, "--resume", run, "--max_iteration", "4"))
    result = json.loads((Path(run) / "result.json").read_text())
    assert result["generations"] == 4 and result["parameters"] == alone.parameters


@pytest.mark.slow
def test_a_training_is_shared_ends_with_a_lost_process_and_goes_on(tmp_path):
    stays, lost = _start(2, TRAINING, "train", str(tmp_path), LOSE="1")
    text = stays.communicate(timeout=200)[0]
    lost.communicate(timeout=200)
    line = text.strip().splitlines()[-1]
    assert stays.returncode == 2 and line.startswith("error: A process that shares this job was lost"), text
    (run,) = tmp_path.glob("*/*")
    texts = [text.strip().splitlines() for text in _texts(_start(2, TRAINING, "resume", str(run)))]
    assert [lines[-1] for lines in texts] == [f"run: {run}", "run: None"]
    assert len({lines[-2] for lines in texts}) == 1  # both have the same policy
    assert {p.name for p in run.glob("model_*.pt")} == {"model_0.pt", "model_1.pt"}
