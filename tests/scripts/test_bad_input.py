"""Bad input to scripts/fit.py: one line that names the fault and its cure, exit status 2, nothing half-written."""

import json
import math
import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from places import ROOT
from problems import ANYMAL, BENCH, env_cfg, record

from pace_actuators import IdentifiedDrives
from pace_envs.tasks.pace import Parameter, test_bench
from pace_optim.comparison import compare
from pace_optim.identification.fit import fit
from pace_optim.recording import load_recording, save_recording
from pace_optim.run.history import History
from pace_optim.run.open import Run
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensors import read_bounds, read_trajectory
from pace_optim.terminal.cli import run_cli

JOINTS = env_cfg(ANYMAL).sim2real.joint_order


def fields(joints=1, samples=200, **changes):
    """A recording's fields, good unless changed; ``None`` leaves one out."""
    time = 0.0025 * np.arange(samples)
    target = 0.3 * np.sin(4 * time)[:, None] * np.ones(joints)
    content = {"time": time, "dof_pos": target, "des_dof_pos": target, **changes}
    return {key: value for key, value in content.items() if value is not None}


def changed(array, index, value):
    result = np.array(array)
    result[index] = value
    return result


def npz(**changes):
    return lambda path: np.savez(path, **fields(**changes))


def text(content):
    return lambda path: path.write_text(content)


GOOD = fields()
TIME, POSITION = GOOD["time"], GOOD["dof_pos"]

RECORDINGS = {
    # what is wrong: (file name, writer, task, what the message says)
    "no such file": ("none.npz", None, BENCH, r"none\.npz: no such file"),
    "a folder": ("folder.npz", lambda path: path.mkdir(), BENCH, r"folder\.npz.*(folder|directory)"),
    "a loop of links": ("loop.npz", lambda path: path.symlink_to(path.name), BENCH, r"loop\.npz"),
    "not an archive": ("torn.npz", text("PK nonsense"), BENCH, r"torn\.npz.*(cannot be read|damaged|no .*npz)"),
    "an empty file": ("void.npz", text(""), BENCH, r"void\.npz.*(cannot be read|empty|no .*npz)"),
    "another format": ("leg.mat", text("x"), BENCH, r"leg\.mat.*\.csv"),
    "no tensors": ("torn.pt", text("nonsense"), BENCH, r"torn\.pt.*torch\.save"),
    "pickled objects": ("own.pt", lambda path: torch.save({"time": Path}, path), BENCH, r"own\.pt.*"),
    "a csv without a header": (
        "bare.csv",
        text("0.0,0.1,0.2\n0.1,0.1,0.2\n"),
        BENCH,
        r"bare\.csv: no column of time found.*--rate HZ",
    ),
    "a missing series": ("r.npz", npz(des_dof_pos=None), BENCH, "des_dof_pos missing; expected"),
    "a misspelt key": ("r.npz", npz(des_dof_pos=None, des_dofpos=POSITION), BENCH, "did you mean 'des_dof_pos'"),
    "not a number": (
        "r.npz",
        npz(dof_pos=changed(POSITION, 7, np.nan)),
        BENCH,
        "NaN or infinite, the first at sample 7",
    ),
    "infinity": ("r.npz", npz(des_dof_pos=changed(POSITION, 3, np.inf)), BENCH, "des_dof_pos has 1 values"),
    "time that jumps back": ("r.npz", npz(time=changed(TIME, 50, 0.0)), BENCH, "does not increase at sample 50"),
    "time in milliseconds": ("r.npz", npz(time=1e3 * TIME), BENCH, "looks like milliseconds.*Divide time by 1000"),
    "time with a hole": ("r.npz", npz(time=TIME + 0.5 * (np.arange(200) > 90)), BENCH, r"gap|hole|missing"),
    "no samples": ("r.npz", npz(samples=0), BENCH, "0 samples|expected at least"),
    "few samples": ("r.npz", npz(samples=5), BENCH, "found 5 samples; expected at least 20"),
    "series of other lengths": ("r.npz", npz(des_dof_pos=POSITION[:-1]), BENCH, r"\(199, 1\) but time has 200"),
    "text for numbers": ("r.npz", npz(dof_pos=np.full((200, 1), "x")), BENCH, "dof_pos holds .*not numbers"),
    "too many joints": ("r.npz", npz(joints=2), BENCH, "has 2 joints .* but the robot has 1"),
    "too few joints": ("r.npz", npz(joints=11), ANYMAL, "has 11 joints .* but the robot has 12"),
    "unknown joints": ("r.npz", npz(joint_names=["servos"]), BENCH, "unknown joint 'servos', did you mean 'servo'"),
    "a joint twice": ("r.npz", npz(joints=2, joint_names=["a", "a"]), BENCH, "joint_names repeats a"),
    "degrees": ("r.npz", npz(joints=12, joint_names=JOINTS, dof_pos=np.full((200, 12), 40.0)), ANYMAL, "degrees"),
    "negative gains": ("r.npz", npz(stiffness=-5.0), BENCH, "stiffness .*is -5; expected a number of zero or more"),
    "gains of other joints": ("r.npz", npz(stiffness=[1.0, 2.0]), BENCH, r"stiffness.*(2|two)"),
    "an unknown load": ("r.npz", npz(added_mass='{"lode": 1.0}'), BENCH, "unknown body 'lode', did you mean 'load'"),
    "another robot's load": ("r.npz", npz(joints=12, load_mass=1.0), ANYMAL, "load_mass.*belong to the test bench"),
    "a negative mass": ("r.npz", npz(load_mass=-1.0), BENCH, "load_mass is -1; expected"),
    "a load without a lever": ("r.npz", npz(load_length=0.0), BENCH, "load_length is 0; expected"),
    "a drive half on": ("r.npz", npz(torque_enable=np.full(200, 0.5)), BENCH, "torque_enable holds values other"),
}

