"""Other simulators for tests, fetched once with pip into ``.cache/``; where they cannot be, tests skip and say why."""

from __future__ import annotations

import functools
import os
import site
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock
from places import ROOT, SUPPORT

CACHE = Path(os.environ.get("PACE_TEST_CACHE", ROOT / ".cache"))
ISAACLAB = ("2.3.0", "3.0.0")
OTHERS = (
    "mjlab==1.6.0",
    "mujoco==3.11.0",
    "mujoco-warp==3.11.0",
    "warp-lang==1.19.0",
    "newton==1.8.0",
    "newton-usd-schemas==0.6.0",
    "usd-core==26.11",
    "lazy-loader",
    # what these import and our own environment does not have; the rest (torch, rsl-rl, ...) is shared with ours
    "absl-py",
    "docstring_parser",
    "etils",
    "fsspec",
    "glfw",
    "imageio-ffmpeg",
    "importlib_resources",
    "ipython",
    "mediapy",
    "mjviser",
    "msgspec",
    "numpy",
    "prettytable",
    "pyopengl",
    "rich",
    "traitlets",
    "trimesh",
    "typeguard",
    "typing_extensions",
    "tyro",
    "viser",
    "zipp",
    "zstandard",
)


def one_at_a_time(fetch: Callable[..., Path]) -> Callable[..., Path]:
    """Let only one of the processes that run tests fetch; the others wait and find it done."""

    @functools.wraps(fetch)
    def alone(*args: str) -> Path:
        CACHE.mkdir(exist_ok=True)
        with FileLock(CACHE / "lock"):
            return fetch(*args)

    return alone


@one_at_a_time
def isaaclab_wheel(version: str = ISAACLAB[0]) -> Path:
    """Isaac Lab's wheel (3 MB; 3.0: 11 MB), unpacked."""
    folder = CACHE / f"isaaclab=={version}"
    if not (folder / "isaaclab").is_dir():
        wheels = CACHE / "wheels"
        command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", wheels, f"isaaclab=={version}"]
        newer = version.startswith("3.")  # it names a newer Python than our oldest; its actuators run on that too
        _pip("Isaac Lab's wheel", [*command, *(["--python-version", "3.12", "--only-binary=:all:"] if newer else [])])
        wheel = next(wheels.glob(f"isaaclab-{version}-*.whl"))
        part = folder.with_suffix(".part")
        with zipfile.ZipFile(wheel) as content:
            content.extractall(part)
        part.rename(folder)
    return folder


@one_at_a_time
def others_python() -> Path:
    """Python of an environment with mjlab and its MuJoCo 3.11, Warp and Newton (0.9 GB); torch is ours."""
    folder = CACHE / "others-1"
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    done = folder / ".installed"
    if not done.is_file():
        made = subprocess.run([sys.executable, "-m", "venv", "--clear", folder], capture_output=True, text=True)
        if made.returncode:
            pytest.skip(f"no virtual environment for mjlab and Newton: {made.stderr.strip()[-200:]}")
        _pip("mjlab or Newton", [python, "-m", "pip", "install", "-q", "--no-deps", *OTHERS])
        own = next(folder.rglob("site-packages"))
        (own / "zz_ours.pth").write_text("\n".join(site.getsitepackages()) + "\n")
        done.touch()
    return python


def run(python: str | Path, script: str, *args: str | Path) -> None:
    """Run one of the scripts beside this file with this checkout's packages."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MJLAB_WARP_QUIET": "1"}
    command = [str(python), str(SUPPORT / script), *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=280)
    assert done.returncode == 0, f"{script}:\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


def _pip(what: str, command: list[object]) -> None:
    try:
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=240)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{what} is not here, and pip did not fetch it within 240 s.")
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        pytest.skip(f"{what} is not here, and pip cannot fetch it: {last}")
