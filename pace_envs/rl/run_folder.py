"""A training's folder: settings, checkpoints."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from pace_actuators.files import checked, read_json, write_json
from pace_envs.task_source import EnvironmentRecord

SETTINGS_FILE = "settings.json"
_CURE = "Train anew, or put it back."
IDENTIFIED_FILE = "identified.json"
"""Copy of the fit's result that a training took its drives from."""


@dataclass(kw_only=True)
class RunSettings:
    """The settings of a training: enough to go on with it and to play its policies."""

    task: str
    """Registered environment."""

    num_envs: int | None = None
    """Number of environments; ``None`` means the task's."""

    max_iterations: int | None = None
    """Iterations in all; ``None`` means the task's."""

    seed: int = 42
    """Seed of the environment and of the networks."""

    reward: str | None = None
    """Name of the task's reward set; ``None``: the task's own."""

    randomize: bool = False
    """Whether friction and mass are randomised and the robot is pushed."""

    identified: str | None = None
    """``result.json`` of the fit that identified the drives, or its run's folder; ``None`` keeps the task's drives."""

    randomize_identified: float | None = None
    """Draw each robot's drives with this many standard deviations around the identified ones; ``None`` does not."""

    physics_dt: float | None = None
    """Time step of physics and drives [s]; ``None`` means the identification's, or the task's."""

    start_from: str | None = None
    """Checkpoint, or a run's folder for its last one, that the training goes on from, in a new folder; its
    iterations count. ``None`` starts with new networks."""

    device: str = "cpu"
    """Where it is trained: ``cpu``, or a GPU as ``cuda:0``."""

    log_dir: str = "logs/rsl_rl"
    """Where runs are kept."""

    def write(self, folder: Path, environment: Mapping[str, Any]) -> None:
        """Write ``settings.json``, whole or not at all.

        Args:
            environment: Where the task comes from (:class:`pace_envs.task_source.EnvironmentRecord`).
        """
        write_json(folder / SETTINGS_FILE, {"version": 1, **asdict(self), "environment": dict(environment)})

    @classmethod
    def read(cls, folder: Path, task: str | None = None) -> RunSettings:
        """Read ``settings.json`` and make its task known.

        Args:
            task: Another task instead of the run's.
        """
        path = folder / SETTINGS_FILE
        if not path.is_file():
            raise ValueError(f"{folder} holds no {SETTINGS_FILE}: it is not the folder of a training.")
        content = checked(cls, read_json(path, _CURE), path, _CURE)
        record = EnvironmentRecord.read(read_json(path, _CURE).get("environment"), content.task, path, _CURE)
        content.task = record.use(str(path), task)
        if content.identified is not None and (folder / IDENTIFIED_FILE).is_file():
            content.identified = str(folder / IDENTIFIED_FILE)
        return content


def new_run_folder(log_dir: str | Path, experiment: str) -> Path:
    """Create ``<log_dir>/<experiment>/<YY_MM_DD_HH-MM-SS>``; a number is added where that exists.

    Args:
        experiment: A name, or a task: of ``my_module:My-Walk-v0`` the name.
    """
    name = re.sub(r"[^\w.-]+", "_", experiment.rpartition(":")[2])
    base = Path(log_dir) / name / datetime.now().strftime("%y_%m_%d_%H-%M-%S")
    for number in range(1, 1000):
        folder = base if number == 1 else base.with_name(f"{base.name}_{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise OSError(f"{base} exists, and so do 999 more like it.")


def find_checkpoint(path: str | Path) -> Path:
    """A checkpoint, or the last one of a run's folder."""
    path = Path(path)
    if path.is_dir():
        return latest_checkpoint(path)
    if not path.is_file():
        raise ValueError(f"The checkpoint {path} does not exist.")
    return path


def latest_checkpoint(folder: Path) -> Path:
    """The checkpoint of the last iteration."""
    found = {int(m[1]): p for p in folder.glob("model_*.pt") if (m := re.fullmatch(r"model_(\d+)\.pt", p.name))}
    if not found:
        raise ValueError(
            f"{folder} holds no checkpoint: expected model_0.pt, with which a training begins, or a later "
            "model_<iteration>.pt. Put one back, or train anew."
        )
    return found[max(found)]
