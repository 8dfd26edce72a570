"""scripts/plot_trajectory.py: the newest run by default, files without a display, one line for what is wrong."""

import contextlib
import io
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import pyplot
from places import ROOT
from run_folders import write_run

from pace_actuators.files import write_json, write_tensors
from pace_envs import load_env_cfg
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.run.open import replay
from pace_optim.run.settings import FitSettings

OLD, NEW = "26_01_01_00-00-00", "26_02_01_00-00-00"


SCRIPT = str(ROOT / "scripts" / "plot_trajectory.py")


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"):
        monkeypatch.delenv(name, raising=False)
    yield
    pyplot.close("all")


def plot(*arguments: object, cwd: Path) -> subprocess.CompletedProcess:
    """Run the script in this process, as if from the command line: importing torch anew takes seconds."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as done:
        patch.setattr(sys, "argv", [SCRIPT, *map(str, arguments)])
        patch.chdir(cwd)
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
            runpy.run_path(SCRIPT, run_name="__main__")
    return subprocess.CompletedProcess(arguments, done.value.code or 0, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A folder with two runs of a leg under logs/pace."""
    home = tmp_path_factory.mktemp("home")
    for name in (OLD, NEW):
        write_run(home / "logs" / "pace" / "leg" / name)
    (home / "logs" / "pace" / "leg" / "notes").mkdir()
    return home


def written(done: subprocess.CompletedProcess) -> list[str]:
    assert done.returncode == 0, done.stderr
    return [line.removeprefix("plot: ") for line in done.stdout.splitlines()]


@pytest.mark.slow
def test_it_plots_both_of_the_newest_run_by_default(home):
    paths = written(plot("--robot_name", "leg", "--output", "out", cwd=home))
    assert paths == ["out/trajectory_chirp.png", "out/trajectory_steps.png", "out/score.png"]
    assert all((home / path).read_bytes().startswith(b"\x89PNG") for path in paths)


def test_without_a_display_files_go_to_the_run(warm, home):
    paths = written(warm.run(SCRIPT, "--robot_name", "leg", "--plot_score", cwd=home))
    assert paths == [f"logs/pace/leg/{NEW}/score.png"]


@pytest.mark.slow
def test_one_plot_of_one_run_can_be_chosen(home):
    arguments = ("--robot_name", "leg", "--folder_name", OLD, "--plot_trajectory", "--headless")
    paths = written(plot(*arguments, "--log_dir", home / "logs" / "pace", cwd=ROOT))
    assert [Path(path).name for path in paths] == ["trajectory_chirp.png", "trajectory_steps.png"]
    assert {Path(path).parent.name for path in paths} == {OLD}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--robot_name", "lag"], ["'lag'", "Robots: leg", "Did you mean leg?"]),
        (["--robot_name", "leg", "--folder_name", "26_01"], ["'26_01'", f"Runs: {NEW}, {OLD}"]),
        (["--robot_name", "leg", "--mean_name", "mean_020.pt"], ["no 'mean_020.pt' in", "nor another saved mean"]),
        (["--robot_name", "leg", "--log_dir", "elsewhere"], ["no run under elsewhere", "scripts/fit.py"]),
        (["logs/pace/leg/26_01"], ["There is no run logs/pace/leg/26_01"]),
        (["--robot_name", "leg", "--plot_trajectories"], ["did you mean --plot_trajectory"]),
    ],
)
def test_what_is_wrong_is_one_line_that_says_what_there_is(home, arguments, words):
    done = plot(*arguments, cwd=home)
    assert done.returncode == 2
    assert done.stdout == "" and len(done.stderr.splitlines()) == 1
    for word in words:
        assert word in done.stderr


def test_a_fit_that_still_runs_says_so(home):
    folder = write_run(home / "still" / "leg" / NEW)
    for name in ("best_trajectory.pt", "result.json"):
        (folder / name).unlink()
    done = plot("--robot_name", "leg", "--log_dir", "still", cwd=home)
    assert done.returncode == 2
    assert "has no best_trajectory.pt yet" in done.stderr and "--resume" in done.stderr


# ------------------------------------------------------------------ means, simulated again

TASK, SAMPLES = "Pace-TestBench-v0", 200


def true_values() -> torch.Tensor:
    cfg = load_env_cfg(TASK).sim2real
    return ParameterSpace.of(cfg).from_dict(cfg.sample_params)


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """A run on a recording that the test bench's own parameters made, with two means: those and others."""
    home = tmp_path_factory.mktemp("bench")
    run = home / "logs" / "pace" / "test_bench" / NEW
    run.mkdir(parents=True)
    data = home / "swing.pt"
    time = torch.arange(SAMPLES, dtype=torch.float64) * 0.0025
    command = 0.4 * torch.sin(15 * time)[:, None]
    content = {"time": time, "des_dof_pos": command, "dof_pos": torch.zeros_like(command), "joint_names": ["servo"]}
    torch.save(content, data)
    settings = FitSettings(task=TASK, data=[str(data)])
    write_json(run / "settings.json", {"settings": settings.to_dict(), "digests": {}})
    (first,) = replay(run, true_values()).recordings
    torch.save(content | {"dof_pos": torch.as_tensor(first.simulated)}, data)
    write_tensors(run / "mean_010.pt", 1.3 * true_values())
    write_tensors(run / "mean_020.pt", true_values())
    return home


def test_the_parameters_that_made_a_recording_replay_it(bench):
    run = bench / "logs" / "pace" / "test_bench" / NEW
    for name, expected in (("mean_020.pt", True), ("mean_010.pt", False)):
        content = replay(run, torch.load(run / name))
        (recording,) = content.recordings
        assert content.joint_names == ("servo",) and recording.train.sum() == 0.7 * SAMPLES
        assert (np.abs(recording.error).max() < 1e-9) == expected


def test_a_mean_is_plotted_instead_of_the_best(bench):
    paths = written(plot("--robot_name", "test_bench", "--mean_name", "mean_010.pt", "--plot_trajectory", cwd=bench))
    assert [Path(path).name for path in paths] == ["trajectory_swing_mean_010.png"]


def test_an_unknown_mean_lists_those_there_are(bench):
    done = plot("--robot_name", "test_bench", "--mean_name", "mean_030.pt", cwd=bench)
    assert done.returncode == 2
    assert "Means: mean_010.pt, mean_020.pt." in done.stderr


def test_parameters_of_another_robot_are_refused(bench):
    with pytest.raises(ValueError, match=r"shape \(49,\), expected \(5,\)"):
        replay(bench / "logs" / "pace" / "test_bench" / NEW, torch.zeros(49))
