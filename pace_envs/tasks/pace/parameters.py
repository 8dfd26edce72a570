"""What can be identified: parameters, their bounds and how they reach the simulation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import torch

from pace_actuators import match_names
from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.drive_result import ALL
from pace_actuators.effects import PROBED_STIFFNESS, effect_cfgs
from pace_actuators.effects.friction import DynamicFriction
from pace_actuators.joint_units import JointType, units_for
from pace_envs.link_inertia import NAMES, OF_BODY, PARTS, POSITIVE, PRIOR, UNITS, Reference, moved_by
from pace_envs.tasks.pace.pace_cfg import PaceCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv

GLOBAL = ALL
"""The key of a parameter that all joints share."""
TORQUE_SCALE, TORQUE_OFFSET = "torque_scale", "torque_offset"
"""Parameters of a sensor of torques."""
TORQUE_SCALE_STD = 0.1
"""Standard deviation of the scale's prior: motors' torque constants are known to a tenth."""
_TORQUE_SCALE = 5.0
"""How far from 1 a scale is sought, both ways."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One physical quantity, of every joint or of the whole robot."""

    name: str
    """Its name in results."""

    unit: str
    """Its unit."""

    lower: tuple[float, ...]
    """Lower bounds, one per key."""

    upper: tuple[float, ...]
    """Upper bounds, one per key."""

    apply: Callable[[Any, torch.Tensor], None]
    """Writes values of shape (num_envs, len(keys)) to an environment: ``apply(env, values)``."""

    keys: tuple[str, ...]
    """Joint names, or ``("all",)`` for one value of the whole robot."""

    scale: Literal["linear", "log"] = "linear"
    """How the optimizer's coordinate runs from the lower to the upper bound."""

    start: float | tuple[float, ...] | None = None
    """Where a search starts, one value or one per key; ``None``: in the middle of the bounds, on its scale."""

    units: tuple[str, ...] | None = None
    """Unit of each key, where they differ from ``unit``."""

    prior: float | None = None
    """Standard deviation of its prior in half a bound range, on its scale, around the middle; ``None``: it has none."""

    joints: tuple[str, ...] | None = None
    """The driven joint that moves what each key names, where keys are links; ``None``: keys are joints."""

    moves: bool = True
    """Whether it changes how the robot moves, and not only what a sensor shows."""

    per_joint_copies: bool = False
    """Whether ``apply`` of a shared parameter also takes one value per joint, (num_envs, num_joints)."""

    def unit_of(self, key: str) -> str:
        """The unit of one of its keys."""
        return self.unit if self.units is None else self.units[self.keys.index(key)]

    @property
    def shared(self) -> bool:
        """Whether it is one value of the whole robot."""
        return self.keys == (GLOBAL,)

    def __post_init__(self) -> None:
        """Check the bounds."""
        if not len(self.lower) == len(self.upper) == len(self.keys):
            raise ValueError(
                f"The parameter {self.name!r} has {len(self.lower)} lower and {len(self.upper)} upper bounds, "
                f"expected {len(self.keys)} of each: {', '.join(self.keys)}."
            )
        for key, low, high in zip(self.keys, self.lower, self.upper, strict=True):
            if not -math.inf < low <= high < math.inf:
                raise ValueError(
                    f"The bounds of {self.name!r} on {key} are ({low:g}, {high:g}), expected finite numbers, "
                    "lower <= upper."
                )
        if self.scale == "log" and min(self.lower) <= 0:
            raise ValueError(f"The bounds of {self.name!r} must be > 0: its scale is logarithmic.")


