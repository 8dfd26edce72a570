"""What is released: wheel and archive, with all they need; the notebook; the files that a repository shows."""

import json
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from places import ROOT

NEEDED = (
    "pace_actuators/py.typed",
    "pace_assets/anymal_d/anymal_d.xml",
    "pace_assets/test_bench/chirp.npz",
    "pace_envs/py.typed",
    "pace_optim/report/style.css",
    "pace_optim/report/script.js",
    "pace_optim/report/motion/viewer.js",
    "pace_optim/commands/fit.py",
)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and archive, from a copy of what git has (a build leaves folders behind)."""
    source, out = tmp_path_factory.mktemp("source") / "pace", tmp_path_factory.mktemp("dist")
    subprocess.run(["git", "clone", "-q", "--depth", "1", f"file://{ROOT}", source], check=True)
    subprocess.run(["git", "tag", "v7.8.9"], cwd=source, check=True)
    run = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    return out


@pytest.mark.slow
def test_the_version_is_the_tag_s(built):
    assert sorted(path.name for path in built.iterdir()) == [
        "pace_mujoco-7.8.9-py3-none-any.whl",
        "pace_mujoco-7.8.9.tar.gz",
    ]


@pytest.mark.slow
def test_the_wheel_holds_what_it_needs_and_nothing_else(built):
    with zipfile.ZipFile(next(built.glob("*.whl"))) as wheel:
        names = set(wheel.namelist())
        entry_points = wheel.read("pace_mujoco-7.8.9.dist-info/entry_points.txt").decode()
    assert names.issuperset(NEEDED)
    tops = {name.split("/")[0] for name in names}
    assert tops == {"pace_actuators", "pace_assets", "pace_envs", "pace_optim", "pace_mujoco-7.8.9.dist-info"}
    assert "pace = pace_optim.commands:main" in entry_points
    assert {"LICENSE", "NOTICE"} <= {Path(name).name for name in names}


@pytest.mark.slow
def test_the_archive_can_be_built_from(built):
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {
        "pyproject.toml",
        "setup.py",
        "README.md",
        "assets/anymal_d/anymal_d.xml",
        "tests/project/test_release.py",
    } <= names


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


def test_the_citation_and_the_security_policy_are_there():
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.search(r"^cff-version: 1\.2\.0$", citation, re.MULTILINE) and "Bjelonic" in citation
    assert "privately" in (ROOT / "SECURITY.md").read_text("utf-8")


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_the_repository_s_files_are_yaml_and_name_no_secret(path):
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with mkdocs, which is not installed")
    text = path.read_text("utf-8")
    assert yaml.safe_load(text)
    assert "secrets." not in text
