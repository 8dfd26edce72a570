"""Reading the tensors of a run's folder, checked: trajectories and their errors, bounds, a mean of the search."""

from __future__ import annotations

import functools
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pace_actuators.files import read_tensors, refuse

_ANEW = "Fit again, or go on with the run."
_LARGEST = 1e15
"""Beyond it no position or bound is one, and differences are no numbers any more; a simulation has diverged."""
_SERIES = ("des_dof_pos", "dof_pos", "sim_dof_pos")


def existing(path: Path) -> Path:
    """The path of a file that a fit writes at its end."""
    if not os.path.lexists(path):
        raise ValueError(
            f"{path.parent} has no {path.name} yet: the fit has not ended. Wait, or go on with "
            f"scripts/fit.py --resume {shlex.quote(str(path.parent))}"
        )
    return path


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
    simulated: np.ndarray
    """The same of the simulation, (K, n) [rad]; NaN where it has diverged."""
    train: np.ndarray
    """Whether a sample was trained on, (K,) bool."""
    held_out: np.ndarray
    """Whether it was kept for validation, (K,) bool. A beginning that settles is neither."""
    enabled: np.ndarray
    """Whether the drive gave torque, (K,) bool; runs of earlier versions do not say it."""
    base: np.ndarray | None = None
    """Position [m] and quaternion of a base that moves, (K, 7)."""
    standing: np.ndarray | None = None
    """Which of its feet touch the ground, (K, feet) bool."""
    feet: tuple[Mapping[str, Any], ...] = ()
    """``body`` and ``pos`` [m] of each foot."""

    @functools.cached_property
    def error(self) -> np.ndarray:
        """Simulated less measured, (K, n) [rad]."""
        return self.simulated - self.measured


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectories:
    """What ``best_trajectory.pt`` holds."""

    joint_names: tuple[str, ...]
    recordings: tuple[RecordingData, ...]

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Trajectories:
        """The file's content, or what is to be written into it."""
        return cls(joint_names=tuple(content["joint_names"]), recordings=tuple(map(_recording, content["recordings"])))


def _recording(content: Mapping[str, Any]) -> RecordingData:
    train = np.asarray(content["train"])
    return RecordingData(
        name=content["name"],
        time=np.asarray(content["time"]),
        target=np.asarray(content["des_dof_pos"]),
        measured=np.asarray(content["dof_pos"]),
        simulated=np.asarray(content["sim_dof_pos"]),
        train=train,
        held_out=~train & ~np.asarray(content.get("settling", np.zeros_like(train))),
        enabled=np.asarray(content.get("torque_enable", np.ones_like(train))),
        base=np.asarray(content["base"]) if "base" in content else None,
        standing=np.asarray(content["standing"]).astype(bool) if "base" in content else None,
        feet=tuple(content.get("feet", ())),
    )


def read_trajectory(folder: Path) -> Trajectories:
    """What ``best_trajectory.pt`` of a run holds, checked."""
    path = existing(folder / "best_trajectory.pt")
    content = _dict(read_tensors(path, _ANEW), path, ("joint_names", "recordings"))
    names, recordings = content["joint_names"], content["recordings"]
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        refuse(path, "joint_names is no list of names", _ANEW)
    if not (isinstance(recordings, list) and recordings):
        refuse(path, "recordings is no list of recordings", _ANEW)
    for r, entry in enumerate(recordings):
        _check_recording(entry, f"{path}: recordings[{r}]", len(names))
    return Trajectories.of(content)


