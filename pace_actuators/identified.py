"""What an identification found, as drives of another environment: reading ``result.json``, and what its steps mean.

Delays travel in seconds, because a control step is another time in every environment.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from pace_actuators.base_parameters import BASE_PARAMETERS, PER_JOINT
from pace_actuators.drive_result import ALL, CURE, CommandTiming, DriveResult, LinkInertia, result_path
from pace_actuators.effects import EffectCfg, get_effect, use_recorded_effects
from pace_actuators.files import refuse
from pace_actuators.joint_values import match_names
from pace_actuators.own_code import checked_record

if TYPE_CHECKING:
    from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg


LIMITS = ("effort_limit", "saturation_effort", "velocity_limit")
DRIVE_FIELDS = ("stiffness", "damping", *LIMITS)
"""Facts about the drive that was recorded, named as in ``PaceDCMotorCfg``."""

RATE_FLAGS = ("implicit", "centred_commands", "second_order")
"""How its controller ran, beside ``drive_dt``."""

RIG_EFFECTS = ("mount_compliance",)
"""Effects of what held the robot during the recording, by name: a walking robot does not have them."""

_FARTHEST = 2.0
"""Ratio of two physics steps from where on the values are called into question."""


@dataclass(frozen=True, kw_only=True, slots=True)  # slots: Isaac Lab 3.0 assigns to what has a __dict__
class IdentifiedAt:
    """Time steps of an identification."""

    control_dt: float
    """Time between two control steps [s]."""

    physics_dt: float
    """Time between two physics steps [s]."""


@dataclass(frozen=True, kw_only=True)
class IdentifiedDrives:
    """The content of ``result.json`` that a drive needs."""

    path: Path
    """Where it was read."""

    task: str
    """The environment of the identification."""

    joint_names: tuple[str, ...]
    """The joints, in order."""

    delay_mode: str
    """What the delay delays, ``"command"`` or ``"effort"``."""

    delay_s: float
    """Delay [s]."""

    at: IdentifiedAt
    """Time steps of the identification."""

    parameters: Mapping[str, Mapping[str, float]]
    """Value by parameter and joint (or ``"all"``), in the units of ``units``."""

    std: Mapping[str, Mapping[str, float | None]]
    """Standard deviations of the same shape; ``None`` without an error bar."""

    correlation: Mapping[str, Any]
    """``labels`` (``parameter/joint``) and ``matrix``, entries ``None`` where it is unknown; may be empty."""

    effects: tuple[EffectCfg, ...]
    """The effects, without values."""

    drive: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Gains and limits per joint that were in force in every recording, as far as known."""

    links: Mapping[str, LinkInertia] = field(default_factory=dict)
    """Inertial parameters of links that were identified, by name."""

    undetermined: frozenset[str] = frozenset()
    """Labels ``parameter/joint`` that the recordings do not determine: their value is that of the configuration."""

    at_bound: tuple[str, ...] = ()
    """Labels of what ended at a bound of the fit."""

    times_noise: float | None = None
    """The fit's error as a multiple of the measurement noise; ``None``: it is not known."""

    command_timing: CommandTiming | None = None
    """When the recordings' commands came; ``None``: it is not known."""

    environment: Mapping[str, Any] = field(default_factory=dict)
    """Where the environment of the identification comes from: its code and files, by digest."""

    @classmethod
    def of(cls, source: IdentifiedDrives | str | Path) -> IdentifiedDrives:
        """Identified drives that have been read, or those of a file."""
        return source if isinstance(source, IdentifiedDrives) else cls.load(source)

    @classmethod
    def load(cls, path: str | Path) -> IdentifiedDrives:
        """Read ``result.json``, or that of a run's folder.

        Raises:
            ValueError: If it is missing, damaged, of another version, or holds an unknown effect.
        """
        path = result_path(path)
        content = DriveResult.load(path)
        use_recorded_effects(content.effects, checked_record(content.environment, path, CURE), str(path))
        result = cls(
            path=path,
            task=content.task,
            joint_names=tuple(content.joint_names),
            delay_mode=content.delay_mode,
            delay_s=content.delay_s,
            at=IdentifiedAt(control_dt=content.control_dt, physics_dt=content.physics_dt),
            parameters=content.parameters,
            std=content.std,
            correlation=content.correlation,
            effects=tuple(_parsed(path, label) for label in content.effects),
            drive=content.drive,
            links=content.links,
            undetermined=frozenset(content.undetermined),
            at_bound=tuple(content.at_bound),
            times_noise=content.times_noise,
            command_timing=content.command_timing,
            environment=content.environment,
        )
        result._check()
        return result

    def values(self, name: str, joints: Sequence[str]) -> dict[str, float]:
        """Value per joint of a parameter, for those of some joints that have one."""
        entries = self.parameters[name]
        if ALL in entries:
            return dict.fromkeys(joints, float(entries[ALL]))
        return {joint: float(entries[joint]) for joint in joints if joint in entries}

    def determined(self, name: str, joints: Sequence[str]) -> dict[str, float]:
        """Value per joint of a parameter, for those of some joints on which the recordings determine it."""
        if f"{name}/{ALL}" in self.undetermined:
            return {}
        return {j: value for j, value in self.values(name, joints).items() if f"{name}/{j}" not in self.undetermined}

    @property
    def is_continuous(self) -> bool:
        """Whether the controller of a drive ran continuously."""
        return any(self.drive.get("implicit", {}).values())

    def find_joints(self, joint_names_expr: str | Sequence[str] | None) -> list[str]:
        """Its joints that match, in order; all for ``None``.

        Raises:
            ValueError: If an expression matches none.
        """
        if joint_names_expr is None:
            return list(self.joint_names)
        found = {i for group in match_names(joint_names_expr, self.joint_names) for i in group}
        return [name for i, name in enumerate(self.joint_names) if i in found]

    def cfg_fields(
        self, joint_names_expr: str | Sequence[str] | None = None, *, on_the_rig: bool = False
    ) -> dict[str, Any]:
        """Fields of a ``PaceDCMotorCfg`` of some joints.

        Args:
            joint_names_expr: Which joints; ``None`` means all.
            on_the_rig: Whether the robot is held as in the recording: with the effects of what held it.

        Raises:
            ValueError: If an expression matches no joint.
        """
        joints = self.find_joints(joint_names_expr)
        fields: dict[str, Any] = {
            "joint_names_expr": tuple(re.escape(joint) for joint in joints),
            "delay_s": self.delay_s,
            "delay_mode": self.delay_mode,
            "identified": self.at,
            "effects": tuple(self._effects_of(joints, on_the_rig)),
        }
        for name in PER_JOINT:
            if self.determined(name, joints):  # where none is, the drive keeps its own
                fields[name] = _by_pattern(self.values(name, joints))
        for name in DRIVE_FIELDS:
            known: Mapping[str, float] = self.drive.get(name) or {}
            if known and name in LIMITS:  # a joint that is not there has none
                known = dict.fromkeys(joints, math.inf) | dict(known)
            if all(joint in known for joint in joints):
                fields[name] = _by_pattern({joint: float(known[joint]) for joint in joints})
        return fields | self._rate_of(joints)

    def _rate_of(self, joints: Sequence[str]) -> dict[str, Any]:
        """How the controllers of some joints ran: the same torque law needs the same rate.

        A result with a drive states all of it: what has no key is a loop that holds its torque for a control step.
        """
        if not self.drive:
            return {}
        names = ("drive_dt", *RATE_FLAGS)
        rates = {tuple(self.drive.get(name, {}).get(joint) for name in names) for joint in joints}
        if len(rates) > 1:
            raise ValueError(
                f"{self.path}: the controllers of {', '.join(joints)} ran at different rates ({', '.join(names)}): "
                f"{sorted(rates, key=str)}. Put them into separate groups."
            )
        drive_dt, *flags = rates.pop()
        return {"drive_dt": drive_dt, **{name: bool(flag) for name, flag in zip(RATE_FLAGS, flags, strict=True)}}

    def _effects_of(self, joints: Sequence[str], on_the_rig: bool) -> list[EffectCfg]:
        """The effects with their values on those of some joints that have them."""
        result = []
        for cfg in self.effects:
            if cfg.effect_class.name in RIG_EFFECTS and not on_the_rig:
                continue
            own = [joint for joint in cfg.joints(self.joint_names) if joint in joints]
            if own:
                name = cfg.effect_class.name
                values = {
                    p.name: _by_pattern(self.values(f"{name}.{p.name}", own)) for p in cfg.effect_class.parameters
                }
                patterns = tuple(re.escape(joint) for joint in own)
                result.append(replace(cfg, joint_names_expr=patterns, values=values))
        return result

    def _check(self) -> None:
        """Each parameter of an effect must have a value on each joint that has the effect."""
        for cfg in self.effects:
            for parameter in cfg.effect_class.parameters:
                name, joints = f"{cfg.effect_class.name}.{parameter.name}", cfg.joints(self.joint_names)
                known = self.values(name, joints) if name in self.parameters else {}
                if missing := [joint for joint in joints if joint not in known]:
                    refuse(self.path, f"{name} has no value for {', '.join(missing)}", CURE)


