"""The true parameters of a simulated recording."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

import numpy as np
import torch

from pace_envs.tasks.pace import PaceCfg
from pace_optim.problem.parameter_space import ParameterSpace


def true_parameters(cfg: PaceCfg, space: ParameterSpace, overrides: Mapping[str, float]) -> torch.Tensor:
    """``PaceCfg.sample_params`` with some values replaced, as a vector (size,).

    Args:
        overrides: By name (all joints) or ``name/joint``; the latter win.
    """
    keys_of = {parameter.name: parameter.keys for parameter in space.parameters}
    values: dict[str, dict[str, float]] = {}
    for name, given in cfg.sample_params.items():
        _check_name(name, keys_of, f"sample_params of {cfg.robot_name}")
        values[name] = dict(given) if isinstance(given, Mapping) else dict.fromkeys(keys_of[name], float(given))
    for label, value in sorted(overrides.items(), key=lambda item: "/" in item[0]):
        name, slash, key = label.partition("/")
        _check_name(name, keys_of, "--parameter")
        if slash and key not in keys_of[name]:
            hint = _did_you_mean(key, keys_of[name])
            raise ValueError(f"--parameter {label}: {name} has no {key!r}.{hint} It has {', '.join(keys_of[name])}.")
        if not np.isfinite(value):
            raise ValueError(f"--parameter {label}={value}: expected a finite number.")
        for each in (key,) if slash else keys_of[name]:
            values.setdefault(name, {})[each] = value
    for name, keys in keys_of.items():
        if missing := [key for key in keys if key not in values.get(name, {})]:
            raise ValueError(
                f"The true value of {name} of {', '.join(missing)} is not known. Give it with --parameter "
                f"{name}=VALUE, or in sample_params of {cfg.robot_name}."
            )
    return space.from_dict(values)


def _check_name(name: str, keys_of: Iterable[str], where: str) -> None:
    available = tuple(keys_of)
    if name not in available:
        raise ValueError(
            f"{where}: there is no parameter {name!r}.{_did_you_mean(name, available)} Available: "
            f"{', '.join(available)}."
        )


def _did_you_mean(name: str, available: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(available), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""
