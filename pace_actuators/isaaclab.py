"""The identified drive as an actuator of Isaac Lab 3.0, and of 2.3; never imported by default.

    ArticulationCfg(actuators={"legs": PaceDCMotorActuatorCfg.from_result("result.json", physics_dt=0.005, …)}, …)

What differs there, and is converted here:

- **Bias.** Isaac Lab has none: position targets are in the encoder's coordinates, q_enc = q - bias, and the policy must
  see the encoder too: observe :func:`encoder_pos_rel` instead of ``mdp.joint_pos_rel``.
- **Delay.** Isaac Lab's ``DelayedPDActuator`` delays commands by whole physics steps. Here ``PaceDCMotor`` delays,
  commands or torque, by any time.
- **Friction.** Since Isaac Sim 5 PhysX takes Coulomb friction in N m, static and dynamic (alike here), and viscous
  friction. Before, friction is a coefficient that scales with the joint's load: it cannot hold what was identified.
  Newton's MuJoCo solver (3.0) takes it as MuJoCo's frictionloss, with a separate time constant.
- **Joint parameters.** 2.3 reads armature and friction from the actuator. 3.0 reads them from its configuration before
  the actuator exists: the configuration takes them over from the drive.
- **Limits of the solver.** 3.0 leaves the asset's own effort limit in force after the actuator, 2.3 lifts it. It is
  lifted in both (``joint_effort_limit``): the drive has limited its torque.
- **Newton's actuators.** 3.0 with ``use_newton_actuators`` only runs actuators that USD can hold, and refuses this one:
  leave it off, or take what ``export --format newton`` writes.
- **Drives that change friction at every step**, by an effect or a continuous loop (``implicit``), need
  :class:`DriveFrictionMixin` and are refused without it.
"""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, field
from pathlib import Path
from typing import Any

import torch
from isaaclab.actuators import ActuatorBase, ActuatorBaseCfg
from isaaclab.utils import configclass

from pace_actuators.base_parameters import CARRIED
from pace_actuators.effects import effect_cfgs
from pace_actuators.identified import IdentifiedDrives
from pace_actuators.pace_dc_motor import PaceDCMotor
from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg
from pace_actuators.representable import ISAACLAB, check_representable, refuse_inertia

OF_CONFIGURATION = hasattr(ActuatorBaseCfg(), "actuator_effort_limit")
"""Whether this is Isaac Lab 3.0, which takes the joints' parameters from the configuration."""

_JOINT_PARAMETERS = (*CARRIED, "dynamic_friction")
_LIMITS = ("effort_limit", "velocity_limit", "actuator_effort_limit", "actuator_velocity_limit")
_NO_LIMIT = 1e9
"""What Isaac Lab 2.3 sets as the solver's effort limit of an explicit actuator [N m]."""


