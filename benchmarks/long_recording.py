"""A fit of ten minutes at 1 kHz of 30 joints: when it says something, when it ends, and the memory that it takes.

    python benchmarks/long_recording.py --optimizer least_squares

Five limbs of six joints; the last two of a multisine's four periods are repeated, as much to read and to choose
from.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

ROOT = Path(__file__).parents[1]
LIMBS, JOINTS, SECONDS, RATE, MOTION = 5, 6, 600, 1000, 40


def write_robot(path: Path) -> None:
    """A robot whose limbs hang from a fixed base."""
    bodies, drives = [], []
    for limb in range(LIMBS):
        text = ""
        for j in reversed(range(JOINTS)):
            name, axis = f"limb{limb}_{j}", ("0 1 0", "1 0 0", "0 0 1")[j % 3]
            place = f"0 {0.3 * limb} 1" if j == 0 else "0 0.05 -0.15"
            inertial = '<inertial pos="0 0.02 -0.08" mass="0.5" diaginertia="2e-3 2e-3 1e-3"/>'
            joint = f'<joint name="{name}" axis="{axis}" range="-2 2"/>'
            text = f'<body pos="{place}">{joint}{inertial}{text}</body>'
            drives.append(f'<position joint="{name}" kp="40" kv="2" forcerange="-20 20"/>')
        bodies.append(text)
    path.write_text(
        '<mujoco model="limbs"><compiler angle="radian"/>'
        f"<worldbody>{''.join(bodies)}</worldbody><actuator>{''.join(drives)}</actuator></mujoco>"
    )


def write_recording(folder: Path, suffix: str) -> Path:
    """The long recording, made of a short one."""
    short = folder / "short.npz"
    words = ("--task", "robot.xml", "--duration", str(MOTION), "--excitation", "multisine", "--max_frequency", "4")
    words = (*words, "--noise", "1e-4", "--no_plot", "--output", short.name, "--positions_only")
    subprocess.run([sys.executable, ROOT / "scripts/data_collection.py", *words], cwd=folder, check=True)
    with np.load(short) as archive:
        content = dict(archive)
    own = content["time"]
    grid = np.arange(MOTION / 2, MOTION, 1 / RATE)  # periodic: of the start nothing is left
    held = np.searchsorted(own, grid + 1e-6, side="right") - 1
    read = CubicSpline(own, content["dof_pos"])(grid)
    for key, once in {"dof_pos": read, "des_dof_pos": content["des_dof_pos"][held]}.items():
        content[key] = np.tile(once, (2 * SECONDS // MOTION, 1))
    content["time"] = np.arange(len(content["dof_pos"])) / RATE
    np.savez(folder / "long.npz", **content)
    if suffix == ".npz":
        return folder / "long.npz"
    from pace_optim.recording import load_recording, save_recording

    return save_recording(folder / f"long{suffix}", load_recording(folder / "long.npz"))


def main() -> int:
    """Make the recording, fit it, print each line with its time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--optimizer", default="hybrid")
    parser.add_argument("--suffix", default=".npz", choices=(".npz", ".csv", ".pt"))
    parser.add_argument("--folder", type=Path, help="keep the recording here (default: made anew)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        recording = folder / f"long{args.suffix}"
        if not recording.exists():
            write_robot(folder / "robot.xml")
            recording = write_recording(folder, args.suffix)
        print(f"{recording.name}: {recording.stat().st_size / 1e6:.0f} MB, load {os.getloadavg()[0]:.1f}", flush=True)
        words = ("--task", "robot.xml", "--data", recording.name, "--optimizer", args.optimizer)
        begin = time.monotonic()
        command = [sys.executable, ROOT / "scripts/fit.py", *words]
        done = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert done.stdout is not None
        for line in done.stdout:
            print(f"{time.monotonic() - begin:8.1f} s  {line}", end="", flush=True)
        status = done.wait()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"memory {used.ru_maxrss / 1e6:.2f} GB at most, processor {used.ru_utime + used.ru_stime:.0f} s")
    return status


if __name__ == "__main__":
    sys.exit(main())
