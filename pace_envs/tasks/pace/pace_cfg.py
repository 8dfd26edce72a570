"""What identification needs to know of a robot."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch

from pace_actuators.base_parameters import BASE_PARAMETERS, PER_JOINT
from pace_actuators.config import Config
from pace_actuators.effects import EffectCfg
from pace_actuators.joint_values import resolve_joint_values
from pace_envs.link_inertia import Reference


@dataclass(kw_only=True)
class ExcitationCfg(Config):
    """How the robot is moved for a recording: target = (signal + bias) * direction * scale, per joint."""

    bias: tuple[float, ...]
    """Centre of the motion before scaling, one per joint."""

    direction: tuple[float, ...]
    """+1 or -1, one per joint."""

    scale: tuple[float, ...]
    """Amplitude [rad] of a signal that runs from -1 to 1, one per joint."""


@dataclass(kw_only=True)
class PaceCfg(Config):
    """Names, bounds and motion of a robot's identification."""

    robot_name: str
    """Name of the robot; runs are kept under it."""

    data_dir: str | Path
    """The recording that is used when no other is named; a relative path that is not there is one under ``data/``, as
    in PACE."""

    joint_order: tuple[str, ...]
    """The joints, in the order of every vector."""

    bounds: Mapping[str, Any] = field(default_factory=dict)
    """Lower and upper bound of each base parameter by name: armature [kg m^2], viscous_friction [N m s/rad],
    friction [N m] and encoder_bias [rad] of the joints, delay [control steps]. A pair for all joints, a dict of
    regular expression to pair, or one pair per joint; once prepared, tensors (n, 2), of the delay (1, 2)."""

    bounds_params: torch.Tensor | None = None
    """The same as PACE writes it, (4n+1, 2): armature, viscous friction, friction and bias of every joint, then the
    delay. It becomes ``bounds`` and is ``None`` once prepared."""

    cmaes: Any = None
    """Settings of the search, as PACE has them here: a ``pace_optim.CMAESOptimizerCfg``; ``None``: its defaults."""

    excitation: ExcitationCfg | None = None
    """How the robot is moved for a recording; ``None`` if it is only fitted to given ones."""

    sample_params: Mapping[str, float | Mapping[str, float]] = field(default_factory=dict)
    """The true parameters of simulated recordings, by name: a number, or a number per joint."""

    start_params: Mapping[str, float | Mapping[str, float]] = field(default_factory=dict)
    """Where a fit begins, by name: a number, or a number per joint; in the middle of the bounds without."""

    effects: Sequence[EffectCfg | str] = ()
    """Physical effects identified beside the base parameters: ``"name"``, ``"name@joints"`` or ``"name@shared"``."""

    separate_dynamic_friction: bool = False
    """Whether friction at rest and while sliding are identified apart: ``friction`` is then that at rest, and
    ``dynamic_friction.ratio`` of every joint the sliding one's share of it (5n+1 parameters), as in PACE 0.2.0."""

    friction_ratio_bounds: tuple[float, float] = (0.0, 1.0)
    """Lower and upper bound of that ratio."""

    effect_bounds: Mapping[str, Mapping[str, tuple[float, float, float]]] = field(default_factory=dict)
    """Where an effect's parameters are sought, ``{"<effect>.<parameter>": {joint: (lower, start, upper)}}``, if not
    where the effect's own declaration says."""

    links: tuple[Reference, ...] = ()
    """Links whose inertial parameters are identified, as the model has them (:func:`~pace_envs.tasks.pace.sought_links`
    finds them)."""

    torque_offsets: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Joints whose measured torques a fit follows beside their positions, and where it seeks their sensors' offsets:
    ``{joint: (lower, start, upper)}`` [N m]."""

    extra_parameters: tuple[Any, ...] = ()
    """Custom parameters (:class:`~pace_envs.tasks.pace.Parameter`), identified beside the base ones."""

    apply_load: Callable[[Any, Any, Mapping[str, float]], None] | None = None
    """Writes a recording's ``load_mass`` [kg], ``load_length`` [m] and ``arm_mass`` [kg] to environments,
    as ``(env, env_ids, load)``; ``None`` if the robot carries no such load."""

    ee_site: str | None = None
    """The site or body of the model whose pose custom objectives compare with the series ``real_ee_pose``."""

    slide_joints: tuple[str, ...] = ()
    """Those of the joints that slide: their units are m, kg, N and N s/m. An environment finds them in its model."""

    joint_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Between which positions each joint moves [rad, of slides m]: its limits, else where recordings have it."""

    joint_efforts: Mapping[str, float] = field(default_factory=dict)
    """The largest torque of each joint's drive [N m, of slides N]: its limit, else by what recordings ask of it."""

    joint_stiffness: Mapping[str, float] = field(default_factory=dict)
    """The stiffness of each joint's position loop [N m/rad, of slides N/m]: what yields in its transmission is sought
    around it."""

    assumed_gains: tuple[str, ...] = ()
    """Joints whose gains are not stated: the gains of their drives are assumed."""

    physics_steps: int = 1
    """Physics steps in a control step that a fit takes without a ``physics_dt``; a search takes one."""

    notes: tuple[str, ...] = ()
    """What was assumed when this was made from a model file, in plain sentences; a fit prints them once."""

    @property
    def recording(self) -> Path:
        """Where the recording of ``data_dir`` is, or is to be written."""
        path = Path(self.data_dir)
        beside = path.is_absolute() or path.exists() or path.parts[:1] in ((), ("data",))
        return path if beside else "data" / path

    def prepare(self) -> None:
        """Check names and bounds; everything that uses the configuration calls this first.

        Raises:
            ValueError: If bounds, their number or a name are unusable.
        """
        self.joint_order = tuple(self.joint_order)
        if self.bounds_params is not None:
            self.bounds, self.bounds_params = _of_pace(self.bounds_params, len(self.joint_order)), None
        self.bounds = _by_name(self.bounds, self.joint_order)
        if unknown := sorted(set(self.start_params) - set(BASE_PARAMETERS)):
            raise ValueError(f"start_params names {', '.join(unknown)}. Available: {', '.join(BASE_PARAMETERS)}.")
        low, high = self.friction_ratio_bounds
        if not 0 <= low < high <= 1:
            raise ValueError(f"friction_ratio_bounds is ({low:g}, {high:g}), expected 0 <= lower < upper <= 1.")

    def replace(self, **changes: Any) -> PaceCfg:
        """A copy with other values of some fields; ``__post_init__``, which may fill ``bounds_params``, has run."""
        type(self).__new__(type(self), **changes)  # refuses unknown names
        result = copy.copy(self)
        for name, value in changes.items():
            setattr(result, name, value)
        return result

    def set_bounds(self, name: str, lower: Any = None, upper: Any = None) -> None:
        """Replace bounds of a parameter; ``None`` keeps them.

        Args:
            lower: A number, or one per joint.
        """
        low, high = self.bounds[name].unbind(dim=1)
        given = ((low, lower), (high, upper))
        ends = [old if new is None else torch.as_tensor(new, dtype=old.dtype).expand_as(old) for old, new in given]
        self.bounds = {**self.bounds, name: torch.stack(ends, dim=1)}

    def on_joints(self, joint_names: Sequence[str]) -> PaceCfg:
        """The same for some of the joints, in their order here; without effects, links and extra parameters."""
        self.prepare()
        kept = [i for i, name in enumerate(self.joint_order) if name in joint_names]
        names = tuple(self.joint_order[i] for i in kept)
        motion = self.excitation and {
            each.name: tuple(getattr(self.excitation, each.name)[i] for i in kept) for each in fields(ExcitationCfg)
        }
        return self.replace(
            joint_order=names,
            bounds={name: own[kept] if name in PER_JOINT else own for name, own in self.bounds.items()},
            excitation=ExcitationCfg(**motion) if motion else None,
            sample_params=_of_joints(self.sample_params, names),
            start_params=_of_joints(self.start_params, names),
            effect_bounds=_of_joints(self.effect_bounds, names),
            slide_joints=tuple(name for name in self.slide_joints if name in names),
            joint_ranges={name: each for name, each in self.joint_ranges.items() if name in names},
            joint_efforts={name: each for name, each in self.joint_efforts.items() if name in names},
            joint_stiffness={name: each for name, each in self.joint_stiffness.items() if name in names},
            assumed_gains=tuple(name for name in self.assumed_gains if name in names),
            effects=(),
            links=(),
            torque_offsets={},
            extra_parameters=(),
        )


