"""The files of a run, read once for all sections of its report."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pace_optim.run.history import History
from pace_optim.run.result import FitResult


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingData:
    """One recording as the result simulates it: K samples of n joints."""

    name: str
    time: np.ndarray
    """(K,) [s]."""
    target: np.ndarray
    """(K, n) [rad]."""
    measured: np.ndarray
    """Encoder positions, (K, n) [rad]."""
    error: np.ndarray
    """Simulated less measured, (K, n) [rad]."""
    train: np.ndarray
    """Whether a sample was trained on, (K,) bool."""


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

    @classmethod
    def load(cls, folder: Path) -> RunData:
        """Read a run's folder.

        Raises:
            ValueError: If it has no result.
        """
        result = FitResult.load(folder)
        history = _read_json(folder / "history.json")
        config = _read_tensors(folder / "config.pt") or {}
        trajectory = _read_tensors(folder / "best_trajectory.pt") or {}
        bounds = config["bounds_params"].tolist() if "bounds_params" in config else []
        return cls(
            folder=folder,
            result=result,
            history=None if history is None else History(**history),
            joint_names=tuple(trajectory.get("joint_names", result.joint_names)),
            recordings=tuple(_recording(content) for content in trajectory.get("recordings", [])),
            bounds={
                label: (low, high) for label, (low, high) in zip(config.get("parameters", []), bounds, strict=True)
            },
            settings=(_read_json(folder / "settings.json") or {}).get("settings", {}),
        )

    def read_json(self, name: str) -> Any | None:
        """Another file of the folder, ``None`` if it is not there; for sections about later steps."""
        return _read_json(self.folder / name)


def _recording(content: dict[str, Any]) -> RecordingData:
    measured = np.asarray(content["dof_pos"])
    return RecordingData(
        name=content["name"],
        time=np.asarray(content["time"]),
        target=np.asarray(content["des_dof_pos"]),
        measured=measured,
        error=np.asarray(content["sim_dof_pos"]) - measured,
        train=np.asarray(content["train"]).astype(bool),
    )


def _read_json(path: Path) -> Any | None:
    return json.loads(path.read_text()) if path.is_file() else None


def _read_tensors(path: Path) -> Any | None:
    return torch.load(path, weights_only=True) if path.is_file() else None
