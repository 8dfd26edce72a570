"""A run on a robot that is not ours: every command works on it, from any folder; no file names code to run."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest
import torch
from command_lines import ROOT, run_script
from own_robot import write_robot

from pace_envs.task_source import use_task
from pace_optim.identification.fit import fit
from pace_optim.run.open import Run, open_problem

FIT = ("--optimizer", "least_squares", "--no_consistency")


def last_run(done: subprocess.CompletedProcess) -> Path:
    assert done.returncode == 0, done.stdout + done.stderr
    return Path(done.stdout.strip().splitlines()[-1].removeprefix("run: "))


@pytest.fixture(autouse=True)
def forgets_the_robot():
    """Every test begins as a process of its own would: without the robot's code."""
    forget()
    yield
    forget()


def forget():
    for name in ("swing", "swing_limits", "sticky_effect"):
        sys.modules.pop(name, None)
    sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != "_RecordedCode"]
    sys.path[:] = [path for path in sys.path if "pytest-" not in path]


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """The robot's folder, with a fit of it that was started there."""
    folder = write_robot(tmp_path_factory.mktemp("project"))
    words = ("--task", "swing:Pace-Swing-v0", "--effects", "sticky_effect:Sticky", *FIT)
    run = last_run(run_script("fit", *words, cwd=folder))
    forget()
    return folder, (folder / run).resolve()


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Another folder, with modules in it that wait to be imported in place of the robot's."""
    for name in ("swing", "swing_limits", "sticky_effect", "onnx", "tensorboard"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'a').write({name!r})\n")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not (tmp_path / "executed").exists(), (tmp_path / "executed").read_text()


def copy_of(project, tmp_path) -> tuple[Path, Path]:
    """Project and run, the paths in its record those of the copy."""
    folder, run = project
    target = tmp_path / "copy"
    shutil.copytree(folder, target)
    copied = target / run.relative_to(folder)
    for name in ("settings.json", "result.json"):
        text = (copied / name).read_text().replace(str(folder), str(target))
        (copied / name).write_text(text)
    return target, copied


@pytest.mark.slow
def test_what_a_run_keeps(project):
    folder, run = project
    content = json.loads((run / "settings.json").read_text())
    assert content["settings"]["task"] == "swing:Pace-Swing-v0"
    assert content["settings"]["data"] == [str(folder / "data" / "swing.csv")]
    assert set(content["environment"]["code"]) == {"swing", "swing_limits", "sticky_effect"}
    inputs = {Path(name).name for name in content["inputs"]}
    assert inputs == {
        "swing.xml", "arm_defaults.xml", "swing.py", "swing_limits.py", "sticky_effect.py", "swing.json"
    }  # fmt: skip
    assert content["inputs"][str(folder / "data" / "swing.json")] is None  # facts that are not there
    resolved = content["resolved"]
    assert resolved["configuration"]["scene"]["robot"]["actuators"]["drive"]["stiffness"] == 8.0
    assert resolved["parameters"]["friction/hinge"] == {"unit": "N m", "lower": 0.0, "upper": 0.3}
    assert resolved["effects"][0]["parameters"][0]["upper"] == 0.5
    assert {"pace-mujoco", "mujoco", "torch"} <= set(resolved["versions"])
    assert mujoco.MjModel.from_binary_path(str(run / "model.mjb")).joint(0).name == "hinge"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("compare", ("RUN",)),
        ("compare", ("RUN", "--data", "DATA")),
        ("export", ("RUN", "--format", "mjcf", "--output", "out.xml")),
        ("export", ("RUN/result.json", "--format", "cfg")),
        ("play", ("--replay", "RUN")),
        ("replay", ("RUN", "--viewer", "none", "--output", "replay.html")),
        ("fit", ("--resume", "RUN")),
        ("plot_trajectory", ("--robot_name", "swing", "--log_dir", "LOGS", "--output", "plots")),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value[1:3]) or "alone",
)
def test_every_command_works_on_it_from_another_folder(script, words, project, elsewhere):
    folder, run = project
    places = {"RUN": str(run), "DATA": str(folder / "data" / "swing.csv"), "LOGS": str(run.parents[1])}
    places["RUN/result.json"] = str(run / "result.json")
    done = run_script(script, *(places.get(word, word) for word in words))
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_it_is_diagnosed_from_another_folder(project, elsewhere):
    words = ("--only", "--effects", "quadratic_friction", "--max_effects", "1", "--physics_dt", "0.0025", "--no_refit")
    done = run_script("diagnose", project[1], *words)
    assert done.returncode == 0, done.stderr
    assert (project[1] / "diagnosis.json").is_file()


@pytest.mark.slow
def test_it_is_fitted_again_from_another_folder(project, elsewhere):
    before = Run.open(project[1])
    settings = replace(before.settings, effects=[], log_dir=str(elsewhere / "again"))
    result, run = fit(settings, before=before)
    assert result.environment["module"] == "swing" and open_problem(run).effects == []


def test_a_mean_of_the_search_is_simulated_again(project, elsewhere):
    run = project[1]
    lower, upper = torch.load(run / "config.pt", weights_only=True)["bounds_params"].T
    torch.save(0.5 * (lower + upper), run / "mean_001.pt")
    words = ("--robot_name", "swing", "--log_dir", run.parents[1], "--mean_name", "mean_001", "--output", "plots")
    assert run_script("plot_trajectory", *words, "--plot_trajectory").returncode == 0


