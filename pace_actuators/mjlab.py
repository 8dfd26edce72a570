"""The identified drive as an actuator of mjlab 1.6; never imported by default.

    EntityArticulationInfoCfg(actuators=(PaceDCMotorActuatorCfg.from_result("result.json", stiffness=…, damping=…),))

What differs there, and is converted here:

- **Bias.** mjlab's encoder shows q + b, PACE's q - bias, so b = -bias. It is written to ``entity.data.encoder_bias``;
  mjlab's observations and its ``JointPositionAction`` take it into account. Position targets that you set by hand are
  true joint positions in mjlab.
- **Delay.** mjlab delays commands by whole physics steps. Here ``PaceDCMotor`` delays, commands or torque, by any time;
  mjlab's own ``delay_*`` must stay 0.
- **Joint parameters.** Armature, frictionloss and damping are written into the model, joint by joint, and the solver's
  time constant of frictionloss, whose default is soft.
- **Resets.** mjlab runs the actuators of all environments once more when some are reset, without a physics step. Such a
  call leaves no trace in the drive's history.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from mjlab.actuator import Actuator, ActuatorCfg, ActuatorCmd
from mjlab.managers.event_manager import EventTermCfg, requires_model_fields
from mjlab.utils.spec import create_motor_actuator, get_non_free_joints

from pace_actuators.actions import ActuatorActions
from pace_actuators.effects.fading_friction import solver_parameters, step_of_constraint
from pace_actuators.identified import IdentifiedDrives
from pace_actuators.pace_dc_motor import PaceDCMotor
from pace_actuators.pace_dc_motor_cfg import DriveParameters, PaceDCMotorCfg
from pace_actuators.representable import MJLAB, check_representable, refuse_inertia

_SMALLEST_FRICTION = 1e-9
"""Where friction changes from step to step, the model must have some from the start [N m]."""


@dataclass(kw_only=True)
class PaceDCMotorActuatorCfg(ActuatorCfg):  # type: ignore[misc]
    """A group of joints with the identified drive."""

    motor: PaceDCMotorCfg
    """The drive; its ``physics_dt`` is the simulation's unless it has one."""

    target_names_expr: tuple[str, ...] = ()
    """Expressions of the joints; empty means those of ``motor``."""

    friction_timeconst: float | None = None
    """Time constant of the joints' Coulomb friction [s]; ``None``: two physics steps, as in identification."""

    friction_impedance: float = 0.999
    """Impedance of the joints' Coulomb friction, as in identification."""

    def __post_init__(self) -> None:
        """Take over the joints; refuse what would act twice."""
        expr = self.motor.joint_names_expr
        self.target_names_expr = self.target_names_expr or ((expr,) if isinstance(expr, str) else tuple(expr))
        super().__post_init__()
        twice = [n for n in ("armature", "frictionloss", "viscous_damping") if getattr(self, n) is not None]
        twice += ["delay_max_lag"] if self.delay_max_lag else []
        if twice:
            raise ValueError(
                f"{', '.join(twice)} would act beside the drive's own. Set them in motor, a PaceDCMotorCfg."
            )

    @classmethod
    def from_result(
        cls, path: str | Path, joint_names_expr: str | Sequence[str] | None = None, **overrides: Any
    ) -> PaceDCMotorActuatorCfg:
        """The drive that a fit identified; see :meth:`PaceDCMotorCfg.from_result`.

        What the simulator cannot represent, or only with help, is warned of.
        """
        motor = PaceDCMotorCfg.from_result(path, joint_names_expr, **overrides)
        for note in check_representable(IdentifiedDrives.load(path), MJLAB, motor.implicit):
            warnings.warn(note, stacklevel=2)
        return cls(motor=motor)

    def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> PaceDCMotorActuator:
        """What mjlab calls."""
        return PaceDCMotorActuator(self, entity, target_ids, target_names)


