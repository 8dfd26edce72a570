"""Several processes that share a search, by gloo on the processor."""

from __future__ import annotations

import ast
import json
import os
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from places import ROOT, SUPPORT
from problems import ANYMAL, BENCH, TRUTH, chirp, env_cfg, legs_chirp, record
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


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> str:
    """A recording's file."""
    return str(
        save_recording(tmp_path_factory.mktemp("data") / "bench.npz", record(chirp(0.5), name="bench", noise=1e-4))
    )


@pytest.fixture
def start(warm):
    """Starts one process per rank, as torchrun would."""

    def start(count: int, *command: str, **environ: str) -> list[subprocess.Popen[str]]:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        common = {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        return [
            warm.start(
                *command,
                env={**os.environ, **common, **environ, "RANK": str(rank), "LOCAL_RANK": str(rank)},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
            )
            for rank in range(count)
        ]

    return start


def _texts(processes: list[subprocess.Popen[str]]) -> list[str]:
    """What each has printed; all of them have ended well."""
    texts = [process.communicate(timeout=200)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), texts
    return texts


@pytest.mark.slow
def test_two_processes_score_what_one_scores(start, bench):
    """Exactly: each candidate is simulated by one process."""
    processes = start(2, SEARCH, BENCH, bench)
    alone = searched(BENCH, bench, Processes())
    first, second = (ast.literal_eval(text.strip().splitlines()[-1]) for text in _texts(processes))
    assert alone == first == second


@pytest.mark.slow
def test_processes_that_share_four_strategies_search_as_one_does_with_all(start, tmp_path):
    """Each does the arithmetic of its own legs' strategies; of four, three processes have two, one and one."""
    cfg = env_cfg(ANYMAL)
    legs = str(save_recording(tmp_path / "legs.npz", record(legs_chirp(cfg, 0.3), {**TRUTH, "delay": 2.0}, cfg=cfg)))
    processes = start(3, SEARCH, ANYMAL, legs)
    alone = searched(ANYMAL, legs, Processes())
    shared = [ast.literal_eval(text.strip().splitlines()[-1]) for text in _texts(processes)]
    assert len(alone[0][0][0]) == 4 and shared == [alone] * 3


@pytest.mark.slow
def test_a_lost_process_ends_the_others_with_one_line(start, bench):
    stays, lost = start(2, SEARCH, BENCH, bench, LOSE="1")
    text = stays.communicate(timeout=200)[0]
    lost.communicate(timeout=200)
    assert stays.returncode == 2, text
    line = text.strip().splitlines()[-1]
    assert line.startswith("error: A process that shares this job was lost") and "--resume" in line


@pytest.mark.slow
def test_a_shared_fit_that_is_resumed_ends_as_one_that_was_not_shared(start, bench, tmp_path):
    common = {"task": BENCH, "data": [bench], "num_envs": 9, "optimizer": "cmaes"}
    alone, _ = fit(FitSettings(**common, max_iteration=4, log_dir=str(tmp_path / "alone")))
    options = ["--task", BENCH, "--data", bench, "--num_envs", "9", "--optimizer", "cmaes"]
    writer, other = _texts(start(2, FIT, *options, "--max_iteration", "2", "--log_dir", str(tmp_path / "shared")))
    run = writer.strip().splitlines()[-1].removeprefix("run: ")
    assert "run:" not in other and [str(p) for p in (tmp_path / "shared").glob("*/*")] == [run]
    _texts(start(2, FIT, "--resume", run, "--max_iteration", "4"))
    result = json.loads((Path(run) / "result.json").read_text())
    assert result["generations"] == 4 and result["parameters"] == alone.parameters


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", ["hybrid", "least_squares"])
def test_a_shared_fit_with_descents_ends_as_one_that_was_not_shared(optimizer, start, tmp_path):
    """The helper searched for 200 generations, the other for as many as the descents leave: both waited."""
    made = record(chirp(0.5))
    data = save_recording(tmp_path / "wrong.npz", replace(made, dof_pos=np.roll(made.dof_pos, 5, axis=0)))
    common = {"task": BENCH, "data": [str(data)], "num_envs": 12}
    alone, _ = fit(FitSettings(**common, optimizer=optimizer, log_dir=str(tmp_path / "alone")))
    options = ["--task", BENCH, "--data", str(data), "--num_envs", "12", "--optimizer", optimizer]
    _texts(start(2, FIT, *options, "--log_dir", str(tmp_path / "shared")))
    (run,) = (tmp_path / "shared").glob("*/*")
    result = json.loads((run / "result.json").read_text())
    assert result["parameters"] == alone.parameters and result["generations"] == alone.generations
    assert (alone.generations > 0) == (optimizer == "hybrid")


@pytest.mark.slow
def test_a_training_is_shared_ends_with_a_lost_process_and_goes_on(start, tmp_path):
    stays, lost = start(2, TRAINING, "train", str(tmp_path), LOSE="1")
    text = stays.communicate(timeout=200)[0]
    lost.communicate(timeout=200)
    line = text.strip().splitlines()[-1]
    assert stays.returncode == 2 and line.startswith("error: A process that shares this job was lost"), text
    (run,) = tmp_path.glob("*/*")
    texts = [text.strip().splitlines() for text in _texts(start(2, TRAINING, "resume", str(run)))]
    assert [lines[-1] for lines in texts] == [f"run: {run}", "run: None"]
    assert len({lines[-2] for lines in texts}) == 1  # both have the same policy
    assert {p.name for p in run.glob("model_*.pt")} == {"model_0.pt", "model_1.pt"}
