"""The built wheel holds the three packages, their type markers, and the assets."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from places import ROOT

pytestmark = pytest.mark.slow

CODE = ("pace_actuators", "pace_envs", "pace_optim")


def built_from(folder: Path, pattern: str) -> set[str]:
    """The files under a folder that belong in a wheel, as paths from the folder."""
    files = (p for p in folder.rglob(pattern) if p.is_file() and "__pycache__" not in p.parts)
    return {p.relative_to(folder).as_posix() for p in files}


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A copy of what a wheel is built from, since building leaves files beside it and reuses stale ones."""
    copy = tmp_path_factory.mktemp("source")
    for folder in (*CODE, "assets"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in (p for p in ROOT.iterdir() if p.is_file()):
        shutil.copy(file, copy)
    return copy


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        str(source),
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    done = subprocess.run([*command, "--wheel-dir", str(out)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(out.glob("pace_mujoco-*.whl"))


@pytest.fixture(scope="module")
def names(wheel) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_every_asset_is_inside(source, names):
    assert {f"pace_assets/{p}" for p in built_from(source / "assets", "*")} <= names


@pytest.mark.parametrize("package", CODE)
def test_every_module_and_the_type_marker_are_inside(package, source, names):
    modules = built_from(source / package, "*.py") | {"py.typed"}
    missing = {f"{package}/{p}" for p in modules} - names
    assert not missing, f"{sorted(missing)} left out: does each folder have an __init__.py?"


def test_nothing_else_is_inside(names):
    tops = {name.split("/")[0] for name in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {*CODE, "pace_assets"}
    assert not [name for name in names if "__pycache__" in name]


def test_licence_and_notice_travel_with_it(names):
    for file in ("LICENSE", "NOTICE"):
        assert [n for n in names if n.endswith(f".dist-info/licenses/{file}")]


def test_an_installed_wheel_finds_its_assets_without_the_checkout(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)  # a pure wheel, unpacked, is what an installation puts on the path
    code = "from pace_assets import ASSETS_DIR; print(ASSETS_DIR)"
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.stdout.strip() == str(tmp_path / "pace_assets"), done.stderr
