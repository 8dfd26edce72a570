"""Drives within the error bars of an identification, for training that must not rely on the last digit."""

from __future__ import annotations

import math

import torch

from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.effects import get_effect
from pace_actuators.identified import IdentifiedDrives

_FARTHEST = 3.0
"""Standard deviations at which draws end."""


def labels_with_std(drives: IdentifiedDrives) -> list[tuple[str, str]]:
    """Parameters and joints (or ``"all"``) that have an error bar, in order."""
    names = set(BASE_PARAMETERS)
    names |= {f"{cfg.effect_class.name}.{p.name}" for cfg in drives.effects for p in cfg.effect_class.parameters}
    return [
        (name, key)
        for name, entries in drives.std.items()
        if name in names
        for key, std in entries.items()
        if std is not None and math.isfinite(std) and std > 0 and math.isfinite(drives.parameters[name][key])
    ]


def draw(drives: IdentifiedDrives, uniform: torch.Tensor, scale: float = 1.0) -> dict[str, dict[str, torch.Tensor]]:
    """Parameters around the identified ones: Gaussian, correlated as the fit found them, cut off at 3 deviations.

    What the fit gave no error bar (at a bound, without influence) keeps its value. Nothing leaves its physical range:
    armature, frictions and delay stay >= 0, an effect's parameters within their bounds.

    Args:
        uniform: Independent draws between 0 and 1, (n, ``len(labels_with_std(drives))``).
        scale: Multiplies the standard deviations.

    Returns:
        {parameter: {joint or "all": (n,)}} of those that vary, in the units of the result (the delay in control steps
        of the identification).
    """
    labels = labels_with_std(drives)
    if not (math.isfinite(scale) and scale >= 0):
        raise ValueError(f"The scale of the error bars is {scale}, expected a finite number >= 0.")
    if uniform.shape[1:] != (len(labels),):
        raise ValueError(f"uniform has shape {tuple(uniform.shape)}, expected (n, {len(labels)}).")
    normal = math.sqrt(2) * torch.erfinv(2 * uniform.double().clamp(1e-12, 1 - 1e-12) - 1)
    normal = (normal @ _root(_correlation(drives, labels)).T).clamp(-_FARTHEST, _FARTHEST)
    result: dict[str, dict[str, torch.Tensor]] = {}
    for i, (name, key) in enumerate(labels):
        std = drives.std[name][key] or 0.0
        low, high = _range(name)
        value = drives.parameters[name][key]
        drawn = value + scale * std * normal[:, i]
        result.setdefault(name, {})[key] = drawn.clamp(min(low, value), max(high, value))
    return result


def _range(name: str) -> tuple[float, float]:
    effect, dot, parameter = name.partition(".")
    if dot:
        declared = next(p for p in get_effect(effect).parameters if p.name == parameter)
        return declared.lower, declared.upper
    least = BASE_PARAMETERS[name].least
    return (-math.inf if least is None else least), math.inf


def _correlation(drives: IdentifiedDrives, labels: list[tuple[str, str]]) -> torch.Tensor:
    """The fit's correlations of these entries; independent where it has none."""
    result = torch.eye(len(labels), dtype=torch.float64)
    known = {label: i for i, label in enumerate(drives.correlation.get("labels", ()))}
    at = [known.get(f"{name}/{key}") for name, key in labels]
    for i, row in enumerate(at):
        for j, column in enumerate(at):
            if i != j and row is not None and column is not None:
                result[i, j] = drives.correlation["matrix"][row][column] or 0.0
    return result


def _root(correlation: torch.Tensor) -> torch.Tensor:
    """R with R Rᵀ = C and a diagonal of ones, also where rounding has made C indefinite."""
    values, vectors = torch.linalg.eigh(correlation)
    root = vectors * values.clamp(min=0.0).sqrt()
    return root / root.norm(dim=1, keepdim=True).clamp(min=1e-12)


def in_control_steps(drives: IdentifiedDrives, delay: torch.Tensor, control_dt: float) -> torch.Tensor:
    """A delay in the identification's control steps as control steps of ``control_dt`` [s]."""
    return delay * (drives.at.control_dt / control_dt)
