"""A small robot that trots in plain MuJoCo, as a problem."""

from pathlib import Path

import numpy as np
import torch
from walking_plant import Plant, crawler

from pace_envs import load_env_cfg
from pace_optim.problem.problem import load_problem

torch.set_num_threads(1)
DT = 0.0025


def write_log(folder: Path, plant: Plant, duration: float, **changes) -> Path:
    """The plant's log and its model file, ``robot.xml`` beside it."""
    (folder / "robot.xml").write_text(plant.xml)
    fields = {**plant.simulate(duration), **changes}
    path = folder / "walk.npz"
    np.savez(path, **{key: value for key, value in fields.items() if value is not None})
    return path


def walking_problem(folder: Path, plant: Plant | None = None, duration: float = 2.0, **changes):
    """The plant's log as a problem, and the truth as a physical vector."""
    plant = plant or crawler(1)
    log = write_log(folder, plant, duration, **changes)
    task = str(folder / "robot.xml")
    cfg = load_env_cfg(task, DT)
    cfg.sim.num_threads = 1
    problem = load_problem(task, data=[log], env_cfg=cfg, drive_dt=DT, physics_dt=DT / 2, tell=lambda _: None)
    values = {name: dict(zip(plant.joints, each.tolist(), strict=True)) for name, each in plant.truth.items()}
    values |= {"encoder_bias": dict.fromkeys(plant.joints, 0.0), "delay": {"all": float(plant.delay)}}
    return problem, problem.space.from_dict(values)