def _check_recording(entry: Any, where: str, joints: int) -> None:
    _dict(entry, where, ("name", "time", *_SERIES, "train"))
    if not isinstance(entry["name"], str):
        refuse(where, "name is no text", _ANEW)
    time = entry["time"]
    if not _is_series(time, 1) or len(time) < 2 or not bool((time.diff() > 0).all()):
        refuse(where, "time does not increase, (K,) [s]", _ANEW)
    for name in _SERIES:
        shape = (len(time), joints)
        if not _is_series(entry[name], 2, finite=name != "sim_dof_pos") or tuple(entry[name].shape) != shape:
            refuse(where, f"{name} is no series of finite numbers of shape {shape}", _ANEW)
    simulated = entry["sim_dof_pos"]
    entry["sim_dof_pos"] = simulated.where(simulated.abs() < _LARGEST, torch.nan)
    for name in ("train", "torque_enable", "settling"):
        flags = entry[name] if name == "train" else entry.get(name, entry["train"])
        if not (isinstance(flags, torch.Tensor) and flags.dtype == torch.bool and flags.shape == time.shape):
            refuse(where, f"{name} is no series of true and false of shape {tuple(time.shape)}", _ANEW)
    if "base" in entry:
        _dict(entry, where, ("standing", "feet"))
        feet, standing = entry["feet"], entry["standing"]
        if not (
            isinstance(feet, list) and all(isinstance(foot, dict) and {"body", "pos"} <= set(foot) for foot in feet)
        ):
            refuse(where, "feet is no list of bodies and places", _ANEW)
        if not _is_series(entry["base"], 2) or tuple(entry["base"].shape) != (len(time), 7):
            refuse(where, f"base is no series of finite numbers of shape {(len(time), 7)}", _ANEW)
        if not (isinstance(standing, torch.Tensor) and tuple(standing.shape) == (len(time), len(feet))):
            refuse(where, f"standing is no series of shape {(len(time), len(feet))}", _ANEW)


def read_bounds(folder: Path) -> dict[str, tuple[float, float]]:
    """Lower and upper bound by label ``<parameter>/<joint>``, from ``config.pt``; empty without that file."""
    path = folder / "config.pt"
    if not os.path.lexists(path):
        return {}
    content = _dict(read_tensors(path, _ANEW), path, ("parameters", "bounds_params"))
    labels, bounds = content["parameters"], content["bounds_params"]
    if not (isinstance(labels, list) and all(isinstance(label, str) for label in labels)):
        refuse(path, "parameters is no list of labels", _ANEW)
    if not _is_series(bounds, 2) or tuple(bounds.shape) != (len(labels), 2):
        refuse(path, f"bounds_params is no tensor of finite numbers of shape {(len(labels), 2)}", _ANEW)
    if bool((bounds[:, 0] > bounds[:, 1]).any()):
        refuse(path, "bounds_params has a lower bound above the upper one", _ANEW)
    return {label: (low, high) for label, (low, high) in zip(labels, bounds.tolist(), strict=True)}


def read_mean(path: Path) -> torch.Tensor:
    """A mean of the search, (size,)."""
    content = read_tensors(path, "Name another mean, or fit again.")
    if not _is_series(content, 1):
        refuse(path, "holds no vector of finite numbers", "Name another mean, or fit again.")
    return content


def _is_series(value: Any, axes: int, *, finite: bool = True) -> bool:
    if not isinstance(value, torch.Tensor) or not value.is_floating_point() or value.ndim != axes:
        return False
    return not finite or bool((value.abs() < _LARGEST).all())  # NaN is not


def _dict(content: Any, where: object, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(content, dict):
        refuse(where, "holds no dict", _ANEW)
    if missing := [key for key in keys if key not in content]:
        refuse(where, f"{missing[0]} is missing", _ANEW)
    return content


def held_out_spans(time: np.ndarray, train: np.ndarray) -> list[tuple[float, float]]:
    """From when to when samples are kept for validation [s].

    Args:
        time: (K,) [s].
        train: (K,) bool.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[True], train.astype(bool), [True]]).astype(np.int8)))
    return [(float(time[a]), float(time[min(b, len(time) - 1)])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def rms(error: np.ndarray) -> float | None:
    """Root mean square; ``None`` of nothing."""
    return float(np.sqrt(np.mean(np.square(error)))) if error.size else None
