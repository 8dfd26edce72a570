"""What identification needs to know of a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch

from pace_actuators.config import Config
from pace_actuators.drive_result import BASE_FIELDS
from pace_actuators.effects import EffectCfg

PARAMETER_GROUPS = BASE_FIELDS
"""The parameters of each joint, in the order of the parameter vector; the delay follows them."""


@dataclass(kw_only=True)
class CMAESOptimizerCfg(Config):
    """Settings of the search."""

    per_tree: bool = True
    """Whether parts of the robot that do not move each other (legs on a fixed base) are searched apart."""

    max_iteration: int = 200
    """Largest number of generations."""

    epsilon: float | None = 1e-2
    """Stop when (max - min) / min of a generation's scores falls below this; ``None`` switches it off."""

    stop: Sequence[Any] = ()
    """Further rules that end the search, beside ``epsilon`` and ``max_iteration``: ``"plateau"``, ``"window"``,
    ``"gradient"``, ``"early_stopping"``, ``"parameters"`` or ``"target"``, with numbers as in
    ``"plateau:generations=30,improvement=0.01"``; or a rule of your own (``pace_optim.optimizers.convergence``)."""

    sigma: float = 0.5
    """Initial standard deviation, in normalised parameters (the bounds are -1 and 1)."""

    save_interval: int = 10
    """Generations between two saved means and checkpoints."""

    save_optimization_process: bool = False
    """Whether every generation's parameters and scores are kept in ``progress.pt``."""


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
    """Names, bounds and search settings of a robot's identification."""

    robot_name: str
    """Name of the robot; runs are kept under it."""

    data_dir: str | Path
    """The recording that is used when no other is named; a relative path that is not there is one under ``data/``, as
    in PACE."""

    joint_order: tuple[str, ...]
    """The joints, in the order of every vector."""

    bounds_params: torch.Tensor
    """Lower and upper bound of each parameter, (4n+1, 2): armature [kg m^2], viscous friction [N m s/rad],
    Coulomb friction [N m] and encoder bias [rad] of every joint, then the delay [control steps]."""

    cmaes: CMAESOptimizerCfg = field(default_factory=CMAESOptimizerCfg)
    """Settings of the search."""

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

    extra_parameters: tuple[Any, ...] = ()
    """Parameters of your own (:class:`~pace_envs.tasks.pace.Parameter`), identified beside the base ones."""

    apply_load: Callable[[Any, Any, Mapping[str, float]], None] | None = None
    """Writes a recording's ``load_mass`` [kg], ``load_length`` [m] and ``arm_mass`` [kg] to environments,
    as ``(env, env_ids, load)``; ``None`` if the robot carries no such load."""

    ee_site: str | None = None
    """The site or body of the model whose pose objectives of your own compare with the series ``real_ee_pose``."""

    slide_joints: tuple[str, ...] = ()
    """Those of the joints that slide: their units are m, kg, N and N s/m. An environment finds them in its model."""

    joint_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Between which positions each joint moves [rad, of slides m]: its limits, else where recordings have it."""

    assumed_gains: tuple[str, ...] = ()
    """Joints whose gains nobody has stated: those of their drives are assumed."""

    physics_steps: int = 1
    """Physics steps in a control step that a fit takes unless it is told a ``physics_dt``; a search takes one."""

    notes: tuple[str, ...] = ()
    """What was assumed when this was made from a model file, in plain sentences; told once when it is used."""

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
        expected = (4 * len(self.joint_order) + 1, 2)
        self.bounds_params = torch.as_tensor(self.bounds_params, dtype=torch.float64)
        if tuple(self.bounds_params.shape) != expected:
            raise ValueError(
                f"bounds_params has shape {tuple(self.bounds_params.shape)}, expected {expected}: four parameters "
                f"for each of the {len(self.joint_order)} joints in joint_order, then the delay. Declare a parameter "
                "of your own in extra_parameters=(Parameter(name=…, unit=…, keys=joint_order, lower=…, upper=…, "
                "apply=function(env, values)),)."
            )
        if unknown := sorted(set(self.start_params) - {*PARAMETER_GROUPS, "delay"}):
            raise ValueError(
                f"start_params names {', '.join(unknown)}. Available: {', '.join(PARAMETER_GROUPS)}, delay."
            )
        low, high = self.friction_ratio_bounds
        if not 0 <= low < high <= 1:
            raise ValueError(f"friction_ratio_bounds is ({low:g}, {high:g}), expected 0 <= lower < upper <= 1.")
        wrong = (~(self.bounds_params[:, 0] <= self.bounds_params[:, 1])).nonzero()[:, 0]
        if len(wrong):
            row = int(wrong[0])
            low, high = self.bounds_params[row].tolist()
            raise ValueError(f"bounds_params row {row} is ({low:g}, {high:g}), expected lower <= upper.")

    def on_joints(self, joint_names: Sequence[str]) -> PaceCfg:
        """The same for some of the joints, in their order here; effects and parameters of one's own are left out."""
        kept, n = [i for i, name in enumerate(self.joint_order) if name in joint_names], len(self.joint_order)
        rows = [group * n + i for group in range(len(PARAMETER_GROUPS)) for i in kept]
        names = tuple(self.joint_order[i] for i in kept)
        motion = self.excitation and {
            each.name: tuple(getattr(self.excitation, each.name)[i] for i in kept) for each in fields(ExcitationCfg)
        }
        return replace(
            self,
            joint_order=names,
            bounds_params=self.bounds_params[[*rows, -1]],
            excitation=ExcitationCfg(**motion) if motion else None,
            sample_params=_of_joints(self.sample_params, names),
            start_params=_of_joints(self.start_params, names),
            effect_bounds=_of_joints(self.effect_bounds, names),
            slide_joints=tuple(name for name in self.slide_joints if name in names),
            joint_ranges={name: each for name, each in self.joint_ranges.items() if name in names},
            assumed_gains=tuple(name for name in self.assumed_gains if name in names),
            effects=(),
            extra_parameters=(),
        )


def _of_joints(values: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Values by joint, of some of the joints; those of all joints as they are."""
    return {
        key: {name: each[name] for name in names if name in each} if isinstance(each, Mapping) else each
        for key, each in values.items()
    }


def make_bounds(
    joint_order: tuple[str, ...],
    *,
    armature: tuple[float, float],
    viscous_friction: tuple[float, float],
    friction: tuple[float, float],
    encoder_bias: tuple[float, float],
    delay: tuple[float, float],
) -> torch.Tensor:
    """``bounds_params`` with the same bounds for every joint, (4n+1, 2)."""
    n = len(joint_order)
    groups = [armature, viscous_friction, friction, encoder_bias]
    return torch.tensor([pair for pair in groups for _ in range(n)] + [delay], dtype=torch.float64)
