"""What a fit found: ``result.json`` and the tensors beside it."""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pace_actuators import match_names
from pace_actuators.drive_result import ALL, CURE, DriveResult, LinkInertia
from pace_actuators.effects import EffectCfg
from pace_actuators.effects.free_form import FreeForm
from pace_actuators.files import refuse, write_json
from pace_actuators.identified import DRIVE_FIELDS, LIMITS, RATE_FLAGS
from pace_actuators.joint_units import JointType, units_for
from pace_envs.link_inertia import NAMES
from pace_envs.tasks.pace import TORQUE_OFFSET, TORQUE_SCALE
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.error_bars.undetermined import whole_delay
from pace_optim.problem.drive_facts import configured_drive
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.problem.unknown_facts import identified_gains, identified_limits
from pace_optim.recording.commands import command_timing
from pace_optim.recording.data import notes_by_kind
from pace_optim.recording.dataset import Torques


@dataclass(kw_only=True)
class FitResult(DriveResult):
    """The content of ``result.json``; field names are the file's keys."""

    robot_name: str
    std: dict[str, dict[str, float | None]]
    units: dict[str, str | dict[str, str]]
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
    objective: dict[str, float | None] = field(default_factory=dict)
    """What an objective of the user's own is at the result, in ``train`` and ``validation``; empty: it is ``score``."""
    step_error: dict[str, dict[str, float | None]] = field(default_factory=dict)
    """The part of each value from the physics step and an assumed loop rate, shaped as ``std``, which includes it; it
    is empty if unknown."""
    assumes_loop_rate: bool = False
    """Whether the rate of the drives' loops is assumed. What depends on it is in ``step_error`` and ``std``."""
    loop_rate: dict[str, Any] = field(default_factory=dict)
    """What the recordings say of that rate: the period that was assumed, the one that is used, those that they allow
    [s], and the parameters at both ends; empty where it is stated."""
    std_means_nothing: bool = False
    """Whether the fit ended so far above the noise that its error bars say nothing."""
    measured_drive: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What the torque in the recordings says of each drive, by joint and recording."""
    contested: list[str] = field(default_factory=list)
    """Facts that are stated and that the torque in a recording contradicts."""
    from_torques: list[str] = field(default_factory=list)
    """Facts that were read from the torques in the recordings."""
    torque_rmse: dict[str, dict[str, float]] = field(default_factory=dict)
    """Of torques that the fit follows, in ``train`` and ``validation``, by joint [N m]."""
    torque_noise: dict[str, float] = field(default_factory=dict)
    """Standard deviation of the noise that they are weighed by, by joint [N m]; empty: it follows none."""
    torque_floor: dict[str, float] = field(default_factory=dict)
    """Standard deviation of noise in the torques, by joint [N m]: their spectrum above the motion."""
    imu_delays: dict[str, float] = field(default_factory=dict)
    """How much later than encoders the IMU of a base that moves is read, by recording [s]: the fit reads it earlier."""
    curves: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """Of effects that are curves, by effect and joint: ``variable`` and ``value`` with their units, the knots ``at``,
    and the ``torque`` there, of a friction all friction that the joint has."""
    file_values: dict[str, dict[str, float]] = field(default_factory=dict)
    """What the model file states of parameters of links, shaped as these."""
    warnings: list[str] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    """What was found beside the parameters, in sentences."""
    notes: list[str] = field(default_factory=list)
    """What was assumed, and how the recordings were read: known before the search."""

    def check(self, source: object) -> None:
        """Check what the types of the fields do not say.

        Raises:
            ValueError: If something does not fit; the message names the key.
        """
        super().check(source)
        for name, entries in self.parameters.items():
            if name not in self.units:
                refuse(source, f"units has no {name}", CURE)
            if missing := [key for key in entries if key not in self.std.get(name, {})]:
                refuse(source, f"std/{name} has no {missing[0]}", CURE)
        for part in ("train", "validation"):
            if part not in self.rmse or part not in self.recordings:
                refuse(source, f"rmse and recordings must have {part}", CURE)
            entries = self.rmse[part]
            if entries and (missing := [key for key in (*self.joint_names, ALL) if key not in entries]):
                refuse(source, f"rmse/{part} has no {missing[0]}", CURE)
        if not self.rmse["train"]:
            refuse(source, "rmse/train has no values", CURE)
        for key in ("assumed_s", "used_s") if self.loop_rate else ():
            value = self.loop_rate.get(key)
            if isinstance(value, bool) or not isinstance(value, int | float) or value < 0:
                refuse(source, f"loop_rate/{key} must be a time [s], or 0 for a continuous loop", CURE)
        labels = {f"{name}/{key}" for name, entries in self.parameters.items() for key in entries}
        named = [*self.at_bound, *self.no_influence, *self.undetermined]
        named += [*(label for group in self.indistinguishable for label in group)]
        if foreign := [label for label in named if label not in labels]:
            refuse(source, f"{foreign[0]!r} is not one of its parameters", CURE)

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        write_json(path, asdict(self))

    def has_error_bar(self, name: str, key: str) -> bool:
        """Whether a value would have an error bar if error bars meant anything: it is free, and moves the joints."""
        return f"{name}/{key}" not in {*self.at_bound, *self.no_influence, *self.undetermined}

    def unit_of(self, name: str, key: str) -> str:
        """The unit of a parameter of a joint, or of all joints (``"all"``)."""
        unit = self.units.get(name, "")
        return unit if isinstance(unit, str) else unit.get(key, "")

    def joint_type(self, joint: str) -> JointType:
        """Whether a joint turns or slides."""
        return "slide" if self.unit_of("encoder_bias", joint) == "m" else "hinge"

    @property
    def joint_parameters(self) -> list[str]:
        """Names of the parameters that joints have, one value each."""
        return [name for name, values in self.parameters.items() if set(values) != {ALL} and name not in NAMES]

    @property
    def link_parameters(self) -> list[str]:
        """Names of the parameters that links have."""
        return [name for name in self.parameters if name in NAMES]

    @property
    def sensor_parameters(self) -> list[str]:
        """Names of the parameters of sensors of torques."""
        return [name for name in (TORQUE_SCALE, TORQUE_OFFSET) if name in self.parameters]

    @property
    def is_interrupted(self) -> bool:
        """Whether the fit, or its checks, was interrupted."""
        return any("interrupted" in reason for reason in self.stop_reasons)

    @property
    def joint_types(self) -> tuple[JointType, ...]:
        """Whether each joint turns or slides."""
        return tuple(self.joint_type(joint) for joint in self.joint_names)


def rmse_by_joint(residuals: Residuals, where: torch.Tensor, joint_names: tuple[str, ...]) -> dict[str, float]:
    """Root mean square error of each joint and of all, over a (K, R) part of the samples [rad]; empty if none."""
    if not bool(where.any()):
        return {}
    square = residuals.positions.error[0].square()[where].mean(dim=0)
    return {
        **{name: math.sqrt(value) for name, value in zip(joint_names, square.tolist(), strict=True)},
        ALL: math.sqrt(float(square.mean())),
    }


def torque_rmse(
    residuals: Residuals, torques: Torques | None, where: torch.Tensor, joint_names: tuple[str, ...]
) -> dict[str, float]:
    """Root mean square error of each torque that is followed, over a (K, R) part of the samples [N m]."""
    if torques is None:
        return {}
    error, known = residuals.torque_errors(torques)
    count = (known & where[..., None]).sum(dim=(0, 1))
    square = (error.square() * where[..., None]).sum(dim=(0, 1)) / count.clamp(min=1)
    return {joint: math.sqrt(v) for joint, v, k in zip(joint_names, square.tolist(), count.tolist(), strict=True) if k}


def by_parameter(space: ParameterSpace, errors: np.ndarray) -> dict[str, dict[str, float | None]]:
    """Standard deviations, or other errors, shaped as the parameters; ``None`` without an error bar."""
    values = space.to_dict(torch.as_tensor(errors))
    return {name: {key: None if math.isnan(v) else v for key, v in entries.items()} for name, entries in values.items()}


def correlation_matrix(space: ParameterSpace, uncertainty: Uncertainty) -> dict[str, Any]:
    """The correlation matrix with its labels; ``None`` where it is unknown."""
    rows = [[None if math.isnan(v) else round(v, 6) for v in row] for row in uncertainty.correlation.tolist()]
    return {"labels": list(space.labels), "matrix": rows}


def drive_in_force(problem: Problem) -> dict[str, dict[str, float]]:
    """Gains and limits per joint that were in force in every recording; one that differed is left out.

    A joint that has no limit where others have one is left out too. So a limit that differed is left out of all joints.
    """
    joints, found = list(problem.joint_names), {}
    recordings, configured = problem.dataset.recordings, configured_drive(problem.env_cfg, problem.joint_names)
    for name in DRIVE_FIELDS:
        stated = [getattr(recording.drive, name) for recording in recordings]
        values = {
            joint: {float(each[i]) if each is not None else float(configured[name][i]) for each in stated}
            for i, joint in enumerate(joints)
        }
        known = {joint: next(iter(each)) for joint, each in values.items() if len(each) == 1}
        if name in LIMITS and len(known) < len(joints):
            known = {}
        found[name] = {j: v for j, v in known.items() if math.isfinite(v)}
    for cfg in problem.plain_cfg.scene.robot.actuators.values():
        own = [joints[i] for group in match_names(cfg.joint_names_expr, joints) for i in group]
        if cfg.drive_dt is not None:
            found.setdefault("drive_dt", {}).update(dict.fromkeys(own, cfg.drive_dt))
        flags = {name: getattr(cfg, name) for name in RATE_FLAGS}
        flags["second_order"] |= problem.env_cfg.sim.integrator == "leapfrog"
        for name in RATE_FLAGS:
            if flags[name]:
                found.setdefault(name, {}).update(dict.fromkeys(own, 1.0))
    return {name: values for name, values in found.items() if values}


def _found_links(problem: Problem, values: dict[str, dict[str, float]]) -> dict[str, LinkInertia]:
    """The links that were fitted, and those that the robot has had in place of its file's."""
    found = {
        link.link: link.inertia({name: values[name][link.link] for name in link.names})
        for link in problem.env_cfg.sim2real.links
    }
    return {**problem.env_cfg.scene.robot.links, **found}


