"""The identified drive as an actuator of Isaac Lab 2.3; never imported by default.

    ArticulationCfg(actuators={"legs": PaceDCMotorActuatorCfg.from_result("result.json", physics_dt=0.005, …)}, …)

What differs there, and is converted here:

- **Bias.** Isaac Lab has none: position targets are in the encoder's coordinates, q_enc = q - bias, and the policy must
  see the encoder too: observe :func:`encoder_pos_rel` instead of ``mdp.joint_pos_rel``.
- **Delay.** Isaac Lab's ``DelayedPDActuator`` delays commands by whole physics steps. Here ``PaceDCMotor`` delays,
  commands or torque, by any time.
- **Friction.** Since Isaac Sim 5 PhysX takes Coulomb friction in N m, static and dynamic (alike here), and viscous
  friction. Before, friction is a coefficient that scales with the joint's load: it cannot hold what was identified.
- **Effects that change friction at every step** need :class:`DriveFrictionMixin`.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import Any

import torch
from isaaclab.actuators import ActuatorBase, ActuatorBaseCfg
from isaaclab.utils import configclass

from pace_actuators.identified import IdentifiedDrives
from pace_actuators.pace_dc_motor import PaceDCMotor
from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg
from pace_actuators.representable import ISAACLAB, check_representable, refuse_inertia


class PaceDCMotorActuator(ActuatorBase):  # type: ignore[misc]
    """Runs a :class:`PaceDCMotor` at every physics step; Isaac Lab's gains and limits are the drive's own tensors.

    Attributes:
        motor: The drive.
    """

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
    ):
        """Build the drive; the arguments are Isaac Lab's.

        Raises:
            ValueError: If the drive's configuration is unusable, or Isaac Lab's own parameters are set beside it.
        """
        own = ("stiffness", "damping", "armature", "friction", "dynamic_friction", "viscous_friction")
        twice = [name for name in (*own, "effort_limit", "velocity_limit") if getattr(cfg, name) is not None]
        if twice:
            raise ValueError(
                f"{', '.join(twice)} would act beside the drive's own. Set them in motor, a PaceDCMotorCfg."
            )
        given = (armature, friction, dynamic_friction, viscous_friction, effort_limit, velocity_limit)
        super().__init__(cfg, joint_names, joint_ids, num_envs, device, stiffness, damping, *given)
        self.motor = (cfg.motor.class_type or PaceDCMotor)(
            cfg.motor, joint_names, joint_ids, num_envs, device, stiffness, damping, *given
        )
        refuse_inertia(self.motor, ISAACLAB)
        motor = self.motor
        self.stiffness, self.damping = motor.stiffness, motor.damping  # Isaac Lab's events write into them
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
        result = motor.compute(control_action, joint_pos, joint_vel)
        self.computed_effort, self.applied_effort = motor.computed_effort, motor.applied_effort
        return dataclasses.replace(result, joint_efforts=motor.held_effort)


@configclass
class PaceDCMotorActuatorCfg(ActuatorBaseCfg):  # type: ignore[misc]
    """A group of joints with the identified drive."""

    class_type: type = PaceDCMotorActuator
    """The actuator."""

    joint_names_expr: list[str] = []  # noqa: RUF012  # configclass makes it a field of its own
    """Expressions of the joints; empty means those of ``motor``."""

    stiffness: dict[str, float] | float | None = None
    """Stays ``None``: the drive has it."""

    damping: dict[str, float] | float | None = None
    """Stays ``None``: the drive has it."""

    motor: PaceDCMotorCfg = MISSING  # type: ignore[assignment]
    """The drive, with ``physics_dt``, the simulation's ``dt``."""

    def __post_init__(self) -> None:
        """Take over the joints."""
        expr = self.motor.joint_names_expr
        self.joint_names_expr = self.joint_names_expr or ([expr] if isinstance(expr, str) else list(expr))

    @classmethod
    def from_result(
        cls, path: str | Path, joint_names_expr: str | Sequence[str] | None = None, **overrides: Any
    ) -> PaceDCMotorActuatorCfg:
        """The drive that a fit identified; see :meth:`PaceDCMotorCfg.from_result`. Give ``physics_dt``.

        What the simulator cannot represent, or only with help, is warned of.

        Raises:
            ValueError: If the result is unusable, or an effect cannot be represented at all.
        """
        for note in check_representable(IdentifiedDrives.load(path), ISAACLAB):
            warnings.warn(note, stacklevel=2)
        return cls(motor=PaceDCMotorCfg.from_result(path, joint_names_expr, **overrides))


class DriveFrictionMixin:
    """Lets the drives of an ``isaaclab.assets.Articulation`` change the joints' friction at every physics step.

        class PaceArticulation(DriveFrictionMixin, Articulation): ...
        ArticulationCfg(class_type=PaceArticulation, …)

    PhysX takes friction through the CPU: it costs a copy at every step, for the drives that need it only.
    """

    def _apply_actuator_model(self) -> None:
        """Give the drives the load on their joints, run them, write their friction."""
        actuators: dict[str, Any] = self.actuators  # type: ignore[attr-defined]
        drives = [each for each in actuators.values() if isinstance(each, PaceDCMotorActuator)]
        if any(drive.motor.needs_load for drive in drives):
            view = self.root_physx_view  # type: ignore[attr-defined]
            count = self.num_joints  # type: ignore[attr-defined]
            held = view.get_gravity_compensation_forces() + view.get_coriolis_and_centrifugal_compensation_forces()
            load = -held[:, -count:]  # a floating base's own come first
            for drive in drives:
                drive.motor.set_load_effort(load[:, drive.joint_indices])
        super()._apply_actuator_model()  # type: ignore[misc]
        for drive in drives:
            if drive.motor.changes_passive:
                friction, implicit = drive.motor.joint_friction, drive.motor.joint_implicit_damping
                viscous = drive.motor.joint_viscous_friction
                self.write_joint_friction_coefficient_to_sim(  # type: ignore[attr-defined]
                    friction,
                    joint_dynamic_friction_coeff=friction,
                    joint_viscous_friction_coeff=viscous if implicit is None else viscous + implicit,
                    joint_ids=drive.joint_indices,
                )


def encoder_pos_rel(env: Any, asset_name: str = "robot") -> torch.Tensor:
    """Observation: what the encoders show relative to the defaults, q - bias - q_default [rad]."""
    asset = env.scene[asset_name]
    position = asset.data.joint_pos - asset.data.default_joint_pos
    for drive in asset.actuators.values():
        if isinstance(drive, PaceDCMotorActuator):
            own, motor = drive.joint_indices, drive.motor
            shown = motor.observe(asset.data.joint_pos[:, own], asset.data.joint_vel[:, own])
            position[:, own] += shown - asset.data.joint_pos[:, own] - motor.encoder_bias
    return position