class PaceDCMotorActuator(Actuator):  # type: ignore[misc]
    """Runs a :class:`PaceDCMotor` at every physics step.

    Attributes:
        motor: The drive, once the simulation exists; its ``encoder_bias`` is 0, the bias is in ``entity.data``.
    """

    motor: PaceDCMotor

    def __init__(
        self, cfg: PaceDCMotorActuatorCfg, entity: Any, target_ids: list[int], target_names: list[str]
    ) -> None:
        """Keep the names; read the model's own joint parameters, which hold where the drive says none."""
        super().__init__(cfg, entity, target_ids, target_names)
        joints = get_non_free_joints(entity.spec)
        self._joints = [joints[i] for i in target_ids]
        self._of_model = {
            "armature": torch.tensor([float(joint.armature) for joint in self._joints]),
            "friction": torch.tensor([float(joint.frictionloss) for joint in self._joints]),
            "viscous_friction": torch.tensor([_first(joint.damping) for joint in self._joints]),
        }
        self._before: dict[str, Any] | None = None
        self._was_reset = True
        self._bias_written = False

    def edit_spec(self, spec: Any, target_names: list[str]) -> None:
        """Add a motor to each joint, and give the joint the drive's inertia and friction."""
        at_rest = self._make(1, "cpu", self.cfg.motor.physics_dt or 1.0, quiet=True)
        names = [joint.name for joint in self._joints]
        for name in target_names:
            i, joint = names.index(name), spec.joint(name)
            actuator = create_motor_actuator(spec, name, effort_limit=1.0, transmission_type=self.cfg.transmission_type)
            actuator.forcelimited = actuator.ctrllimited = False  # the drive has limited its torque
            self._mjs_actuators.append(actuator)
            friction = float(at_rest.joint_friction[0, i])
            joint.armature = float(at_rest.joint_armature[0, i])
            joint.frictionloss = max(friction, _SMALLEST_FRICTION) if at_rest.changes_passive else friction
            joint.damping[0] = float(at_rest.joint_viscous_friction[0, i])

    def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
        """Build the drive of all environments."""
        super().initialize(mj_model, model, data, device)
        dt = float(mj_model.opt.timestep)
        self.motor = self._make(data.nworld, device, self.cfg.motor.physics_dt or dt)
        if abs((self.cfg.motor.physics_dt or dt) - dt) > 1e-9:
            raise ValueError(
                f"The drive's physics_dt is {self.cfg.motor.physics_dt:g} s, the simulation's time step {dt:g} s. "
                "Leave physics_dt out."
            )
        refuse_inertia(self.motor, MJLAB)
        self._model, self._data = model, data
        self._dofs = self.entity.indexing.joint_v_adr[self.target_ids]
        parameters = DriveParameters(self.cfg.motor, self._target_names, 1, torch.device(device), torch.float64)
        self._bias = parameters.read("encoder_bias", 0.0)[0]
        timeconst = 2 * dt if self.cfg.friction_timeconst is None else self.cfg.friction_timeconst
        impedance, soft = self.cfg.friction_impedance, self.motor.joint_friction_time
        solref = torch.tensor([[timeconst, 1.0]], device=device).repeat(len(self._dofs), 1)
        solimp = torch.tensor([[impedance, impedance, 0.001, 0.5, 2.0]], device=device).repeat(len(self._dofs), 1)
        if soft is not None:  # the same in all environments
            own = (soft[0] > 0).nonzero()[:, 0]
            constants, impedances = solver_parameters(*step_of_constraint(soft[0, own], dt))
            solref[own, 0], solimp[own, :2] = constants, impedances[:, None]
        for field, value in (("dof_solref", solref), ("dof_solimp", solimp)):
            getattr(mj_model, field)[self._dofs.cpu().numpy()] = value.cpu().numpy()
            array = getattr(model, field)
            for world in range(1 if array.stride(0) == 0 else array.shape[0]):
                array[world, self._dofs] = value

    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Torques [N m], (num_envs, num_joints); writes friction where an effect changes it."""
        self._take_back()
        self._write_bias()
        if self._was_reset:
            self._before, self._was_reset = self.motor.snapshot(), False
        motor = self.motor
        if motor.needs_load:
            motor.set_load_effort(-self._data.qfrc_bias[:, self._dofs])
        motor.compute(ActuatorActions(cmd.position_target, cmd.velocity_target, cmd.effort_target), cmd.pos, cmd.vel)
        if motor.changes_passive:
            self._write_friction()
        return motor.held_effort

    def update(self, dt: float) -> None:
        """A physics step was made: the last call of :meth:`compute` counts."""
        self._before = None

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Forget the history of some environments."""
        super().reset(env_ids)
        self._take_back()
        self._write_bias()
        self.motor.reset(None if env_ids == slice(None) else env_ids)
        self._was_reset = True

    def _make(self, num_envs: int, device: str, physics_dt: float, quiet: bool = False) -> PaceDCMotor:
        changes: dict[str, Any] = {"encoder_bias": 0.0, "physics_dt": physics_dt}
        cfg = dataclasses.replace(self.cfg.motor, **changes | ({"identified": None, "drive_dt": None} if quiet else {}))
        of_model: dict[str, Any] = {name: value.to(device) for name, value in self._of_model.items()}
        return (cfg.class_type or PaceDCMotor)(cfg, self._target_names, slice(None), num_envs, device, **of_model)

    def _take_back(self) -> None:
        """Undo the last call of :meth:`compute` if no physics step followed it."""
        if self._before is not None:
            self.motor.restore(self._before)
            self._before, self._was_reset = None, True

    def _write_bias(self) -> None:
        """Once, on top of what mjlab's own randomisation at startup has drawn."""
        if not self._bias_written:
            self.entity.data.encoder_bias[:, self.target_ids] -= self._bias.to(torch.float)
            self._bias_written = True

    def _write_friction(self) -> None:
        for field, value in (
            ("dof_frictionloss", self.motor.joint_friction),
            ("dof_damping", _sum(self.motor.joint_viscous_friction, self.motor.joint_implicit_damping)),
        ):
            array = getattr(self._model, field)
            if len(value) > 1 and (array.shape[0] == 1 or array.stride(0) == 0):
                raise ValueError(
                    "An effect of the drive changes the joints' friction in every environment, and the model has one "
                    "for all: add events['drive_friction'] = drive_friction_event() of pace_actuators.mjlab."
                )
            array[:, self._dofs] = value


@requires_model_fields("dof_frictionloss", "dof_damping")
def expand_drive_friction(env: Any, env_ids: torch.Tensor | None) -> None:
    """Does nothing itself; its presence gives every environment a separate friction."""


def drive_friction_event() -> EventTermCfg:
    """The event that drives with effects on friction or transmission need."""
    return EventTermCfg(func=expand_drive_friction, mode="startup")


def _first(damping: Any) -> float:
    """A joint's linear damping: MuJoCo 3.11 has a polynomial."""
    return float(damping[0]) if hasattr(damping, "__len__") else float(damping)


def _sum(a: torch.Tensor, b: torch.Tensor | None) -> torch.Tensor:
    return a if b is None else a + b