def delay_in_steps(cfg: PaceDCMotorCfg, physics_dt: float | None) -> tuple[float, float]:
    """Delay and largest delay of a drive [control steps].

    Args:
        physics_dt: Time between two of its calls [s].
    """
    if cfg.delay_s is None:
        return (cfg.max_delay or 0.0) if cfg.delay is None else cfg.delay, cfg.largest_delay
    if physics_dt is None:
        raise ValueError(
            f"The delay is given in seconds (delay_s = {cfg.delay_s:g}), and the time between two calls is not known: "
            "set physics_dt [s] in the actuator's configuration."
        )
    steps = round(cfg.delay_s / (physics_dt * cfg.control_decimation), 9)
    return steps, max(cfg.largest_delay, math.ceil(steps))


def step_notes(cfg: PaceDCMotorCfg, physics_dt: float | None) -> list[str]:
    """What the time steps of a drive change about values that were identified with others, in words.

    Args:
        physics_dt: Time between two of its calls [s]; ``None`` says nothing.
    """
    if cfg.identified is None or physics_dt is None:
        return []
    notes, at, control_dt = [], cfg.identified, physics_dt * cfg.control_decimation
    if cfg.delay_s is not None:
        steps, step = delay_in_steps(cfg, physics_dt)[0], f"{1e3 * control_dt:g} ms"
        delay = f"The delay of {1e3 * cfg.delay_s:.3g} ms ({steps:.3g} control steps of {step})"
        whole = abs(steps - round(steps)) < 1e-6
        if cfg.delay_interpolation == "hold" and not whole:
            notes.append(
                f"{delay} becomes {1e3 * math.ceil(steps) * control_dt:.3g} ms: with delay_interpolation 'hold' it is "
                "a whole number of them."
            )
        elif not whole and control_dt > at.control_dt * (1 + 1e-6):
            notes.append(
                f"{delay} lies between two steps. It is a linear mix of two samples there, which smooths more than at "
                f"the {1e3 * at.control_dt:g} ms of the identification. Train at that step for the identified delay."
            )
        if steps > cfg.largest_delay:
            notes.append(
                f"{delay} is longer than max_delay, {1e3 * cfg.largest_delay * control_dt:.3g} ms: max_delay was "
                f"raised to {math.ceil(steps)} steps."
            )
    ratio = max(physics_dt / at.physics_dt, at.physics_dt / physics_dt)
    if ratio > _FARTHEST * (1 + 1e-6):
        notes.append(
            f"The drive was identified with physics steps of {1e3 * at.physics_dt:g} ms, which are "
            f"{1e3 * physics_dt:g} ms here. Its values may include the error of that step. Replay the recording "
            "to see the difference (pace play --replay). If it is large, identify again with steps nearer to these."
        )
    return notes


def _parsed(path: Path, label: str) -> EffectCfg:
    try:
        return EffectCfg.parse(label)
    except ValueError as error:
        raise ValueError(f"{path}: {error} Import the module that registers it before reading the result.") from None


def _by_pattern(values: Mapping[str, float]) -> dict[str, float] | float:
    """By regular expression of the joint; one number where all are alike."""
    alike = set(values.values())
    return alike.pop() if len(alike) == 1 else {re.escape(joint): value for joint, value in values.items()}


_DRAWS_END = 3.0
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
    normal = (normal @ _root(_correlation(drives, labels)).T).clamp(-_DRAWS_END, _DRAWS_END)
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
