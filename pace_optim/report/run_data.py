"""The files of a run, read once for all sections of its report."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pace_actuators.files import read_json, refuse
from pace_envs.mujoco_warnings import collected
from pace_envs.task_source import file_digest
from pace_optim.run.history import History
from pace_optim.run.result import FitResult
from pace_optim.run.tensors import RecordingData, read_bounds, read_trajectory

_CURE = "Remove it or make it anew: fit, compare or diagnose again."


@dataclass(frozen=True, kw_only=True, eq=False)
class RunData:
    """What a report can say; parts that a run does not have are ``None`` or empty."""

    folder: Path
    result: FitResult
    history: History | None
    joint_names: tuple[str, ...]
    recordings: tuple[RecordingData, ...]
    bounds: dict[str, tuple[float, float]]
    """Lower and upper bound by label ``<parameter>/<joint>``, physical."""
    settings: dict[str, Any]
    model_digest: str | None
    """SHA-256 of ``model.mjb`` as the fit wrote it; ``None`` in runs of earlier versions."""
    model_file: Path | None
    """The robot's model file, if it is what it was for the fit."""
    new: Mapping[str, Any]
    """Content of JSON files that are about to be written, by name."""

    @classmethod
    def load(cls, folder: Path, new: Mapping[str, Any] | None = None) -> RunData:
        """Read a run's folder.

        Args:
            new: Content of JSON files that are about to be written, by name, instead of the present one.
        """
        result = FitResult.load(folder)
        trajectory = read_trajectory(folder) if os.path.lexists(folder / "best_trajectory.pt") else None
        names = tuple(result.joint_names)
        if trajectory is not None and trajectory.joint_names != names:
            refuse(folder / "best_trajectory.pt", "joint_names are not those of result.json", _CURE)
        settings = _read_json(folder / "settings.json") or {}
        if not isinstance(settings, dict) or not isinstance(settings.get("settings", {}), dict):
            refuse(folder / "settings.json", "settings is no object with keys", _CURE)
        return cls(
            folder=folder,
            result=result,
            history=History.load(folder / "history.json") if os.path.lexists(folder / "history.json") else None,
            joint_names=names,
            recordings=() if trajectory is None else trajectory.recordings,
            bounds=read_bounds(folder),
            settings=settings.get("settings", {}),
            model_digest=settings.get("model"),
            model_file=_model_file(settings),
            new=new or {},
        )

    def read_model(self) -> mujoco.MjModel | None:
        """The compiled model that the run was made with, ``None`` if the folder does not hold it."""
        path = self.folder / "model.mjb"
        if not path.is_file():
            return None
        if self.model_digest not in (None, file_digest(path)):  # MuJoCo's reader checks less than it would have to
            refuse(path, f"is not the model that {self.folder / 'settings.json'} has", "Remove it, or fit again.")
        with collected() as said:
            try:
                return mujoco.MjModel.from_binary_path(str(path))
            except ValueError as error:
                why = said[0] if said else str(error)
                raise ValueError(f"{path} is damaged, or of another version of MuJoCo ({why}). Remove it.") from error

    def model(self) -> mujoco.MjModel:
        """The compiled model that the run was made with."""
        model = self.read_model()
        if model is None:
            raise ValueError(f"{self.folder} holds no compiled model to draw; an older version made it. Fit again.")
        return model

    def worst(self, count: int) -> list[RecordingData]:
        """At most so many recordings, those with the largest error, in their order."""
        by_error = sorted(self.recordings, key=lambda each: -float(np.nan_to_num(each.error).std()))
        return [each for each in self.recordings if each in by_error[:count]]

    @contextlib.contextmanager
    def blaming(self, name: str | None) -> Iterator[None]:
        """Report what fails in the block as damage of a file; ``None``: of no file."""
        try:
            yield
        except (LookupError, TypeError, AttributeError, ArithmeticError, ValueError) as error:
            if name is None or str(self.folder) in str(error):
                raise
            what = f"no {error}" if isinstance(error, KeyError) else str(error)
            raise ValueError(f"{self.folder / name} is damaged ({what}). Remove it, or make it anew.") from error

    def read_json(self, name: str) -> Any | None:
        """Another file of the folder, ``None`` if it is not there; for sections about later steps."""
        return self.new[name] if name in self.new else _read_json(self.folder / name)


def _model_file(settings: Mapping[str, Any]) -> Path | None:
    """The first of the files that the run's environment names, which the others belong to."""
    environment = settings.get("environment")
    files = environment.get("files") if isinstance(environment, dict) else None
    name, digest = next(iter(files.items()), ("", "")) if isinstance(files, dict) else ("", "")
    return Path(name) if name and Path(name).is_file() and file_digest(name) == digest else None


def _read_json(path: Path) -> Any | None:
    return read_json(path, _CURE) if os.path.lexists(path) else None
