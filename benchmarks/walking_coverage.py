"""How often the error bars of walks cover the truth: logs of a robot that trots in plain MuJoCo, each of another robot.

Each log has drawn drives, a drawn gait and its own noise. Gauss-Newton steps lead from the truth to the bottom of the
error, where error bars are taken as a fit takes them: noise, and the physics step. Printed is z, the distance from the
truth in error bars.

    python benchmarks/walking_coverage.py --logs 12
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from walking_plant import CONTROL, crawler, drawn, gait

from pace_envs import load_env_cfg
from pace_optim.estimate.derivatives import stencil
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.physics_step import change_without_step, step_share
from pace_optim.problem.problem import Problem, load_problem

COVERED = 2.0
"""Error bars within which the truth is expected in 95 % of the cases."""
PARAMETERS = ("armature", "viscous_friction", "friction", "encoder_bias", "delay")
_STEPS = 3
"""Of Gauss-Newton."""
_FIRST = 1e-3
"""Normalised step of the derivatives."""


def walk(folder: Path, seed: int, duration: float, late: float = 0.0) -> tuple[Problem, torch.Tensor]:
    """A log as a problem, and its truth as a physical vector.

    Args:
        folder: Where its files go.
        seed: Of drives, gait and noise.
        duration: [s].
        late: How late the IMU is against the encoders [s].
    """
    plant = crawler(seed, truth=drawn(8, 100 + seed, 0.2), targets=gait(seed))
    log, model, path = plant.simulate(duration), folder / f"{seed}.xml", folder / f"{seed}.npz"
    for key in ("base_ang_vel", "base_lin_acc"):
        log[key] = np.stack([np.interp(log["time"] - late, log["time"], column) for column in log[key].T], axis=1)
    model.write_text(plant.xml)
    np.savez(path, **log)
    cfg = load_env_cfg(str(model), CONTROL)
    problem = load_problem(
        str(model), data=[path], env_cfg=cfg, drive_dt=CONTROL, physics_dt=CONTROL / 4, tell=lambda _: None
    )
    values = {name: dict(zip(plant.joints, each.tolist(), strict=True)) for name, each in plant.truth.items()}
    values |= {"encoder_bias": dict.fromkeys(plant.joints, 0.0), "delay": {"all": float(plant.delay)}}
    return problem, problem.space.from_dict(values)


def distances(problem: Problem, truth: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the values, physical, and their error bars, (size,) each."""
    space, evaluator = problem.space, problem.training_evaluator()
    colouring = problem.colouring
    x = space.to_normalised(truth)
    for _ in range(_STEPS):
        evaluator.look_at_phases(space.to_physical(x), anew=True)
        around = stencil(x, colouring, first=_FIRST)
        residuals = evaluator.residuals(space.to_physical(torch.cat([x[None], around.vectors])))
        hessian, gradient = around.jacobian(residuals).normal_equations()
        scale = hessian.diagonal().clamp(min=1e-30).sqrt()
        whole = torch.linalg.pinv(hessian / scale[:, None] / scale, rtol=1e-7, hermitian=True)
        x = (x - whole @ (gradient / scale) / scale).clamp(-1.0, 1.0)
    there = assess(problem, problem.evaluator(), x)
    physical, bars = space.to_physical(x), there.uncertainty
    change = change_without_step(problem, physical, there.jacobian.residuals, there.phases)
    if change is not None:
        known = ~np.isnan(bars.std)
        share = step_share(there.jacobian, change, space, x, known)
        bars = bars.with_step(np.where(known, share, np.nan))
    return (physical - truth).numpy(), bars.std


def main() -> None:
    """Print z of each log and how often it is at most 2."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=12)
    parser.add_argument("--first_seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=4.0, help="of each log [s]")
    parser.add_argument("--late", type=float, default=0.0, help="how late the IMU is [s]")
    args = parser.parse_args()
    every = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(args.first_seed, args.first_seed + args.logs):
            problem, truth = walk(Path(folder), seed, args.duration, args.late)
            error, std = distances(problem, truth)
            z = error / std
            every.append(z)
            worst = problem.space.labels[int(np.nanargmax(np.abs(z)))]
            print(f"log {seed}: {_said(z)}, largest {np.nanmax(np.abs(z)):.1f} ({worst})", flush=True)
    columns = np.array(every)
    for name in PARAMETERS:
        print(f"{name}: {_said(columns[:, problem.space[name]])}")
    print(f"all: {_said(columns)}")


def _said(z: np.ndarray) -> str:
    known = z[np.isfinite(z)]
    covered = 100 * float((np.abs(known) <= COVERED).mean())
    return f"{covered:.0f} % of {len(known)} within {COVERED:g}, RMS {np.sqrt(np.square(known).mean()):.2f}"


if __name__ == "__main__":
    main()
