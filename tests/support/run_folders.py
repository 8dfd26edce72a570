"""Synthetic run folders, small and quick, for the tests of what reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from pace_actuators.files import write_json, write_tensors
from pace_optim.run.history import History
from pace_optim.run.result import FitResult

JOINTS = ("hip", "knee", "ankle")
UNITS = {
    "armature": "kg m^2",
    "viscous_friction": "N m s/rad",
    "friction": "N m",
    "encoder_bias": "rad",
    "delay": "control steps",
}
BOUNDS = {
    "armature": (1e-5, 1.0),
    "viscous_friction": (0.0, 7.0),
    "friction": (0.0, 0.5),
    "encoder_bias": (-0.1, 0.1),
    "delay": (0.0, 10.0),
}
LABELS = tuple(f"{name}/{joint}" for name in UNITS if name != "delay" for joint in JOINTS) + ("delay/all",)
VALUES = {"armature": 0.1, "viscous_friction": 4.5, "friction": 0.05, "encoder_bias": 0.03, "delay": 5.0}
AT_BOUND = "friction/ankle"


def make_result(**changes: Any) -> FitResult:
    """A plausible result, of other joints if they are named; the last one's friction is at its bound."""
    joints = tuple(changes.get("joint_names", JOINTS))
    keys = {name: ("all",) if name == "delay" else joints for name in UNITS}
    values = {name: {key: VALUES[name] * (1 + 0.1 * i) for i, key in enumerate(keys[name])} for name in UNITS}
    values["friction"][joints[-1]] = 0.5
    std: dict[str, dict[str, float | None]] = {
        name: {key: 0.02 * value for key, value in entries.items()} for name, entries in values.items()
    }
    std["friction"][joints[-1]] = None
    labels = [f"{name}/{key}" for name, each in keys.items() for key in each]
    at_bound = f"friction/{joints[-1]}"
    unknown = labels.index(at_bound)
    matrix = [
        [None if unknown in (i, j) else 1.0 if i == j else round(0.9 / (1 + abs(i - j)), 6) for j in range(len(labels))]
        for i in range(len(labels))
    ]
    errors = dict(zip(joints, np.linspace(0.002, 0.004, len(joints)).tolist(), strict=True))
    content: dict[str, Any] = {
        "task": "Pace-Leg-v0",
        "robot_name": "leg",
        "joint_names": list(joints),
        "effects": [],
        "delay_mode": "command",
        "physics_dt": 0.0025,
        "control_dt": 0.0025,
        "parameters": values,
        "delay_s": values["delay"]["all"] * 0.0025,
        "std": std,
        "units": UNITS,
        "at_bound": [at_bound],
        "no_influence": [],
        "indistinguishable": [[f"friction/{joints[0]}", f"encoder_bias/{joints[0]}"]],
        "correlation": {"labels": labels, "matrix": matrix},
        "score": 3e-5,
        "rmse": {
            "train": {**errors, "all": 0.0031},
            "validation": {
                **{joint: 1.25 * error for joint, error in errors.items()},
                joints[-1]: 0.0061,
                "all": 0.0043,
            },
        },
        "recordings": {"train": ["chirp (first 70 %)"], "validation": ["chirp (last 30 %)", "steps"]},
        "optimizer": "hybrid",
        "seed": 0,
        "generations": 30,
        "simulated_steps": 9_600_000,
        "wall_time_s": 21.5,
        "stop_reasons": ["score below 1e-16"],
        "warnings": [],
        "notes": ["chirp: resampled from 500 Hz."],
    }
    return FitResult(**(content | changes))


def make_history(generations: int = 30, iterations: int = 8) -> History:
    """Scores that fall, first by search and then by refinement."""
    g, i = range(generations), range(iterations)
    return History(
        search_best=[0.3 * 0.85**k for k in g],
        search_mean=[0.8 * 0.87**k for k in g],
        search_steps=[400_000 * (k + 1) for k in g],
        search_time_s=[0.8 * (k + 1) for k in g],
        refine_best=[max(3e-5, 2e-3 * 0.3**k) for k in i],
        refine_steps=[400_000 * generations + 90_000 * (k + 1) for k in i],
        refine_time_s=[0.8 * generations + 0.2 * (k + 1) for k in i],
    )


def make_trajectory(samples: int = 800) -> dict[str, Any]:
    """Two recordings: the last part of the first and all of the second are kept for validation."""
    recordings = []
    for name, count in (("chirp", samples), ("steps", samples // 2)):
        time = torch.arange(count, dtype=torch.float64) * 0.005
        phase = time[:, None] * torch.tensor([2.0, 3.0, 5.0], dtype=torch.float64)
        target = 0.5 * torch.sin(phase)
        measured = 0.45 * torch.sin(phase - 0.1)
        recordings.append(
            {
                "name": name,
                "time": time,
                "des_dof_pos": target if name == "chirp" else target.sign() * 0.3,
                "dof_pos": measured,
                "sim_dof_pos": measured + 0.003 * torch.cos(2 * phase),
                "train": (time < 0.7 * time[-1]) if name == "chirp" else torch.zeros(count, dtype=torch.bool),
            }
        )
    return {"joint_names": list(JOINTS), "recordings": recordings}


def write_run(folder: Path, result: FitResult | None = None, **changes: Any) -> Path:
    """A run's folder with everything that is written in the end; ``changes`` are settings."""
    folder.mkdir(parents=True, exist_ok=True)
    (result or make_result()).save(folder / "result.json")
    write_json(folder / "history.json", make_history().to_dict())
    settings = {"task": "Pace-Leg-v0", "data": [], "validation": [], "num_envs": 512, "optimizer": "hybrid", "seed": 0}
    write_json(folder / "settings.json", {"settings": settings | changes, "digests": {}})
    write_tensors(folder / "best_trajectory.pt", make_trajectory())
    bounds = [BOUNDS[label.split("/")[0]] for label in LABELS]
    n = len(JOINTS)
    config = {
        "task": "Pace-Leg-v0",
        "joint_order": list(JOINTS),
        "bounds_params": torch.tensor(bounds, dtype=torch.float64),
        "parameters": list(LABELS),
        "slices": {name: [i * n, (i + 1) * n] for i, name in enumerate(UNITS)} | {"delay": [4 * n, 4 * n + 1]},
        "delay_mode": "command",
        "control_dt": 0.0025,
        "physics_dt": 0.0025,
    }
    write_tensors(folder / "config.pt", config)
    return folder