def _file_values(problem: Problem) -> dict[str, dict[str, float]]:
    """What the model file states of the parameters of links that were fitted, shaped as these."""
    links = problem.env_cfg.sim2real.links
    return {
        name: {link.link: link.values[NAMES.index(name)] for link in links if name in link.names}
        for name in NAMES
        if name in problem.space.slices
    }


def _curves(problem: Problem, values: dict[str, dict[str, float]]) -> dict[str, dict[str, dict[str, Any]]]:
    """The knots of effects that are curves, by effect and joint."""
    result: dict[str, dict[str, dict[str, Any]]] = {}
    for cfg in map(EffectCfg.parse, problem.effects):
        effect = cfg.effect_class
        if not issubclass(effect, FreeForm):
            continue
        for joint in cfg.joints(problem.joint_names):
            own = {p.name: values[f"{effect.name}.{p.name}"] for p in effect.parameters}
            at_joint = {name: each.get(joint, each.get(ALL, 0.0)) for name, each in own.items()}
            friction = (values.get(name, {}).get(joint, 0.0) for name in ("friction", "viscous_friction"))
            types = [problem.joint_types[problem.joint_names.index(joint)]]
            units = {
                "variable": units_for(f"{effect.variable} [{effect.parameters[-1].unit}]", types),
                "value": units_for(f"{effect.kind} [{effect.parameters[0].unit}]", types),
            }
            result.setdefault(effect.name, {})[joint] = units | effect.law(at_joint, *friction)
    return result


