"""Clean recordings of a drive that saturates: does a diagnosis name an effect? A pendulum of plain MuJoCo.

python benchmarks/saturating.py --recordings 20

The targets jump, and the drive is at its stated limit for a good part of the time. Each recording draws the drive, the
limit and the jumps anew; the plant is that of ``coverage.py``. `pace fit --diagnose` is what a user types.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from coverage import DURATION, KP, LOG_DT, drawn, noisy, simulate, write_inputs

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
LIMITS = (8.0, 16.0)
"""Range of the torque limit [N m]."""
JUMP = 0.9
"""Largest target [rad]."""


def jumps(rng: np.random.Generator, count: int) -> np.ndarray:
    """Targets that jump every 0.15 to 0.5 s, (count,) [rad]."""
    lengths = rng.integers(round(0.15 / LOG_DT), round(0.5 / LOG_DT), count)
    return np.repeat(rng.uniform(-JUMP, JUMP, count), lengths)[:count]


def one(seed: int, folder: Path) -> dict:
    """What was said of a recording."""
    rng = np.random.default_rng(seed)
    drive, limit, command = drawn(rng), rng.uniform(*LIMITS), jumps(rng, round(2 * DURATION / LOG_DT) + 1)
    seen = simulate(drive, command, limit)
    write_inputs(folder, noisy(seen, "white", rng), command, limit)
    argv = ("--task", folder / "pendulum.xml", "--data", folder / "log.npz", "--diagnose", "--log_dir", folder / "logs")
    done = subprocess.run([sys.executable, SCRIPTS / "fit.py", *map(str, argv)], capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"seed {seed}: {done.stderr[-600:]}")
    result = json.loads(next((folder / "logs").rglob("result.json")).read_text())
    diagnosis = json.loads(next((folder / "logs").rglob("diagnosis.json")).read_text())
    return {
        "seed": seed,
        "saturated": float(np.mean(np.abs(KP * (command - seen)) > limit)),
        "mrad": 1e3 * result["rmse"]["train"]["all"],
        "verdict": diagnosis["verdict"],
        "added": diagnosis["added"],
        "off": {
            name: result["parameters"][name]["joint"] / drive[name] - 1
            for name in ("armature", "viscous_friction", "friction")
        },
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=20)
    parser.add_argument("--first_seed", type=int, default=0)
    args = parser.parse_args()
    named = 0
    for seed in range(args.first_seed, args.first_seed + args.recordings):
        with tempfile.TemporaryDirectory() as place:
            said = one(seed, Path(place))
        named += bool(said["added"])
        off = ", ".join(f"{name} {share:+.1%}" for name, share in said["off"].items())
        print(
            f"{seed}: at the limit {said['saturated']:.0%}, {said['mrad']:.3g} mrad, {off}; "
            f"{said['verdict']} {' '.join(said['added'])}",
            flush=True,
        )
    print(f"{named} of {args.recordings} with a named effect")


if __name__ == "__main__":
    main()
