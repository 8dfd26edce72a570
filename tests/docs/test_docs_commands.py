"""Every command of the documentation that concerns a run works, typed as it stands, on a run of a robot not ours."""

import re
import shlex
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from command_lines import ROOT, run_script
from own_robot import write_robot

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(?:bash|text)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
IN_TEXT = re.compile(r"`((?:pace|(?:python )?scripts/)[^`]*)`")
A_RUN = re.compile(r"\$\(ls[^)]*\)|logs/pace/\w+/(?:<\w+>|\d\d_\d\d_\d\d_\S+|\*)|\bRUN\b")
"""What stands for the folder of an identification's run."""
SHORT = {"diagnose": "--only --effects quadratic_friction --max_effects 1 --physics_dt 0.00125 --no_refit"}
"""What makes a command short that would try everything."""
ELSEWHERE = ("train", "play")
"""Commands of a walking robot; with ``--replay`` they are of a run."""


def commands_of(text: str) -> list[str]:
    """The commands of a page that name a run, each as a line."""
    lines = [line for block in FENCE.findall(text) for line in block.replace("\\\n", " ").splitlines()]
    lines += [found.replace("\n", " ") for found in IN_TEXT.findall(text)]
    lines = [re.split(r"\s#", line)[0].strip() for line in lines]
    return [line for line in lines if re.match(r"(python )?\S*scripts/|pace ", line) and A_RUN.search(line)]


def taken_apart(line: str) -> tuple[str, list[str]]:
    """Script and words of a command line."""
    words = shlex.split(A_RUN.sub("RUN", line))
    words = words[1:] if words[0] in ("python", "pace") else words
    if "--task" in words:  # the run knows its own
        del words[words.index("--task") : words.index("--task") + 2]
    words = ["DATA" if word.endswith((".csv", ".npz")) else word.replace("RUN/result.json", "RUN") for word in words]
    return Path(words[0]).stem.replace("-", "_"), words[1:]


def documented() -> list[str]:
    """The commands of all pages that are of an identification's run, each once."""
    found = dict.fromkeys(line for page in PAGES for line in commands_of(page.read_text(encoding="utf-8")))
    lines = [line for line in found if taken_apart(line)[0] not in ELSEWHERE or "--replay" in line]
    return list({str(taken_apart(line)): line for line in lines}.values())


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A fit of another's robot, straight from its model file, in a folder that is left."""
    folder = write_robot(tmp_path_factory.mktemp("project"))
    (folder / "data" / "swing.json").write_text('{"stiffness": 8.0, "damping": 0.3}')
    words = ("--task", "swing.xml", "--data", "data/swing.csv", "--optimizer", "least_squares", "--no_consistency")
    done = run_script("fit", *words, cwd=folder)
    assert done.returncode == 0, done.stderr
    return (folder / last_line(done)).resolve()


def last_line(done: subprocess.CompletedProcess) -> str:
    return done.stdout.strip().splitlines()[-1].removeprefix("run: ")


def test_commands_are_found():
    verbs = {taken_apart(line)[0] for line in documented()}
    assert {"compare", "diagnose", "fit", "export", "play"} <= verbs


@pytest.mark.slow
@pytest.mark.parametrize("line", documented())
def test_it_works_on_a_run_of_another_robot_from_another_folder(line, run, tmp_path):
    script, words = taken_apart(line)
    if any(word.startswith("cuda") for word in words) and not torch.cuda.is_available():
        pytest.skip("needs a GPU and torch for CUDA")
    places = {"RUN": str(run), "DATA": str(run.parents[3] / "data" / "swing.csv")}
    words = [places.get(word, word) for word in words]
    done = run_script(script, *words, *SHORT.get(script, "").split(), cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    if "--output" in words:
        assert (tmp_path / words[words.index("--output") + 1]).is_file()


@pytest.mark.parametrize(("interrupted", "diagnosed"), [(False, True), (True, False)])
def test_a_fit_goes_on_to_the_diagnosis_of_its_run(interrupted, diagnosed, run, tmp_path, monkeypatch):
    ended = SimpleNamespace(is_interrupted=interrupted)
    asked = []
    monkeypatch.setattr("pace_optim.run.summary.summary", lambda _: [])
    monkeypatch.setattr("pace_optim.identification.fit.fit_with_torques", lambda settings, **_: (ended, run))
    monkeypatch.setattr("pace_optim.commands.diagnose.run_and_tell", asked.append)
    words = ("--task", run.parents[3] / "swing.xml", "--data", run.parents[3] / "data" / "swing.csv", "--diagnose")
    done = run_script("fit", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [settings.run for settings in asked] == ([run] if diagnosed else [])
