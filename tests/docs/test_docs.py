"""The tutorials work when typed: their blocks of bash and Python run, in order, in one shell."""

import json
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from command_lines import run_script
from effect_list import page as page_of_effects
from other_simulators import isaaclab_wheel, others_python
from places import ROOT, SUPPORT
from torque_sequence import write_result
from warm_python import WarmPython

from pace_optim.export import export

FENCE = re.compile(r"^```(bash|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!https?:|mailto:)([^)#\s]*)(#[^)\s]*)?\)")
COMMAND = re.compile(r"(?:scripts/(\w+)\.py|^pace ([a-z-]+))(.*)")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.md")])


def blocks(page: Path, language: str | None = None) -> list[tuple[str, str]]:
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    return [(kind, text) for kind, text in found if language in (None, kind)]


def type_in(warm: WarmPython, name: str, home: Path, start: Path, shorter: dict[str, str]) -> str:
    """Run all blocks of a page in one shell, as a reader who starts in the checkout would, with shorter motions."""
    page, script = ROOT / "docs" / name, ["set -eo pipefail"]
    for long in shorter:
        assert any(long in text for _, text in blocks(page)), f"{name} has no {long!r} that could be shorter"
    for i, (kind, text) in enumerate(blocks(page)):
        for long, short in shorter.items():
            text = text.replace(long, short)
        if any(not (ROOT / path).exists() for path in re.findall(r"scripts/\w+\.py", text)):
            continue  # not there yet
        script.append(f"echo '>>> block {i}'")
        if kind == "bash":
            script.append(text)
        else:
            (home / f"block_{i}.py").write_text(text, encoding="utf-8")
            script.append(f"python - < {home / f'block_{i}.py'}")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    kernels = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")  # each takes a compiler seconds
    run = subprocess.run(
        ["bash", "-c", "\n".join([warm.bash, *script])],
        cwd=start,
        env={**os.environ, "HOME": str(home), "XDG_CACHE_HOME": kernels, "PATH": path, "PYTHONUTF8": "1"},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert run.returncode == 0, f"{page.name}:\n{run.stdout[-3000:]}\n{run.stderr[-3000:]}"
    return run.stdout


@pytest.mark.slow
def test_the_tutorial_for_an_own_robot_works_when_typed(warm, tmp_path):
    shorter = {"--duration 6": "--duration 1", "--duration 3": "--duration 0.8", "--duration 2": "--duration 1"}
    printed = type_in(warm, "your_own_robot.md", tmp_path, ROOT, shorter)
    assert "replay: " in printed
    assert list(tmp_path.glob("my_arm/logs/pace/my_arm/*/result.json"))


@pytest.mark.slow
def test_the_tutorial_for_an_own_objective_works_when_typed(warm, tmp_path):
    shorter = {"--duration 2": "--duration 1", "--max_iteration 10": "--max_iteration 4"}
    type_in(warm, "your_own_objective.md", tmp_path, ROOT, shorter)


@pytest.mark.slow
def test_the_tutorial_for_an_own_effect_works_when_typed(warm, tmp_path):
    printed = type_in(warm, "your_own_effect.md", tmp_path, ROOT, {})
    assert "mrad without the cable" in printed
    assert "verdict: effect\nMissing: cable_drag.\nOn held-out" in printed


@pytest.mark.slow
def test_the_tutorial_for_a_walking_robot_works_when_typed(warm, tmp_path):
    printed = type_in(warm, "walking.md", tmp_path, ROOT, {})
    assert "verdict: nothing_missing" in printed


@pytest.mark.slow
def test_the_page_for_users_of_pace_works_when_typed(warm, tmp_path):
    printed = type_in(warm, "coming_from_pace.md", tmp_path, ROOT, {"--duration 1 ": "--duration 0.4 "})
    assert "plot: " in printed and "objective my_optimizers:Weighted" in printed


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_notebook_runs_from_top_to_bottom(warm, tmp_path):
    cells = json.loads((ROOT / "docs" / "demo.ipynb").read_text("utf-8"))["cells"]
    assert not any(cell.get("outputs") for cell in cells), "outputs stay out of the repository"
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    guarded = "if __name__ == '__main__':\n" + "\n".join(f"    {line}" for line in code.splitlines())
    (tmp_path / "notebook.py").write_text(guarded, encoding="utf-8")
    run = warm.run("notebook.py", cwd=tmp_path, timeout=580)
    assert run.returncode == 0, run.stderr[-3000:]
    assert "stribeck_friction" in run.stdout


def test_the_page_of_effects_is_that_of_the_registry():
    assert (ROOT / "docs" / "effects.md").read_text(encoding="utf-8") == page_of_effects(), (
        "Write it anew: python docs/site/effect_list.py > docs/effects.md"
    )


SHOWN = [
    ROOT / "README.md",
    *(ROOT / "docs" / f"{name}.md" for name in ("getting_started", "environments", "training", "deploying")),
]
"""Pages whose code runs and whose commands exist; they take too long to be typed."""


@pytest.mark.parametrize("page", SHOWN, ids=lambda page: page.name)
def test_the_code_runs(warm, page, tmp_path):
    write_result(tmp_path / "result.json")
    for i, (_, text) in enumerate(blocks(page, "python")):
        if text.startswith("# in "):  # another simulator's environment
            continue
        run = warm.run("-", input=text, cwd=tmp_path, timeout=120)
        assert run.returncode == 0, f"block {i}:\n{run.stderr}"


@pytest.mark.slow
def test_the_code_for_isaac_lab_runs_there(tmp_path):
    stubs = "from pathlib import Path\nfrom isaaclab_torques import load_isaaclab, build\n"
    stubs += f"load_isaaclab(Path({str(isaaclab_wheel())!r}))\n"
    built = 'print(build(actuators["legs"]).motor.time_lags.tolist())\n'
    assert "3.4" in elsewhere(sys.executable, stubs + block_for("Isaac Lab") + built, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_code_for_mjlab_runs_there(tmp_path):
    """Our drive, and what ``--format mjlab_native`` writes."""
    robot = str(ROOT / "assets" / "anymal_d" / "anymal_d.xml")
    built = (
        f"from mjlab_torques import World\nprint(World({robot!r}, *articulation.actuators).dofs('dof_armature')[0])\n"
    )
    export(write_result(tmp_path / "result.json"), "mjlab_native").write(tmp_path / "drives.py")
    shutil.copy(robot, tmp_path / "robot.xml")
    native = (
        block_for("mjlab\n") + "print('native', robot.build().compile().joint('LF_HFE').frictionloss, len(events))\n"
    )
    printed = elsewhere(others_python(), block_for("mjlab") + built + native, tmp_path)
    assert "0.055" in printed and "native [0.32] 12" in printed


def block_for(simulator: str) -> str:
    """The code that is for a simulator's environment, or, where a line ends after its name, for it alone."""
    start = f"# in {simulator}" if simulator.endswith("\n") else f"# in {simulator}'s"
    (text,) = (text for _, text in blocks(ROOT / "docs" / "deploying.md") if text.startswith(start))
    return text


def elsewhere(python: str | Path, code: str, folder: Path) -> str:
    write_result(folder / "result.json")
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(SUPPORT), str(folder)])}
    run = subprocess.run(
        [python, "-"], input=code, cwd=folder, env={**os.environ, **paths}, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.parametrize("page", SHOWN, ids=lambda page: page.name)
def test_the_commands_exist_with_these_options(page):
    commands = [COMMAND.search(line) for _, text in blocks(page, "bash") for line in text.splitlines()]
    found = [(each[1] or each[2].replace("-", "_"), each[3]) for each in commands if each]
    assert found
    for script, rest in found:
        for option in re.findall(r"(?<=\s)--\w[\w-]*", rest.split("#")[0]):
            assert option in help_of(script), f"{script} has no {option}"


@cache
def help_of(script: str) -> str:
    """Each script is asked once."""
    return run_script(script, "--help").stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        linked = (page.parent / target).resolve() if target else page
        assert linked.exists(), f"{page.name} links to {target}"
        if anchor and linked.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor[1:] in slugs, f"{page.name} links to {target}{anchor}; {linked.name} has {sorted(slugs)}"