def test_one_line_opens_a_run(project, elsewhere):
    problem = open_problem(project[1])
    assert problem.joint_names == ("hinge",) and problem.effects == ["sticky_effect:Sticky"]


def test_a_file_names_a_task_as_well_as_a_module(project, elsewhere):
    folder, run = project
    task = use_task(f"{folder}/swing.py:Pace-Swing-v0")
    assert open_problem(run, task=task, effects=()).task == task == f"{folder}/swing.py:Pace-Swing-v0"


@pytest.mark.slow
def test_a_model_file_is_a_task(project, elsewhere):
    folder = project[0]
    words = ("--task", "../" + str((folder / "swing.xml").relative_to(elsewhere.parent)), *FIT)
    run = last_run(run_script("fit", *words, "--data", folder / "data" / "swing.csv", "--control_dt", 0.005))
    settings = json.loads((run / "settings.json").read_text())["settings"]
    assert settings["task"] == str(folder / "swing.xml") and settings["control_dt"] == 0.005
    assert open_problem(run).control_dt == json.loads((run / "result.json").read_text())["control_dt"] == 0.005
    (elsewhere / "deeper").mkdir()
    done = run_script("compare", run.resolve(), "--data", folder / "data" / "swing.csv", cwd=elsewhere / "deeper")
    assert done.returncode == 0, done.stderr


CHANGES = {
    "swing.py": "swing.py has changed since",
    "swing_limits.py": "swing_limits.py has changed since",
    "sticky_effect.py": "sticky_effect.py has changed since",
    "swing.xml": "swing.xml has changed or gone",
    "arm_defaults.xml": "arm_defaults.xml has changed or gone",
    "data/swing.csv": "swing.csv has changed or gone",
    "data/swing.json": "swing.json was not there",
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_input_is_not_resumed_with(name, project, tmp_path):
    folder, run = copy_of(project, tmp_path)
    path = folder / name
    path.write_text((path.read_text() if path.exists() else '{"name": "other"}') + "\n")
    done = run_script("fit", "--resume", run)
    assert done.returncode == 2 and CHANGES[name] in done.stderr and done.stderr.count("\n") == 1, done.stderr


@pytest.mark.parametrize(
    "script", [("compare", "--physics_dt", "0.00125"), ("export", "--format", "mjcf"), ("diagnose",)]
)
def test_code_that_has_changed_is_not_imported_until_it_is_named(script, project, tmp_path):
    folder, run = copy_of(project, tmp_path)
    file = folder / "swing.py"
    file.write_text(file.read_text() + f"\nopen({str(tmp_path / 'executed')!r}, 'w')\n")
    done = run_script(script[0], run, *script[1:])
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "--task" in done.stderr and not (tmp_path / "executed").exists()
    if script[0] == "export":
        words = (*script[1:], "--task", f"{file}:Pace-Swing-v0")
        assert run_script("export", run, *words).returncode == 0 and (tmp_path / "executed").exists()


@pytest.mark.slow
def test_a_moved_robot_is_resumed_where_it_is_now(project, tmp_path):
    folder, run = copy_of(project, tmp_path)
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("swing.py", "swing_limits.py", "swing.xml", "arm_defaults.xml"):
        (folder / name).rename(moved / name)
    assert "has gone" in run_script("fit", "--resume", run).stderr
    words = ("--task", f"{moved}/swing.py:Pace-Swing-v0", "--import", folder / "sticky_effect.py")
    done = run_script("fit", "--resume", run, *words)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_resume_says_what_it_ignores(project, elsewhere):
    done = run_script("fit", "--resume", project[1], "--seed", "0", "--sigma", "0.1")
    assert "ignored: --seed, --sigma" in done.stderr and done.returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["result.json", "settings.json"])
def test_an_effect_that_only_a_file_names_is_not_imported(name, project, tmp_path, monkeypatch):
    _, run = copy_of(project, tmp_path)
    (tmp_path / "planted.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for file in ("result.json", "settings.json") if name == "settings.json" else (name,):
        text = (run / file).read_text().replace("sticky_effect:Sticky", "planted:Evil")
        (run / file).write_text(text)
    for script in (("export", "--format", "cfg"), ("compare", "--physics_dt", "0.00125"), ("diagnose", "--no_refit")):
        done = run_script(script[0], run, *script[1:])
        if name == "settings.json" or script[0] == "export":
            assert done.returncode == 2 and "planted" in done.stderr and done.stderr.count("\n") == 1, done.stderr
        if script[0] == "export":
            break
    assert run_script("fit", "--resume", run).returncode in (0, 2)
    assert not (tmp_path / "executed").exists()


@pytest.mark.slow
def test_the_installed_command_reads_no_module_of_the_present_folder(elsewhere):
    for name in ("argparse", "torch", "numpy", "mujoco"):
        (elsewhere / f"{name}.py").write_text(f"open({str(elsewhere / 'executed')!r}, 'a')\n")
    begin = f"import sys; sys.path[0] = {str(ROOT)!r}; sys.argv = ['pace', 'list-envs']"
    code = f"{begin}\nfrom pace_optim.commands import main; main()"
    done = subprocess.run([sys.executable, "-c", code], cwd=elsewhere, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_run_says_which_task_it_is(project, elsewhere):
    assert Run.open(project[1]).settings.task == "swing:Pace-Swing-v0"
    assert json.loads((project[1] / "result.json").read_text())["environment"]["module"] == "swing"