OPTIONS = {
    "no task": (["--data", "GOOD"], "--task is missing"),
    "an unknown task": (["--task", "Pace-TestBensh-v0"], "Did you mean 'Pace-TestBench-v0'"),
    "a task that is no robot's": (["--task", "CartPole-v1"], "no environment 'CartPole-v1'"),
    "a task of an unknown module": (["--task", "nowhere:Pace-X-v0"], "module 'nowhere' cannot be imported"),
    "a misspelt option": (["--task", BENCH, "--optimiser", "cmaes"], "did you mean --optimizer instead of"),
    "a shortened option": (["--task", BENCH, "--num", "8"], "unrecognized arguments: --num"),
    "a word that belongs nowhere": (["--task", BENCH, "fast"], "unrecognized arguments: fast"),
    "an option without its value": (["--task", BENCH, "--sigma"], "--sigma: expected one argument"),
    "an unknown optimizer": (["--task", BENCH, "--optimizer", "adam"], "Unknown optimizer 'adam'. Available: hybrid"),
    "an unknown delay mode": (["--task", BENCH, "--delay_mode", "torque"], "invalid choice: 'torque'.*effort"),
    "no environments": (["--task", BENCH, "--num_envs", "0"], "num_envs is 0, expected at least 1"),
    "half an environment": (["--task", BENCH, "--num_envs", "1.5"], "--num_envs: invalid int value: '1.5'"),
    "no generations": (["--task", BENCH, "--max_iteration", "0"], "max_iteration is 0, expected at least 1"),
    "a negative sigma": (["--task", BENCH, "--sigma", "-0.5"], r"sigma is -0\.5, expected a number > 0"),
    "a sigma that is no number": (["--task", BENCH, "--sigma", "nan"], "--sigma: 'nan' is not a finite number"),
    "an epsilon of zero": (["--task", BENCH, "--epsilon", "0"], "epsilon is 0.0, expected a number > 0"),
    "a negative seed": (["--task", BENCH, "--seed", "-1"], "seed is -1, expected at least 0"),
    "a physics step that is no fraction": (
        ["--task", BENCH, "--physics_dt", "0.001"],
        "whole fraction of the time step",
    ),
    "a coarser physics step": (["--task", BENCH, "--physics_dt", "0.01"], "whole fraction of the time step"),
    "too few environments": (
        ["--task", BENCH, "--data", "GOOD", "GOOD", "--optimizer", "cmaes", "--num_envs", "7"],
        "7 is too few for 2 recordings: expected at least 8",
    ),
    "a validation file that is missing": (
        ["--task", BENCH, "--data", "GOOD", "--validation", "none.npz"],
        r"none\.npz: no such file",
    ),
    "a validation file that is trained on": (
        ["--task", BENCH, "--data", "GOOD", "--validation", "GOOD"],
        r"good\.npz.*--data and --validation",
    ),
    "logs under a file": (
        ["--task", BENCH, "--data", "GOOD", "--log_dir", "GOOD"],
        r"good\.npz.*(ot a directory|exists)",
    ),
    "nothing to resume": (["--resume", "nowhere"], "nowhere is no run"),
    "a folder that is no run": (["--resume", "EMPTY"], "is no run: it has no settings.json"),
}


@pytest.fixture(scope="module")
def main():
    return runpy.run_path(str(ROOT / "scripts" / "fit.py"))["main"]


