"""Draw what each effect leaves in the data: ``python docs/site/effect_pictures.py [NAME ...]``.

The independent plant records a drive that has the effect, the base parameters are fitted to it, and the error that is
left is drawn over time, speed and position, in the recording and stretch where it is largest. Needs some minutes.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image

from pace_actuators.effects import available_effects, get_effect
from pace_optim.data_collection.plant import EFFECTS, Case, write_case
from pace_optim.identification.fit import fit
from pace_optim.recording import load_recording, save_recording
from pace_optim.run.settings import FitSettings

PICTURES = Path(__file__).parents[1] / "images" / "effects"
SEED = 5
LENGTH_S = 5.0
STRETCH_S = 3.0
INK, BLUE, ORANGE = "#3b4046", "#2563a8", "#d9730d"


def draw(name: str, folder: Path) -> Path:
    """Record, fit the base model, draw."""
    files = write_case(Case(effects=(name,), seed=SEED), folder / name)
    settings = FitSettings(
        task="Pace-TestBench-v0",
        data=[str(shortened(path)) for path in files.train],
        validation=[str(shortened(path)) for path in files.validation[:1]],
        optimizer="least_squares",
        check_consistency=False,
        trust_log=True,  # it shows what a hidden effect leaves, not what the log is refused for
        log_dir=str(folder / "logs"),
    )
    _, run = fit(settings)
    recordings = torch.load(run / "best_trajectory.pt", weights_only=True)["recordings"]
    shown = max(recordings, key=lambda r: float((r["sim_dof_pos"] - r["dof_pos"]).square().mean()))
    time, measured = shown["time"].numpy(), shown["dof_pos"].numpy()[:, 0]
    error = 1e3 * (measured - shown["sim_dof_pos"].numpy()[:, 0])
    speed = np.gradient(measured, time)
    figure, axes = plt.subplots(1, 3, figsize=(11, 2.9), width_ratios=(2, 1, 1), layout="constrained")
    _over_time(axes[0], time, measured, error)
    _scatter(axes[1], speed, error, "speed [rad/s]")
    _scatter(axes[2], measured, error, "position [rad]")
    rms = np.sqrt(np.mean(error**2))
    text = f"{rms:.0f}" if rms >= 10 else f"{rms:.2g}"
    figure.suptitle(f"{name}: error of the base model, {text} mrad RMS", fontsize=10, color=INK)
    PICTURES.mkdir(parents=True, exist_ok=True)
    path = PICTURES / f"{name}.png"
    figure.savefig(path, dpi=80, metadata={"Software": None})
    plt.close(figure)
    with Image.open(path) as picture:  # 64 colours are enough, and half the size
        small = picture.convert("RGB").quantize(64)
    small.save(path, optimize=True)
    return path


def shortened(path: Path) -> Path:
    """The same recording, its first seconds alone."""
    recording = load_recording(path)
    kept = int(np.searchsorted(recording.time, LENGTH_S))
    series = {name: getattr(recording, name)[:kept] for name in ("time", "dof_pos", "des_dof_pos")}
    short = path.with_name(f"short_{path.name}")
    save_recording(short, replace(recording, **series))
    return short


def _over_time(axis: plt.Axes, time: np.ndarray, measured: np.ndarray, error: np.ndarray) -> None:
    """The stretch with the largest error, the motion behind it."""
    width = max(1, int(STRETCH_S / np.median(np.diff(time))))
    power = np.convolve(error**2, np.ones(min(width, len(error))), mode="valid")
    first = int(power.argmax())
    part = slice(first, first + width)
    axis.plot(time[part], error[part], color=ORANGE, lw=1)
    axis.set_xlabel("time [s]")
    axis.set_ylabel("measured − simulated [mrad]", color=ORANGE)
    behind = axis.twinx()
    behind.plot(time[part], measured[part], color=BLUE, lw=0.8, alpha=0.5)
    behind.set_ylabel("position [rad]", color=BLUE)


def _scatter(axis: plt.Axes, x: np.ndarray, error: np.ndarray, label: str) -> None:
    axis.plot(x[::3], error[::3], ".", ms=1, color=ORANGE, alpha=0.35)
    axis.set_xlabel(label)


def main(names: list[str]) -> None:
    """Draw these, or all that have none yet."""
    known = [n for n in available_effects() if n in EFFECTS and not get_effect(n).free_form]
    plt.rcParams.update({"font.size": 8, "axes.edgecolor": "#9aa0a6", "axes.spines.top": False})
    with tempfile.TemporaryDirectory() as folder:
        for name in names or [n for n in known if not (PICTURES / f"{n}.png").is_file()]:
            print(draw(name, Path(folder)), flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(sys.argv[1:])