def make_result(
    problem: Problem,
    x: torch.Tensor,
    residuals: Residuals,
    uncertainty: Uncertainty,
    **facts: Any,
) -> FitResult:
    """Put a result together.

    Args:
        x: The best normalised vector, (size,).
        facts: The remaining fields of :class:`FitResult`.
    """
    data, space = problem.dataset, problem.space
    physical = space.to_physical(x)
    train, validation = data.train[residuals.step], data.validation[residuals.step]
    trained = residuals.positions.error[0].square()[train]
    if facts.get("std_means_nothing"):  # then the file has none
        uncertainty = uncertainty.without_error_bars()
    values, std = space.to_dict(physical), by_parameter(space, uncertainty.std)
    open_ = facts.get("undetermined", ())
    result = FitResult(
        task=problem.task,
        robot_name=problem.env_cfg.sim2real.robot_name,
        joint_names=list(problem.joint_names),
        delay_mode=problem.delay_mode,
        physics_dt=problem.physics_dt,
        control_dt=problem.control_dt,
        parameters=values,
        delay_s=float(physical[space["delay"]]) * problem.control_dt,
        std=std,
        step_error={} if uncertainty.step is None else by_parameter(space, uncertainty.step),
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
        torque_rmse={
            "train": torque_rmse(residuals, data.torques, train, problem.joint_names),
            "validation": torque_rmse(residuals, data.torques, validation, problem.joint_names),
        },
        torque_noise=problem.torque_noise,
        torque_floor=problem.torque_floor if problem.torque_noise else {},
        imu_delays=dict(problem.imu_delays),
        measured_drive=problem.measured.to_dict(),
        contested=list(problem.measured.contested),
        from_torques=sorted(fact for fact, joints in problem.measured.taken.items() if joints),
        findings=whole_delay(problem, float(physical[space["delay"]]), std["delay"][ALL]),
        notes=assumptions(problem),
        links=_found_links(problem, values),
        file_values=_file_values(problem),
        curves=_curves(problem, values),
        drive=drive_in_force(problem) | identified_limits(problem.unknown, values, open_),
        command_timing=command_timing(each.logged for each in data.recordings if each.logged is not None),
        **facts,
    )
    gains = identified_gains(problem.env_cfg, data.recordings, problem.unknown, values, open_, result.unit_of)
    return replace(result, findings=[*gains, *result.findings])


def assumptions(problem: Problem, shown: Container[str] = ()) -> list[str]:
    """What a fit assumes of the robot, and how its recordings were read, in sentences.

    Args:
        shown: Notes that were printed already: they are omitted.
    """
    of_robot = [*problem.env_cfg.sim2real.notes, *problem.measured.notes, *problem.torque_notes]
    recordings = [replace(r, notes=tuple(n for n in r.notes if n not in shown)) for r in problem.dataset.recordings]
    return [*(note for note in of_robot if note not in shown), *notes_by_kind(recordings)]