@pytest.fixture
def fails(main, tmp_path, monkeypatch, capfd):
    """Runs fit.py with arguments, which must fail as they should; returns the message."""
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "good.npz", **GOOD)
    (tmp_path / "empty").mkdir()

    def run(*args, left=()):
        places = {"GOOD": "good.npz", "EMPTY": "empty"}
        before = snapshot(tmp_path)
        monkeypatch.setattr(sys, "argv", ["fit.py", *(places.get(a, a) for a in args)])
        try:
            status = run_cli(main)
        except SystemExit as end:
            status = end.code
        out, err = capfd.readouterr()
        assert status == 2, (status, out, err)
        assert err.startswith("error: ") and err.count("\n") == 1 and err.endswith("\n"), err
        assert len(err) > 30 and "Traceback" not in err and out == ""
        assert snapshot(tmp_path) == before  # no half-written run folder
        return err

    return run


def snapshot(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file() or path.is_dir()}


@pytest.mark.parametrize("fault", RECORDINGS)
def test_a_recording_that_cannot_be_fitted(fault, fails, tmp_path):
    name, write, task, expected = RECORDINGS[fault]
    if write is not None:
        write(tmp_path / name)
    message = fails("--task", task, "--data", name)
    assert re.search(expected, message), message
    assert name in message


@pytest.mark.parametrize("fault", OPTIONS)
def test_options_that_do_not_fit(fault, fails):
    args, expected = OPTIONS[fault]
    message = fails(*args)
    assert re.search(expected, message), message