def base_parameters(cfg: PaceCfg) -> tuple[Parameter, ...]:
    """Armature, viscous friction, Coulomb friction and encoder bias of every joint, and the delay."""
    cfg.prepare()
    joints = tuple(cfg.joint_order)
    return tuple(
        Parameter(
            name=name,
            unit=parameter.unit,
            lower=tuple(cfg.bounds[name][:, 0].tolist()),
            upper=tuple(cfg.bounds[name][:, 1].tolist()),
            apply=partial(_apply_base, name=name),
            keys=(GLOBAL,) if parameter.shared else joints,
            start=_start(cfg, name, cfg.bounds[name]),
            units=None if parameter.shared else _units(parameter.unit, joints, cfg),
            per_joint_copies=parameter.shared,
        )
        for name, parameter in BASE_PARAMETERS.items()
    )


def _start(cfg: PaceCfg, name: str, bounds: torch.Tensor) -> tuple[float, ...] | None:
    """Where a base parameter begins, within its bounds (keys, 2); ``None``: in their middle."""
    if name not in cfg.start_params:
        return None
    given = cfg.start_params[name]
    values = [given[joint] for joint in cfg.joint_order] if isinstance(given, Mapping) else [given] * len(bounds)
    return tuple(min(max(value, low), high) for value, (low, high) in zip(values, bounds.tolist(), strict=True))


def effect_parameters(cfg: PaceCfg) -> tuple[Parameter, ...]:
    """The parameters of the effects that are identified beside the base ones, ``<effect>.<parameter>``."""
    joints = tuple(cfg.joint_order)
    result = []
    for effect in effect_cfgs(cfg.effects):
        if effect.env_rows is not None:  # only tried, side by side with others
            continue
        own = tuple(joint for joint in effect.joints(joints) if _type(joint, cfg) in effect.effect_class.joint_types)
        ids = [joints.index(joint) for joint in own]
        kind = effect.effect_class
        for parameter in kind.parameters:
            keys = (GLOBAL,) if effect.shared else own
            given = cfg.effect_bounds.get(f"{kind.name}.{parameter.name}", {})
            each = []
            for joint, i in zip(own, ids, strict=True):
                low, high = cfg.joint_ranges.get(joint, (0.0, 0.0))
                own_parameter = parameter.on_loop(cfg.joint_stiffness.get(joint, PROBED_STIFFNESS))
                lower, upper = own_parameter.reaching(low, high, cfg.joint_efforts.get(joint, math.inf))
                if kind is DynamicFriction:
                    lower, upper = cfg.friction_ratio_bounds
                elif effect.wide:
                    widest = own_parameter.widest(float(cfg.bounds["friction"][i, 1]))
                    lower, upper = min(lower, widest[0]), max(upper, widest[1])
                each.append(given.get(joint, (lower, min(max(own_parameter.start, lower), upper), upper)))
            if effect.shared and each:
                lows, starts, highs = zip(*each, strict=True)
                each = [(min(lows), sum(starts) / len(starts), max(highs))]
            result.append(
                Parameter(
                    name=f"{kind.name}.{parameter.name}",
                    unit=parameter.unit,
                    lower=tuple(low for low, _, _ in each),
                    upper=tuple(high for _, _, high in each),
                    apply=partial(_apply_effect, effect=kind.name, parameter=parameter.name, joint_ids=ids),
                    keys=keys,
                    scale=parameter.scale,
                    units=_units(parameter.unit, own if effect.shared else keys, cfg)[: len(keys)],
                    start=tuple(at for _, at, _ in each),
                )
            )
    return tuple(result)


def link_parameters(cfg: PaceCfg) -> tuple[Parameter, ...]:
    """The inertial parameters of the links that are identified: see :mod:`pace_envs.link_inertia`."""
    result = []
    for name in NAMES:
        own = [link for link in cfg.links if name in link.names]
        if not own:
            continue
        bounds = [link.bounds(name) for link in own]
        result.append(
            Parameter(
                name=name,
                unit=UNITS[name],
                lower=tuple(low for low, _ in bounds),
                upper=tuple(high for _, high in bounds),
                apply=partial(_apply_link, references=own, name=name),
                keys=tuple(link.link for link in own),
                scale="log" if name in POSITIVE else "linear",
                start=tuple(link.start(name) for link in own),
                prior=None if name in PARTS["load"] else PRIOR,
                joints=tuple(link.joint for link in own),
            )
        )
    return tuple(result)


