"""The whole configuration of a run as data, independent of the code that made it."""

from __future__ import annotations

import math
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from pace_actuators.effects import effect_cfgs
from pace_actuators.files import replacing
from pace_optim.problem.problem import Problem

_PACKAGES = ("pace-mujoco", "mujoco", "torch", "numpy", "scipy", "cma")


def resolved(problem: Problem) -> dict[str, Any]:
    """Configuration, parameters with their bounds, and versions, as JSON holds them."""
    space = problem.space
    return {
        "configuration": as_data(problem.env_cfg),
        "parameters": {
            label: {"unit": space.unit_of(*label.split("/", 1)), "lower": low, "upper": high}
            for label, low, high in zip(space.labels, space.lower.tolist(), space.upper.tolist(), strict=True)
        },
        "effects": [
            {"effect": cfg.label, "joints": cfg.joints(problem.joint_names), "parameters": as_data(_bounds(cfg))}
            for cfg in effect_cfgs(problem.env_cfg.sim2real.effects)
        ],
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Of the packages that a result depends on, and the commit of this one where it is a checkout."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found | ({"commit": commit} if (commit := _commit()) else {})


def as_data(value: Any) -> Any:
    """Anything in a configuration as JSON holds it; functions and classes by their names."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, torch.Tensor | np.ndarray | np.generic):
        return as_data(value.tolist())
    if is_dataclass(value) and not isinstance(value, type):
        content = {f.name: as_data(getattr(value, f.name)) for f in fields(value)}
        return {"type": _name(type(value)), **content}
    if isinstance(value, Mapping):
        return {str(key): as_data(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [as_data(each) for each in value]
    if isinstance(value, set | frozenset):
        return sorted((as_data(each) for each in value), key=str)
    if isinstance(value, slice):
        return str(value)
    if isinstance(value, partial):
        return {
            "type": "functools:partial",
            "func": as_data(value.func),
            "args": as_data([*value.args, value.keywords]),
        }
    if callable(value) or isinstance(value, type):
        return _name(value)
    return {"type": _name(type(value)), **as_data(vars(value) if hasattr(value, "__dict__") else {})}


def first_difference(before: Any, after: Any, path: str = "") -> str | None:
    """Where two configurations differ first, in words; ``None`` if they agree in what both have."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before:
            if key in after and (found := first_difference(before[key], after[key], f"{path}.{key}" if path else key)):
                return found
        return None
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        parts = (first_difference(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(before, after, strict=True)))
        return next((found for found in parts if found), None)
    return None if before == after else f"{path} is {_short(after)}, and was {_short(before)}"


def write_model(problem: Problem, path: Path) -> None:
    """The compiled model in MuJoCo's own format (``mujoco.MjModel.from_binary_path`` reads it), whole or not at all."""
    env = problem.make_env(1)
    try:
        with replacing(path) as part:
            mujoco.mj_saveModel(env.sim.model, str(part), None)
    finally:
        env.close()


def _bounds(cfg: Any) -> list[Any]:
    return list(cfg.effect_class.parameters)


def _name(value: Any) -> str:
    return f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', type(value).__qualname__)}"


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 80 else f"{text[:77]}..."


def _commit() -> str | None:
    """The commit that is checked out, where this file lies in a checkout and not in an installation."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    words = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