def test_the_facts_beside_a_csv_may_be_listed_with_it(tmp_path):
    path = save_recording(tmp_path / "r.csv", record())
    facts = str(path.with_suffix(".json"))
    settings = FitSettings(task=BENCH, data=[str(path), facts], validation=[facts])
    assert settings.data == [str(path)]
    assert settings.validation == [facts]  # alone it is no recording, and reading it says so


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that was made."""

    folder = tmp_path_factory.mktemp("run")
    path = save_recording(folder / "r.npz", record())
    return fit(
        FitSettings(task=BENCH, data=[str(path)], optimizer="cmaes", num_envs=4, max_iteration=1, log_dir=str(folder))
    )[1]


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("settings.json", "{", "settings.json is no JSON"),
        ("settings.json", "{}", "settings.json: settings is missing"),
        ("settings.json", '{"settings": {"tusk": 1}, "digests": {}}', "settings.json: settings: the key 'tusk' is not"),
        ("settings.json", '{"settings": {"task": "Pace-X-v0"}, "digests": {}}', "no environment 'Pace-X-v0'"),
        ("checkpoint.npz", None, "has no checkpoint.npz: it cannot be resumed. Start a new fit."),
        ("checkpoint.npz", "nonsense", "checkpoint.npz cannot be read"),
        ("checkpoint.npz", "", "checkpoint.npz cannot be read"),
    ],
)
def test_a_run_that_cannot_be_resumed(name, content, expected, fails, finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    if content is None:
        (run / name).unlink()
    else:
        (run / name).write_text(content)
    assert expected in fails("--resume", "run")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("control_dt", 1e308, "control_dt 1e+308"),
        ("physics_dt", 0.1, "the first no longer than the second"),
        ("delay_s", -1.0, "delay_s is -1"),
        ("delay_s", 1e308, "delay_s is 1e+308"),
        ("parameters/friction", {"all": -1.0}, "friction of all is -1"),
        ("drive", {"velocity_limit": {"servo": -1.0}}, "drive/velocity_limit of servo is -1"),
        ("drive", {"saturation_effort": {"servo": 0.0}}, "drive/saturation_effort of servo is 0"),
        ("drive", {"damping": {"servo": -1.0}}, "drive/damping of servo is -1"),
    ],
)
def test_a_result_that_no_drive_can_have_is_told_with_its_file(key, value, expected, finished, tmp_path):
    content = json.loads((finished / "result.json").read_text())
    *inner, last = key.split("/")
    (content[inner[0]] if inner else content)[last] = value
    (tmp_path / "result.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"result\.json: .*{re.escape(expected)}"):
        IdentifiedDrives.load(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("units/friction", ["N m"], "units/friction is a list, expected text"),
        ("units/friction", {"servo": 1}, "units/friction/servo is 1, expected text"),
        ("loop_rate", {"used_s": [0.001]}, "loop_rate/assumed_s must be"),
        ("loop_rate", {"assumed_s": 0.001, "used_s": "x"}, "loop_rate/used_s must be"),
    ],
)
def test_a_result_that_no_fit_writes_is_told_with_its_file(key, value, expected, finished, tmp_path):
    content = json.loads((finished / "result.json").read_text())
    *inner, last = key.split("/")
    (content[inner[0]] if inner else content)[last] = value
    (tmp_path / "result.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"result\.json: .*{re.escape(expected)}"):
        FitResult.load(tmp_path)


@pytest.mark.parametrize("value", [1e160, math.inf, math.nan])
def test_a_simulation_that_diverged_is_told_with_its_file(value, finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    content = torch.load(run / "best_trajectory.pt")
    content["recordings"][0]["sim_dof_pos"][3:] = value
    torch.save(content, run / "best_trajectory.pt")
    with pytest.raises(ValueError, match=r"best_trajectory\.pt: the simulation of .* diverges"):
        compare([run])


def test_names_in_lists_of_their_own_are_told_with_their_file(tmp_path):
    path = save_recording(tmp_path / "r.csv", record())
    facts = json.loads(path.with_suffix(".json").read_text()) if path.with_suffix(".json").is_file() else {}
    path.with_suffix(".json").write_text(json.dumps(facts | {"joint_names": ["servo", ["arm"]]}))
    with pytest.raises(ValueError, match=r"r\.json: joint_names differs from the one in r\.csv"):
        load_recording(path)


def test_recordings_that_a_run_names_and_cannot_have_are_told_with_its_settings(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    content = json.loads((run / "settings.json").read_text())
    content["settings"]["validation"] = ["x"]
    (run / "settings.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"x: no such file.*settings\.json"):
        Run.open(run).problem()


def test_scores_of_different_length_are_told_with_their_file(finished, tmp_path):
    content = json.loads((finished / "history.json").read_text()) | {"search_mean": []}
    (tmp_path / "history.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"history\.json: search_best, search_mean.* differ in length \(1, 0, 1, 1\)"):
        History.load(tmp_path / "history.json")


def test_half_a_character_is_told_with_its_file(finished, tmp_path):
    text = (finished / "result.json").read_text()
    (tmp_path / "result.json").write_text(text.replace('"warnings": [', '"warnings": ["\\ud800", ', 1))
    with pytest.raises(ValueError, match=r"result\.json is no JSON \(.*surrogates not allowed"):
        IdentifiedDrives.load(tmp_path)


@pytest.mark.parametrize("bounds", [(1e160, 1e160), (1.0, 0.0)])
def test_bounds_that_are_none_are_told_with_their_file(bounds, finished, tmp_path):
    content = torch.load(finished / "config.pt")
    content["bounds_params"][0] = torch.tensor(bounds, dtype=torch.float64)
    torch.save(content, tmp_path / "config.pt")
    with pytest.raises(ValueError, match=r"config\.pt: bounds_params (has a lower bound above|is no tensor of finite)"):
        read_bounds(tmp_path)


@pytest.mark.parametrize("damage", ["flags that are none", "a loop of links"])
def test_trajectories_that_are_none_are_told_with_their_file(damage, finished, tmp_path):
    path = tmp_path / "best_trajectory.pt"
    if damage == "a loop of links":
        path.symlink_to(path.name)
    else:
        content = torch.load(finished / path.name)
        content["recordings"][0]["torque_enable"] = "on"
        torch.save(content, path)
    with pytest.raises(ValueError, match=r"best_trajectory\.pt.*(torque_enable is no series|link to nothing)"):
        read_trajectory(tmp_path)


def test_a_robots_sample_that_is_missing_is_named(fails, monkeypatch):
    cfg = env_cfg(BENCH, data_dir="gone/chirp.npz")
    monkeypatch.setattr(test_bench, "test_bench_pace_env_cfg", lambda: cfg)
    assert "gone/chirp.npz" in fails("--task", BENCH)


def test_bounds_that_leave_nothing_to_identify_are_told(fails, monkeypatch):
    bounds = env_cfg(BENCH).sim2real.bounds
    cfg = env_cfg(BENCH, bounds={name: own[:, [0, 0]] for name, own in bounds.items()})
    monkeypatch.setattr(test_bench, "test_bench_pace_env_cfg", lambda: cfg)
    assert "there is nothing to identify" in fails("--task", BENCH, "--data", "GOOD")


def test_a_parameter_that_cannot_be_applied_leaves_no_run_folder(fails, monkeypatch):
    def apply(env, values):
        raise ValueError("the gear ratio of servo is not known.")

    extra = Parameter(name="gear", unit="1", lower=(1.0,), upper=(2.0,), apply=apply, keys=("servo",))
    cfg = env_cfg(BENCH, extra_parameters=(extra,))
    monkeypatch.setattr(test_bench, "test_bench_pace_env_cfg", lambda: cfg)
    assert "gear ratio of servo" in fails("--task", BENCH, "--data", "GOOD", "--optimizer", "least_squares")


def test_the_script_itself_exits_with_2_and_one_line(warm, tmp_path):
    done = warm.run(ROOT / "scripts" / "fit.py", "--task", BENCH, "--data", "none.npz", cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: none.npz") and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
