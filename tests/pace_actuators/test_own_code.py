"""Weights only: a checkpoint that would run code to be read is refused; so is every pickle that a command reads."""

import json
import pickle
import shutil
import sys
from pathlib import Path

import pytest
import torch
from command_lines import run_script
from problems import BENCH, record

from pace_actuators.effects import get_effect
from pace_actuators.own_code import code_of, digest_of, import_named, import_recorded, loaded_module
from pace_envs.rl.runner import read_checkpoint
from pace_optim.identification.fit import fit
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings


class Planted:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    path = save_recording(folder / "r.npz", record())
    settings = FitSettings(
        task=BENCH, data=[str(path)], optimizer="cmaes", num_envs=4, max_iteration=1, log_dir=str(folder)
    )
    return fit(settings)[1]


def planted(path: Path, mark: Path, kind: str) -> None:
    if kind == "torch":
        torch.save({"task": Planted(mark), "recordings": [Planted(mark)]}, path)
    else:
        path.write_bytes(pickle.dumps(Planted(mark)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["torch", "pickle"])
@pytest.mark.parametrize(
    "name",
    [
        "best_trajectory.pt",
        "config.pt",
        "mean_001.pt",
        "checkpoint.npz",
        "settings.json",
        "result.json",
        "history.json",
    ],
)
def test_no_file_of_a_run_runs_code_when_it_is_read(name, kind, run, tmp_path):
    before, mark = (run / name).read_bytes() if (run / name).exists() else None, tmp_path / "executed"
    planted(run / name, mark, kind)
    try:
        for words in (
            ("compare", run),
            ("export", run, "--format", "json"),
            ("fit", "--resume", run),
            ("plot_trajectory", "--robot_name", "test_bench", "--log_dir", run.parents[1], "--output", tmp_path),
        ):
            if words[0] == "fit" and name in ("best_trajectory.pt", "config.pt", "mean_001.pt", "result.json"):
                continue  # not read there: it would only take long
            done = run_script(*words)
            assert done.returncode in (0, 2) and done.stderr.count("error:") <= 1, done.stderr
    finally:
        (run / name).unlink() if before is None else (run / name).write_bytes(before)
    assert not mark.exists()


@pytest.mark.parametrize("kind", ["torch", "pickle"])
def test_a_checkpoint_that_would_run_code_is_refused(kind, tmp_path):
    planted(tmp_path / "model_0.pt", tmp_path / "executed", kind)
    with pytest.raises(ValueError, match=r"model_0\.pt"):
        read_checkpoint(tmp_path / "model_0.pt")
    done = run_script(
        "play", "--checkpoint", tmp_path / "model_0.pt", "--task", "Pace-AnymalD-Velocity-v0", "--num_envs", 1
    )
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("error: The checkpoint"), done.stderr
    assert not (tmp_path / "executed").exists()


def test_a_recording_that_would_run_code_is_refused(tmp_path):
    for name in ("own.pt", "own.npz", "own.csv"):
        planted(tmp_path / name, tmp_path / "executed", "torch")
        done = run_script("fit", "--task", BENCH, "--data", tmp_path / name)
        assert done.returncode == 2 and name in done.stderr
    assert not (tmp_path / "executed").exists()


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of three files, one of them imported late, beside a module that it does not use."""
    folder = tmp_path / "trees"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "oak.py").write_text(
        "from .leaf import COLOUR\n\ndef late():\n    from trees import root\n    return root\n"
    )
    (folder / "leaf.py").write_text("import json\nCOLOUR = 'green'\n")
    (folder / "root.py").write_text("DEPTH = 2\n")
    (folder / "weed.py").write_text("")
    yield tmp_path
    for name in [name for name in sys.modules if name.split(".")[0] == "trees"]:
        del sys.modules[name]
    sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != "_RecordedCode"]
    sys.path[:] = [path for path in sys.path if path != str(tmp_path)]


def forget():
    for name in [name for name in sys.modules if name.split(".")[0] == "trees"]:
        del sys.modules[name]


def test_the_record_holds_what_is_imported_also_late_and_nothing_else(package, monkeypatch):
    monkeypatch.chdir(package)
    import_named("trees.oak")
    assert set(code_of(["trees.oak"])) == {"trees", "trees.oak", "trees.leaf", "trees.root"}


def test_recorded_code_is_run_from_the_bytes_that_were_compared(package, monkeypatch, tmp_path):
    monkeypatch.chdir(package)
    import_named("trees.oak")
    record = json.loads(json.dumps(code_of(["trees.oak"])))
    forget()
    sys.path.remove(str(package))
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "trees").mkdir(parents=True)
    (elsewhere / "trees" / "__init__.py").write_text("raise SystemExit('executed')")
    monkeypatch.chdir(elsewhere)
    monkeypatch.syspath_prepend(elsewhere)
    module = import_recorded("trees.oak", record, "result.json", "--task …")
    assert module.COLOUR == "green" and module.late().DEPTH == 2
    forget()
    (package / "trees" / "leaf.py").write_text("raise SystemExit('executed')")
    with pytest.raises(ValueError, match=r"leaf\.py has changed since result\.json"):
        import_recorded("trees.oak", record, "result.json", "--task …")


def test_a_folder_that_brings_code_and_its_digest_along_runs_none_of_it(run, tmp_path):
    """A forged run: its record fits its module, and nobody has named that module on this machine."""
    forged = tmp_path / "downloaded" / "run"
    shutil.copytree(run, forged)
    module = forged.parent / "helper.py"
    module.write_text(f"open({str(tmp_path / 'executed')!r}, 'w')\n")
    record = {"helper": {"file": str(module), "sha256": digest_of(module.read_bytes())}}
    for name, part in (("settings.json", "settings"), ("result.json", None)):
        content = json.loads((forged / name).read_text())
        (content if part is None else content[part])["effects"] = ["helper:Drag"]
        environment = {"task": BENCH, "module": "helper", "folder": str(forged.parent), "code": record, "files": {}}
        content["environment"] = environment
        (forged / name).write_text(json.dumps(content))
    for words in (("fit", "--resume", forged), ("diagnose", forged), ("export", forged, "--format", "json")):
        done = run_script(*words, cwd=forged.parent)
        assert done.returncode == 2 and "helper.py, that was never named on this machine" in done.stderr, done
    assert not (tmp_path / "executed").exists()


def test_code_that_was_named_once_is_known_from_then_on(package, monkeypatch):
    monkeypatch.chdir(package)
    monkeypatch.setenv("XDG_STATE_HOME", str(package / "state"))
    code = {"trees": package / "trees" / "__init__.py", "trees.leaf": package / "trees" / "leaf.py"}
    record = {name: {"file": str(file), "sha256": digest_of(file.read_bytes())} for name, file in code.items()}
    with pytest.raises(ValueError, match=r"was never named on this machine.*--import trees"):
        import_recorded("trees.leaf", record, "result.json", "--import trees.leaf")
    import_named("trees.leaf")
    forget()
    assert import_recorded("trees.leaf", record, "result.json", "--import trees.leaf").COLOUR == "green"
    forget()
    (package / "state" / "pace" / "named_code.txt").unlink()
    (package / "state" / "pace").rmdir()
    (package / "state" / "pace").write_text("in the way: nothing can be kept")
    import_named("trees.leaf")


def test_code_without_a_record_is_not_imported(package, monkeypatch):
    monkeypatch.syspath_prepend(package)
    with pytest.raises(
        ValueError, match=r"result\.json names code, trees\.oak, and has no record of it.*--import trees"
    ):
        import_recorded("trees.oak", {}, "result.json", "--import trees.oak")


def test_a_module_that_is_named_wrongly_is_one_line():
    done = run_script("fit", "--task", "nowhere:Pace-X-v0")
    assert done.returncode == 2 and "module 'nowhere' cannot be imported" in done.stderr
    done = run_script("fit", "--task", BENCH, "--effects", "nowhere.py:Drag")
    assert done.returncode == 2 and "'nowhere.py' cannot be imported" in done.stderr
    with pytest.raises(ValueError, match="has not been imported"):
        get_effect("nowhere.py:Drag")


def test_what_other_libraries_put_among_the_modules_is_passed_over(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "cython.parallel", object())  # as Cython does
    assert loaded_module(str(tmp_path / "own.py")) is None
    assert loaded_module(__file__) is sys.modules[__name__]
