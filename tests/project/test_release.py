"""What is released: wheel and archive, with all they need; the files that a repository shows."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile

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


CODE = ("pace_actuators", "pace_envs", "pace_optim")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """What git has, with the working tree's code and assets (a build leaves folders behind)."""
    copy = tmp_path_factory.mktemp("source") / "pace"
    subprocess.run(["git", "clone", "-q", "--depth", "1", f"file://{ROOT}", copy], check=True)
    for folder in (*CODE, "assets"):
        shutil.rmtree(copy / folder)
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    git = ["git", "-c", "user.name=test", "-c", "user.email=test@localhost"]
    for words in (["add", "--all"], ["commit", "-q", "--allow-empty", "-m", "Working tree"], ["tag", "v7.8.9"]):
        subprocess.run([*git, *words], cwd=copy, check=True)
    return copy


@pytest.fixture(scope="module")
def built(source, tmp_path_factory):
    """Wheel and archive."""
    out = tmp_path_factory.mktemp("dist")
    run = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    return out


@pytest.fixture(scope="module")
def wheel(built):
    with zipfile.ZipFile(next(built.glob("*.whl"))) as archive:
        yield archive


def files_of(folder, pattern):
    """The files under a folder that belong in a wheel, as paths from the folder."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob(pattern) if p.is_file()}


@pytest.mark.slow
def test_the_version_is_the_tag_s(built):
    assert sorted(path.name for path in built.iterdir()) == [
        "pace_mujoco-7.8.9-py3-none-any.whl",
        "pace_mujoco-7.8.9.tar.gz",
    ]


@pytest.mark.slow
def test_the_wheel_holds_what_it_needs_and_nothing_else(wheel):
    names = wheel.namelist()
    entry_points = wheel.read("pace_mujoco-7.8.9.dist-info/entry_points.txt").decode()
    assert set(names).issuperset(NEEDED)
    tops = {name.split("/")[0] for name in names}
    assert tops == {*CODE, "pace_assets", "pace_mujoco-7.8.9.dist-info"}
    assert not [name for name in names if "__pycache__" in name]
    assert "pace = pace_optim.commands:main" in entry_points
    for file in ("LICENSE", "NOTICE"):
        assert [name for name in names if name.endswith(f".dist-info/licenses/{file}")]


@pytest.mark.slow
def test_every_asset_module_and_type_marker_is_inside(wheel):
    wanted = {f"pace_assets/{path}" for path in files_of(ROOT / "assets", "*") if "__pycache__" not in path}
    wanted |= {f"{package}/{path}" for package in CODE for path in files_of(ROOT / package, "*.py") | {"py.typed"}}
    missing = wanted - set(wheel.namelist())
    assert not missing, f"{sorted(missing)} left out: does each folder have an __init__.py?"


@pytest.mark.slow
def test_an_installed_wheel_finds_its_assets_without_the_checkout(wheel, tmp_path):
    wheel.extractall(tmp_path)  # a pure wheel, unpacked, is what an installation puts on the path
    code = "from pace_assets import ASSETS_DIR; print(ASSETS_DIR)"
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.stdout.strip() == str(tmp_path / "pace_assets"), done.stderr


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
