"""Record ANYmal D in simulation with known drives, identify them, and compare."""

import json
import sys
from pathlib import Path

import numpy as np
import torch

from pace_envs import load_env_cfg
from pace_optim.cli import make_parser, run_cli
from pace_optim.data_collection import CollectionCfg, collect
from pace_optim.fit import fit
from pace_optim.fit_result import FitResult
from pace_optim.fit_settings import FitSettings
from pace_optim.history import History
from pace_optim.plots import plot_scores, plot_trajectories

TASK = "Pace-AnymalD-v0"
RANGES = {
    "armature": (0.04, 0.12),
    "viscous_friction": (3.5, 5.5),
    "friction": (0.02, 0.10),
    "encoder_bias": (-0.05, 0.05),
}
DELAY = 4.3  # control steps
NOISE = 1e-4  # [rad]


def random_truth(joints: tuple[str, ...], seed: int) -> dict[str, float]:
    """A different drive at every joint."""
    rng = np.random.default_rng(seed)
    values = {f"{name}/{joint}": float(rng.uniform(*span)) for name, span in RANGES.items() for joint in joints}
    return values | {"delay": DELAY}


def comparison(result: FitResult, truth: dict[str, float]) -> str:
    """Found and true values side by side."""
    names = list(RANGES)
    heads = [f"{name.replace('_', ' ')} [{result.units[name]}]" for name in names]
    lines = ["joint  " + "".join(head.rjust(30) for head in heads), "       " + "found (true)".rjust(30) * len(names)]
    for joint in result.joint_names:
        cells = [f"{result.parameters[name][joint]:.4f} ({truth[f'{name}/{joint}']:.4f})" for name in names]
        lines.append(joint.ljust(7) + "".join(cell.rjust(30) for cell in cells))
    delay = result.parameters["delay"]["all"]
    lines.append(f"delay  {delay:.4f} ({DELAY:.4f}) control steps of {1e3 * result.control_dt:g} ms")
    return "\n".join(lines)


def verdict(result: FitResult, truth: dict[str, float]) -> str:
    """The largest error, and how many true values lie within their error bars."""
    bounds = load_env_cfg(TASK).sim2real.bounds_params
    n = len(result.joint_names)
    width = {name: float(bounds[i * n, 1] - bounds[i * n, 0]) for i, name in enumerate(RANGES)}
    width["delay"] = float(bounds[-1, 1] - bounds[-1, 0])
    errors, inside = {}, 0
    for label, true_value in truth.items():
        name, _, joint = label.partition("/")
        key = joint or "all"
        error = abs(result.parameters[name][key] - true_value)
        errors[label] = error / width[name]
        std = result.std[name][key]
        inside += std is not None and error <= 1.96 * std
    worst = max(errors, key=lambda label: errors[label])
    return (
        f"Largest error: {100 * errors[worst]:.3g} % of its bound range ({worst}). "
        f"True values inside their 95 % interval: {inside} of {len(truth)}."
    )


def draw(run: Path) -> list[Path]:
    """Measured, simulated and target of every joint, and the score over the iterations, as PNG."""
    figures = plot_trajectories(torch.load(run / "best_trajectory.pt", weights_only=True), title="ANYmal D")
    figures["score"] = plot_scores(History(**json.loads((run / "history.json").read_text())), title="ANYmal D")
    paths = [run / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path, dpi=100)
    return paths


def main() -> None:
    parser = make_parser(__doc__, example="scripts/demo.py --seed 1")
    parser.add_argument("--seed", type=int, default=0, help="of the true parameters, the noise and the search")
    parser.add_argument("--duration", type=float, default=20.0, metavar="S", help="of the recording (default 20)")
    parser.add_argument("--log_dir", type=Path, default=Path("logs/demo"), help="where all goes (default logs/demo)")
    args = parser.parse_args()
    torch.set_num_threads(1)  # the physics takes the cores; the tensors are small

    truth = random_truth(load_env_cfg(TASK).sim2real.joint_order, args.seed)
    print(f"1. Record: ANYmal D in the air follows a chirp for {args.duration:g} s in simulation,")
    print(f"   49 parameters drawn at random, encoder noise {1e3 * NOISE:g} mrad.", flush=True)
    collection = collect(
        CollectionCfg(
            task=TASK,
            duration=args.duration,
            seed=args.seed,
            parameters=truth,
            noise=NOISE,
            output=args.log_dir / "recording.npz",
        )
    )
    print(f"2. Identify them from {collection.recordings[0]} (search, then refine).", flush=True)
    result, run = fit(
        FitSettings(task=TASK, data=[str(collection.recordings[0])], seed=args.seed, log_dir=str(args.log_dir))
    )
    print("3. Compare with the truth.\n")
    print(comparison(result, truth))
    print()
    print(verdict(result, truth))
    print(
        f"Error on what was fitted: {1e3 * result.rmse['train']['all']:.3f} mrad, on the last 30 % that was held out: "
        f"{1e3 * result.rmse['validation']['all']:.3f} mrad."
    )
    print(f"{result.simulated_steps / 1e6:.1f} M simulated steps in {result.wall_time_s:.0f} s.\n")
    for plot in (*collection.plots, *draw(run)):
        print(f"plot:   {plot}")
    print(f"report: {run / 'report.html'}")
    print(f"run:    {run}")


if __name__ == "__main__":
    sys.exit(run_cli(main))