class PaceDCMotorActuator(ActuatorBase):  # type: ignore[misc]
    """Runs a :class:`PaceDCMotor` at every physics step; Isaac Lab's gains and limits are the drive's own tensors.

    Attributes:
        motor: The drive.
        friction_is_written: Whether the articulation writes the drive's friction at every step.
    """

    friction_is_written = False

    def __init__(
        self,
        cfg: Any,
        joint_names: list[str],
        joint_ids: slice | torch.Tensor,
        num_envs: int,
        device: str,
        stiffness: torch.Tensor | float = 0.0,
        damping: torch.Tensor | float = 0.0,
        armature: torch.Tensor | float = 0.0,
        friction: torch.Tensor | float = 0.0,
        dynamic_friction: torch.Tensor | float = 0.0,
        viscous_friction: torch.Tensor | float = 0.0,
        effort_limit: torch.Tensor | float = torch.inf,
        velocity_limit: torch.Tensor | float = torch.inf,
        actuator_effort_limit: torch.Tensor | float | None = None,
        actuator_velocity_limit: torch.Tensor | float | None = None,
    ):
        """Build the drive; the arguments are Isaac Lab's, of 2.3 and of 3.0."""
        own = ("stiffness", "damping", *(() if OF_CONFIGURATION else _JOINT_PARAMETERS), *_LIMITS)
        _refuse([name for name in own if getattr(cfg, name, None) is not None])
        effort_limit = effort_limit if actuator_effort_limit is None else actuator_effort_limit
        velocity_limit = velocity_limit if actuator_velocity_limit is None else actuator_velocity_limit
        passive = (armature, friction, dynamic_friction, viscous_friction)
        if OF_CONFIGURATION:
            super().__init__(cfg, joint_names, joint_ids, num_envs, device)
        else:
            given = (stiffness, damping, *passive, effort_limit, velocity_limit)
            super().__init__(cfg, joint_names, joint_ids, num_envs, device, *given)
        self.motor = (cfg.motor.class_type or PaceDCMotor)(
            cfg.motor,
            joint_names,
            joint_ids,
            num_envs,
            device,
            stiffness,
            damping,
            *passive,
            effort_limit,
            velocity_limit,
        )
        refuse_inertia(self.motor, ISAACLAB)
        motor = self.motor
        self.stiffness, self.damping = motor.stiffness, motor.damping  # Isaac Lab's events write into them
        if OF_CONFIGURATION:
            self.actuator_effort_limit, self.actuator_velocity_limit = motor.effort_limit, motor.velocity_limit
        else:
            self.effort_limit, self.velocity_limit = motor.effort_limit, motor.velocity_limit
        self.armature = motor.joint_armature.clone()
        self.friction, self.dynamic_friction = motor.joint_friction.clone(), motor.joint_friction.clone()
        self.viscous_friction = motor.joint_viscous_friction.clone()

    def reset(self, env_ids: Sequence[int] | torch.Tensor | slice | None = None) -> None:
        """Forget the history of some environments."""
        self.motor.reset(None if isinstance(env_ids, slice) and env_ids == slice(None) else env_ids)

    def compute(self, control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> Any:
        """Torques [N m] in ``joint_efforts``; targets are in the encoder's coordinates."""
        motor = self.motor
        if motor.changes_passive and not self.friction_is_written:
            raise ValueError(
                "The drive changes the joints' friction at every physics step (its effects, or implicit=True): "
                f"{ISAACLAB.friction_hook}. If your own articulation writes the friction, set friction_is_written of "
                "this actuator to True."
            )
        result = motor.compute(control_action, joint_pos, joint_vel)
        self.computed_effort, self.applied_effort = motor.computed_effort, motor.applied_effort
        return dataclasses.replace(result, joint_efforts=motor.held_effort)


@configclass
class PaceDCMotorActuatorCfg(ActuatorBaseCfg):  # type: ignore[misc]
    """A group of joints with the identified drive."""

    class_type: type = PaceDCMotorActuator
    """The actuator."""

    joint_names_expr: list[str] = []  # noqa: RUF012  # configclass makes it a separate field
    """Expressions of the joints; empty means those of ``motor``."""

    stiffness: dict[str, float] | float | None = None
    """Stays ``None``: the drive has it."""

    damping: dict[str, float] | float | None = None
    """Stays ``None``: the drive has it."""

    motor: PaceDCMotorCfg = field(default_factory=lambda: MISSING, metadata={"copy": False})  # type: ignore[assignment]
    """The drive, with ``physics_dt``, the simulation's ``dt``."""

    def __post_init__(self) -> None:
        """Take over the joints; and their parameters, where Isaac Lab looks for them here."""
        expr = self.motor.joint_names_expr
        self.joint_names_expr = self.joint_names_expr or ([expr] if isinstance(expr, str) else list(expr))
        if not OF_CONFIGURATION:
            return
        parameters = joint_parameters(self.motor)
        _refuse([name for name, value in parameters.items() if getattr(self, name) not in (None, value)])
        for name, value in parameters.items():
            setattr(self, name, value)
        if getattr(self, "joint_effort_limit", None) is None:
            self.joint_effort_limit = _NO_LIMIT

    @classmethod
    def from_result(
        cls, path: str | Path, joint_names_expr: str | Sequence[str] | None = None, **overrides: Any
    ) -> PaceDCMotorActuatorCfg:
        """The drive that a fit identified; see :meth:`PaceDCMotorCfg.from_result`. Give ``physics_dt``.

        What the simulator cannot represent, or only with help, is warned of.
        """
        motor = PaceDCMotorCfg.from_result(path, joint_names_expr, **overrides)
        for note in check_representable(IdentifiedDrives.load(path), ISAACLAB, motor.implicit):
            warnings.warn(note, stacklevel=2)
        return cls(motor=motor)


def joint_parameters(motor: PaceDCMotorCfg) -> dict[str, Any]:
    """What the simulator is to apply at the drive's joints, by number or by expression of the joint.

    Args:
        motor: The drive. Where its joints are named one by one, its effects count; with expressions, friction that an
            effect changes is written at every step (:class:`DriveFrictionMixin`).

    Returns:
        ``armature`` [kg m²], ``friction`` and ``dynamic_friction`` [N m], ``viscous_friction`` [N m s/rad]; those that
        the drive says nothing of are left out.
    """
    names = _literal_names(motor.joint_names_expr)
    known = {name: value for name in CARRIED if (value := getattr(motor, name)) is not None}
    if names is not None:
        dt = motor.physics_dt or 1.0
        alone = dataclasses.replace(motor, identified=None, physics_dt=dt, drive_dt=None, delay=0.0, delay_s=None)
        drive = (motor.class_type or PaceDCMotor)(alone, names, slice(None), 1)
        patterns = [re.escape(name) for name in names]
        found = {name: getattr(drive, f"joint_{name}")[0].tolist() for name in known}
        known = {name: dict(zip(patterns, values, strict=True)) for name, values in found.items()}
    else:
        single = [name for name, value in known.items() if not isinstance(value, (int, float, Mapping))]
        inertia = [e.effect_class.name for e in effect_cfgs(motor.effects) if e.effect_class.overrides("armature")]
        if single or inertia:
            raise ValueError(
                f"{', '.join(single + inertia)} of the drive cannot be read joint by joint from the expressions "
                f"{motor.joint_names_expr!r}. Name the joints one by one in joint_names_expr, in their order."
            )
    if "friction" in known:
        known["dynamic_friction"] = known["friction"]
    return known


class DriveFrictionMixin:
    """Lets the drives of an ``isaaclab.assets.Articulation`` change the joints' friction at every physics step.

        class PaceArticulation(DriveFrictionMixin, Articulation): ...
        ArticulationCfg(class_type=PaceArticulation, …)

    PhysX takes friction through the CPU: it costs a copy at every step, for the drives that need it only.
    """

    def _apply_actuator_model(self) -> None:
        """What Isaac Lab 2.3 calls at every physics step."""
        view = self.root_physx_view  # type: ignore[attr-defined]
        self._give_load(view.get_gravity_compensation_forces, view.get_coriolis_and_centrifugal_compensation_forces)
        super()._apply_actuator_model()  # type: ignore[misc]
        self._write_friction()

    def write_data_to_sim(self) -> None:
        """What Isaac Lab calls at every physics step; from 3.0 on the actuators run in it."""
        if OF_CONFIGURATION:
            self._give_load(lambda: self.data.gravity_compensation_forces.torch)  # type: ignore[attr-defined]
        super().write_data_to_sim()  # type: ignore[misc]
        if OF_CONFIGURATION:
            self._write_friction()

    @property
    def _drives(self) -> list[PaceDCMotorActuator]:
        actuators: Mapping[str, Any] = self.actuators  # type: ignore[attr-defined]
        return [each for each in actuators.values() if isinstance(each, PaceDCMotorActuator)]

    def _give_load(self, *held_by: Any) -> None:
        """Give the drives the load on their joints; their friction follows."""
        for drive in self._drives:
            drive.friction_is_written = True
        if any(drive.motor.needs_load for drive in self._drives):
            count = self.num_joints  # type: ignore[attr-defined]
            load = -sum(held() for held in held_by)[:, -count:]  # a floating base's own come first
            for drive in self._drives:
                drive.motor.set_load_effort(load[:, drive.joint_indices])

    def _write_friction(self) -> None:
        name = "write_joint_friction_coefficient_to_sim"
        write = getattr(self, f"{name}_index" if OF_CONFIGURATION else name)
        for drive in self._drives:
            if drive.motor.changes_passive:
                friction, implicit = drive.motor.joint_friction, drive.motor.joint_implicit_damping
                viscous = drive.motor.joint_viscous_friction
                write(
                    joint_friction_coeff=friction,
                    joint_dynamic_friction_coeff=friction,
                    joint_viscous_friction_coeff=viscous if implicit is None else viscous + implicit,
                    joint_ids=_indices(drive.joint_indices),
                )


def encoder_pos_rel(env: Any, asset_name: str = "robot") -> torch.Tensor:
    """Observation: what the encoders show relative to the defaults, q - bias - q_default [rad]."""
    asset = env.scene[asset_name]
    joint_pos, joint_vel = _tensor(asset.data.joint_pos), _tensor(asset.data.joint_vel)
    position = joint_pos - _tensor(asset.data.default_joint_pos)
    for drive in asset.actuators.values():
        if isinstance(drive, PaceDCMotorActuator):
            own, motor = drive.joint_indices, drive.motor
            shown = motor.observe(joint_pos[:, own], joint_vel[:, own])
            position[:, own] += shown - joint_pos[:, own] - motor.encoder_bias
    return position


def _refuse(twice: Sequence[str]) -> None:
    if twice:
        raise ValueError(f"{', '.join(twice)} would act beside the drive's own. Set them in motor, a PaceDCMotorCfg.")


def _literal_names(expressions: str | Sequence[str]) -> list[str] | None:
    """The joints, where the expressions are their names; ``None`` where one could match another."""
    patterns = [expressions] if isinstance(expressions, str) else list(expressions)
    named = all(re.fullmatch(r"(?:[\w/ :-]|\\\W)+", pattern) for pattern in patterns)
    return [re.sub(r"\\(.)", r"\1", pattern) for pattern in patterns] if named else None


def _indices(joint_ids: Any) -> Any:
    return None if isinstance(joint_ids, slice) else joint_ids


def _tensor(array: Any) -> torch.Tensor:
    """Isaac Lab 3.0's ``ProxyArray`` as a tensor, 2.3's tensor as it is."""
    return array if isinstance(array, torch.Tensor) else array.torch