def torque_parameters(cfg: PaceCfg) -> tuple[Parameter, ...]:
    """Of sensors of torques that a fit follows: scale s and offset o of what they show, s τ + o."""
    offsets = cfg.torque_offsets
    joints = tuple(joint for joint in cfg.joint_order if joint in offsets)
    if not joints:
        return ()

    def parameter(name: str, unit: str, bounds: Sequence[tuple[float, float, float]], **more: Any) -> Parameter:
        lower, start, upper = zip(*bounds, strict=True)
        return Parameter(
            name=name,
            unit=unit,
            lower=lower,
            upper=upper,
            start=start,
            keys=joints,
            units=_units(unit, joints, cfg),
            apply=_of_a_sensor,
            moves=False,
            **more,
        )

    prior = math.log1p(TORQUE_SCALE_STD) / math.log(_TORQUE_SCALE)
    scale = [(1 / _TORQUE_SCALE, 1.0, _TORQUE_SCALE)] * len(joints)
    offset = [offsets[joint] for joint in joints]
    return parameter(TORQUE_SCALE, "1", scale, scale="log", prior=prior), parameter(TORQUE_OFFSET, "N m", offset)


def sought_links(model: mujoco.MjModel, joints: Sequence[str], wanted: Sequence[str]) -> tuple[Reference, ...]:
    """The links whose inertial parameters are to be identified.

    Args:
        wanted: Regular expressions of links' names, each as ``NAME``, or ``NAME@mass,com,inertia,load`` with some of
            these.
    """
    named = [model.body(b).name for b in range(1, model.nbody) if model.body(b).name]
    moving = {name: moved_by(model, name, joints) for name in named}
    names = [name for name, joint in moving.items() if joint is not None and model.body(name).mass[0] > 0]
    found: dict[str, tuple[str, ...]] = {}
    for text in wanted:
        pattern, at, parts = text.rpartition("@")
        pattern, chosen = (pattern, parts.split(",")) if at else (text, list(OF_BODY))
        if unknown := [part for part in chosen if part not in PARTS]:
            raise ValueError(
                f"--links {text!r} names {unknown[0]!r}. Available: {', '.join(PARTS)}; as in {pattern}@mass,com."
            )
        own = tuple(name for part in PARTS if part in chosen for name in PARTS[part])
        for group in match_names([pattern], names, what="moving link with a mass"):
            found |= {names[i]: own for i in group}
    return tuple(
        Reference.of(model, name, joint=moving[name] or "", names=found[name]) for name in names if name in found
    )


def _type(joint: str, cfg: PaceCfg) -> JointType:
    return "slide" if joint in cfg.slide_joints else "hinge"


def _units(unit: str, joints: Sequence[str], cfg: PaceCfg) -> tuple[str, ...]:
    """A hinge's unit for each of some joints."""
    return tuple(units_for(unit, [_type(joint, cfg)]) for joint in joints)


def _apply_effect(
    env: ManagerBasedEnv, values: torch.Tensor, *, effect: str, parameter: str, joint_ids: list[int]
) -> None:
    env.scene["robot"].write_effect_parameter_to_sim(effect, parameter, values, joint_ids)


def _of_a_sensor(env: ManagerBasedEnv, values: torch.Tensor) -> None:
    """Nothing: what a sensor shows does not move the robot."""


def _apply_link(env: ManagerBasedEnv, values: torch.Tensor, *, references: Sequence[Reference], name: str) -> None:
    env.scene["robot"].write_link_parameter_to_sim(references, name, values)


def _apply_base(env: ManagerBasedEnv, values: torch.Tensor, *, name: str) -> None:
    env.scene["robot"].write_base_parameter_to_sim(name, values)
