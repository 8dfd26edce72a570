"""Do 95 % intervals hold the truth in 95 % of cases? The reference recording with noise and quantisation, many seeds.

python benchmarks/error_bars.py --seeds 20
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
import torch

from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.least_squares import least_squares
from pace_optim.problem.problem import Problem, load_problem
from pace_optim.recording.dataset import make_dataset


def one_seed(problem: Problem, seed: int, noise: float, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors and standard deviations of all parameters, physical (size,)."""
    recording = problem.dataset.recordings[0]
    generator = np.random.default_rng(seed)
    lattice = 2 * np.pi / 2**bits
    noisy = recording.dof_pos + noise * generator.standard_normal(recording.dof_pos.shape)
    measured = dataclasses.replace(recording, dof_pos=np.round(noisy / lattice) * lattice, dof_vel=None)
    seeded = dataclasses.replace(problem, dataset=make_dataset([measured]))
    evaluator = seeded.evaluator()
    truth = seeded.space.from_dict(seeded.env_cfg.sim2real.sample_params)
    # every start ends in the same minimum; this one saves iterations
    best = least_squares(evaluator, [seeded.space.to_normalised(truth)])[0]
    uncertainty = assess(seeded, evaluator, best.x).uncertainty
    return (seeded.space.to_physical(best.x) - truth).numpy(), uncertainty.std


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Pace-AnymalD-v0")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--noise", type=float, default=1e-4, help="standard deviation [rad]")
    parser.add_argument("--encoder_bits", type=int, default=16, help="bits per turn")
    parser.add_argument("--output", type=Path, help="JSON file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    problem = load_problem(args.task)
    errors, stds = [], []
    for seed in range(args.seeds):
        error, std = one_seed(problem, seed, args.noise, args.encoder_bits)
        errors.append(error)
        stds.append(std)
        known = ~np.isnan(std)
        print(f"seed {seed}: {np.mean(np.abs(error[known]) < 1.96 * std[known]):.3f} inside, {(~known).sum()} at bound")
    error_table, std_table = np.array(errors), np.array(stds)
    known = ~np.isnan(std_table)
    inside = np.abs(error_table) < 1.96 * std_table
    names = np.array([label.split("/")[0] for label in problem.space.labels])
    rows = {name: float(inside[:, names == name][known[:, names == name]].mean()) for name in dict.fromkeys(names)}
    for name, share in rows.items():
        print(f"{name:18s} {share:.3f}")
    print(f"{'all':18s} {inside[known].mean():.3f} of {known.sum()} parameter x seed cases inside the 95 % interval")
    if args.output:
        args.output.write_text(json.dumps({"inside": rows, "all": float(inside[known].mean())}, indent=1))


if __name__ == "__main__":
    main()
