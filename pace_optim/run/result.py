"""What a fit found: ``result.json`` and the tensors beside it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from pace_actuators import match_names, resolve_joint_values
from pace_actuators.identified import DRIVE_FIELDS
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.terminal.atomic import write_json
from pace_optim.uncertainty.uncertainty import Uncertainty

VERSION = 1


@dataclass(kw_only=True)
class FitResult:
    """The content of ``result.json``; field names are the file's keys."""

    version: int = VERSION
    task: str
    robot_name: str
    joint_names: list[str]
    effects: list[str]
    delay_mode: str
    physics_dt: float
    control_dt: float
    parameters: dict[str, dict[str, float]]
    delay_s: float
    std: dict[str, dict[str, float | None]]
    units: dict[str, str]
    at_bound: list[str]
    no_influence: list[str]
    indistinguishable: list[list[str]]
    correlation: dict[str, Any]
    score: float
    rmse: dict[str, dict[str, float]]
    recordings: dict[str, list[str]]
    optimizer: str
    seed: int
    generations: int
    simulated_steps: int
    wall_time_s: float
    stop_reasons: list[str]
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    drive: dict[str, dict[str, float]] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        write_json(path, asdict(self))

    @classmethod
    def load(cls, path: str | Path) -> FitResult:
        """Read ``result.json``, or that of a run's folder.

        Raises:
            ValueError: If it is missing or of another version.
        """
        path = Path(path)
        path = path / "result.json" if path.is_dir() else path
        if not path.is_file():
            raise ValueError(f"{path} does not exist. Name a run's folder or its result.json.")
        try:
            content = json.loads(path.read_text())
        except json.JSONDecodeError as error:
            raise ValueError(f"{path} is no JSON ({error}). Fit again.") from None
        if not isinstance(content, dict) or content.get("version") != VERSION:
            raise ValueError(f"{path} is no fit result of version {VERSION}. Fit again with this version.")
        known = cls.__dataclass_fields__
        return cls(**{key: value for key, value in content.items() if key in known})


def rmse_by_joint(residuals: Residuals, where: torch.Tensor, joint_names: tuple[str, ...]) -> dict[str, float]:
    """Root mean square error of each joint and of all, over a (K, R) part of the samples [rad]; empty if none."""
    if not bool(where.any()):
        return {}
    square = residuals.error[0].square()[where].mean(dim=0)
    return {
        **{name: math.sqrt(value) for name, value in zip(joint_names, square.tolist(), strict=True)},
        "all": math.sqrt(float(square.mean())),
    }


def std_by_parameter(space: ParameterSpace, uncertainty: Uncertainty) -> dict[str, dict[str, float | None]]:
    """Standard deviations shaped as the parameters; ``None`` where there is none."""
    values = space.to_dict(torch.as_tensor(uncertainty.std))
    return {name: {key: None if math.isnan(v) else v for key, v in entries.items()} for name, entries in values.items()}


def correlation_matrix(space: ParameterSpace, uncertainty: Uncertainty) -> dict[str, Any]:
    """The correlation matrix with its labels; ``None`` where there is none."""
    rows = [[None if math.isnan(v) else round(v, 6) for v in row] for row in uncertainty.correlation.tolist()]
    return {"labels": list(space.labels), "matrix": rows}


def drive_in_force(problem: Problem) -> dict[str, dict[str, float]]:
    """Gains and limits per joint that were in force in every recording; one that differed is left out."""
    joints, found = list(problem.joint_names), {}
    recordings = problem.dataset.recordings
    for name in DRIVE_FIELDS:
        configured: dict[str, float] = {}
        for cfg in problem.env_cfg.scene.robot.actuators.values():
            own = [joints[i] for group in match_names(cfg.joint_names_expr, joints) for i in group]
            if (value := getattr(cfg, name)) is not None:
                configured |= dict(zip(own, resolve_joint_values(value, own, field=name).tolist(), strict=True))
        stated = [getattr(recording.drive, name) for recording in recordings]
        values = {
            joint: {float(each[i]) if each is not None else configured.get(joint) for each in stated}
            for i, joint in enumerate(joints)
        }
        known = {joint: next(iter(each)) for joint, each in values.items() if len(each) == 1}
        found[name] = {j: v for j, v in known.items() if v is not None and math.isfinite(v)}
    return {name: values for name, values in found.items() if values}


def make_result(
    problem: Problem,
    x: torch.Tensor,
    residuals: Residuals,
    uncertainty: Uncertainty,
    **facts: Any,
) -> FitResult:
    """Put a result together.

    Args:
        problem: What was fitted.
        x: The best normalised vector, (size,).
        residuals: Of x on all samples.
        uncertainty: At x.
        facts: The remaining fields of :class:`FitResult`.
    """
    data, space = problem.dataset, problem.space
    physical = space.to_physical(x)
    train, validation = data.train[residuals.step], data.validation[residuals.step]
    trained = residuals.error[0].square()[train]
    return FitResult(
        task=problem.task,
        robot_name=problem.env_cfg.sim2real.robot_name,
        joint_names=list(problem.joint_names),
        delay_mode=problem.delay_mode,
        physics_dt=problem.physics_dt,
        control_dt=problem.control_dt,
        parameters=space.to_dict(physical),
        delay_s=float(physical[space["delay"]]) * problem.control_dt,
        std=std_by_parameter(space, uncertainty),
        units=space.units,
        at_bound=list(uncertainty.at_bound),
        no_influence=list(uncertainty.no_influence),
        indistinguishable=[list(group) for group in uncertainty.indistinguishable],
        correlation=correlation_matrix(space, uncertainty),
        score=float(trained.sum(dim=1).mean()),
        rmse={
            "train": rmse_by_joint(residuals, train, problem.joint_names),
            "validation": rmse_by_joint(residuals, validation, problem.joint_names),
        },
        recordings={"train": data.names("train"), "validation": data.names("validation")},
        notes=[f"{recording.name}: {note}" for recording in data.recordings for note in recording.notes],
        drive=drive_in_force(problem),
        **facts,
    )