def _of_joints(values: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Values by joint, of some of the joints; those of all joints as they are."""
    return {
        key: {name: each[name] for name in names if name in each} if isinstance(each, Mapping) else each
        for key, each in values.items()
    }


def _of_pace(bounds: Any, joints: int) -> dict[str, torch.Tensor]:
    """PACE's tensor of bounds, (4n+1, 2), by name."""
    rows = torch.as_tensor(bounds, dtype=torch.float64)
    counts = [1 if parameter.shared else joints for parameter in BASE_PARAMETERS.values()]
    if tuple(rows.shape) != (sum(counts), 2):
        raise ValueError(
            f"bounds_params has shape {tuple(rows.shape)}, expected {(sum(counts), 2)}: four parameters "
            f"for each of the {joints} joints in joint_order, then the delay. Declare another parameter "
            "in extra_parameters=(Parameter(name=…, unit=…, keys=joint_order, lower=…, upper=…, "
            "apply=function(env, values)),)."
        )
    return dict(zip(BASE_PARAMETERS, rows.split(counts), strict=True))


def _by_name(bounds: Mapping[str, Any], joints: Sequence[str]) -> dict[str, torch.Tensor]:
    """Bounds of every base parameter, {name: (n, 2)}, of the shared ones (1, 2)."""
    if set(bounds) != set(BASE_PARAMETERS):
        raise ValueError(
            f"bounds has {', '.join(bounds) or 'nothing'}, expected a pair (lower, upper) for each of "
            f"{', '.join(BASE_PARAMETERS)}."
        )
    result = {}
    for name, parameter in BASE_PARAMETERS.items():
        keys = ["all"] if parameter.shared else list(joints)
        result[name] = own = _pairs(bounds[name], keys, name)
        for key, (low, high) in zip(keys, own.tolist(), strict=True):
            if not low <= high:
                raise ValueError(f"bounds of {name} on {key} are ({low:g}, {high:g}), expected lower <= upper.")
    return result


def _pairs(given: Any, keys: list[str], name: str) -> torch.Tensor:
    """One pair per key, (keys, 2), of a pair for all, a dict of expressions, or pairs in order."""
    if isinstance(given, Mapping):
        ends = [{pattern: float(pair[end]) for pattern, pair in given.items()} for end in (0, 1)]
        return torch.stack([resolve_joint_values(end, keys, field=f"bounds of {name}") for end in ends], dim=1).double()
    pairs = torch.as_tensor(given, dtype=torch.float64)
    if pairs.shape not in ((2,), (len(keys), 2)):
        raise ValueError(
            f"bounds of {name} have shape {tuple(pairs.shape)}, expected one pair (lower, upper) or {(len(keys), 2)}."
        )
    return pairs.expand(len(keys), 2).clone()
