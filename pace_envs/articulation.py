"""A robot in the simulation: its drives are built and run, parameters and effects are written."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_actuators import ActuatorActions, PaceDCMotor
from pace_actuators.base_parameters import BASE_PARAMETERS, CARRIED
from pace_actuators.effects import Effect, effect_cfgs
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.indexing import EnvIds, JointIds, checked_values, indices, pick
from pace_envs.link_inertia import LinkInertias, Reference
from pace_envs.robot_state import RobotState
from pace_envs.simulation import Simulation

_RESOLVED = 1.0
"""Furthest that a joint with effects moves in a step [rad, m]. A torque within an effect's bounds may be more than a
small drive can hold; beyond this no motion is resolved, and forces that grow with the square of speeds bring in energy
without limit."""


class Articulation(RobotState):
    """A robot, batched over environments; every joint index is an index into ``joint_names``."""

    def __init__(self, cfg: ArticulationCfg, sim: Simulation):
        """Find the robot's joints in the simulation and build its drives.

        Args:
            sim: The simulation that holds the robot.

        Raises:
            ValueError: If names in the configuration do not fit the model.
        """
        super().__init__(cfg, sim)
        self._links = LinkInertias(sim, self._layout.driven.joints)
        self._columns: dict[PaceDCMotor, torch.Tensor] = {}
        self.note_torque: torch.Tensor | None = None
        """Gets the motors' torques [N m], (num_envs, n), when the drives next run."""
        self._build_actuators()
        self.reset()

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put all or some environments' robots back to their initial state and clear their drives."""
        self.reset_state(env_ids)
        self.reset_drives(env_ids if env_ids is None else self._sim.rows(env_ids))

    def reset_drives(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Let all or some environments' drives forget: indices, or (num_envs,) bool."""
        for actuator in self.actuators.values():
            actuator.reset(env_ids)

    def write_joint_armature_to_sim(
        self, armature: torch.Tensor | float, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Write armature [kg m^2], (len(env_ids), len(joint_ids)) or broadcastable."""
        self._write_carried("armature", armature, joint_ids, env_ids)

    def write_joint_viscous_friction_coefficient_to_sim(
        self,
        joint_viscous_friction_coeff: torch.Tensor | float,
        joint_ids: JointIds = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Write viscous friction [N m s/rad], (len(env_ids), len(joint_ids)) or broadcastable."""
        self._write_carried("viscous_friction", joint_viscous_friction_coeff, joint_ids, env_ids)

    def write_joint_friction_coefficient_to_sim(
        self, joint_friction_coeff: torch.Tensor | float, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Write Coulomb friction [N m], (len(env_ids), len(joint_ids)) or broadcastable."""
        self._write_carried("friction", joint_friction_coeff, joint_ids, env_ids)

    def write_base_parameter_to_sim(
        self, name: str, values: torch.Tensor, joint_ids: Sequence[int] | None = None
    ) -> None:
        """Write a base parameter of a fit: to the model where the joint carries it, else to the drives.

        Args:
            name: One of :data:`~pace_actuators.base_parameters.BASE_PARAMETERS`.
            values: In its unit, (num_envs, len(joint_ids)), or (num_envs, 1) for one delay of all those joints.
            joint_ids: The joints; ``None`` for all.
        """
        if BASE_PARAMETERS[name].mujoco is not None:
            self._write_carried(name, values, joint_ids, None)
            return
        wanted = list(range(self.num_joints)) if joint_ids is None else list(joint_ids)
        values = self._sim.tensor(values)
        for actuator in self.actuators.values():
            pairs = [(k, wanted.index(j)) for k, j in enumerate(self.joints_of(actuator)) if j in wanted]
            if pairs:
                local, chosen = (list(each) for each in zip(*pairs, strict=True))
                _WRITERS[name](actuator, values if values.shape[1] == 1 else values[:, chosen], local)

    def add_body_mass(
        self,
        name_keys: str | Sequence[str],
        mass: float,
        env_ids: EnvIds = None,
        place: Sequence[float] | None = None,
    ) -> None:
        """Add a known point mass to bodies [kg]; effects on the model and parameters of links do not change it.

        Args:
            mass: [kg].
            place: Where, in the body's frame, (3,) [m]; ``None``: at its centre of mass.
        """
        rows, (ids, _) = indices(env_ids), self.find_bodies(name_keys)
        self._links.add_load(ids, mass, place, rows)
        self._sim.constants_changed()

    def pseudo_inertias(self) -> dict[tuple[int, int], torch.Tensor]:
        """Of the bodies that joints move, {(body, joint): (num_envs, 4, 4)}, by index."""
        return self._links.pseudo_inertias()

    def write_link_parameter_to_sim(self, references: Sequence[Reference], name: str, values: torch.Tensor) -> None:
        """Write an inertial parameter of links.

        Args:
            name: One of :data:`~pace_envs.link_inertia.NAMES`.
            values: In its unit, (num_envs, len(references)).
        """
        for reference, value in zip(references, values.unbind(dim=1), strict=True):
            self._links.write_parameter(reference, name, value)
        self._sim.constants_changed()

    def write_data_to_sim(self) -> None:
        """Run the drives on the present targets and state, and apply their torques."""
        data, noted, self.note_torque = self.data, self.note_torque, None
        for actuator in self.actuators.values():
            ids, place = actuator.joint_indices, self._place_of(actuator)
            self._tell_link(actuator)
            action = ActuatorActions(
                pick(data.joint_pos_target, ids),
                pick(data.joint_vel_target, ids),
                pick(data.joint_effort_target, ids),
            )
            efforts = actuator.compute(action, pick(data.joint_pos, ids), pick(data.joint_vel, ids)).joint_efforts
            if isinstance(ids, slice):  # the only group: it drives every joint
                data.computed_torque, data.applied_torque = actuator.computed_effort, efforts
            else:
                data.computed_torque[:, ids] = actuator.computed_effort
                data.applied_torque[:, ids] = efforts
            if noted is not None:
                noted[:, ids] = actuator.motor_effort
            self._sim.qfrc_applied[:, place] = actuator.held_effort
            if actuator.changes_passive or actuator.changes_armature:
                self._write_what_drags(actuator, place)

    def update(self) -> None:
        """Read the state after a physics step; joints that effects have thrown are slowed to what a step resolves."""
        for actuator in self.actuators.values():
            if actuator.effects is not None and actuator.effects.effects:
                self._slow_down(self._place_of(actuator), _RESOLVED / self._sim.cfg.dt)
        self._refresh()

    @property
    def effects(self) -> list[str]:
        """Names of the effects of all drives."""
        stacks = [actuator.effects for actuator in self.actuators.values() if actuator.effects is not None]
        return list(dict.fromkeys(effect.name for stack in stacks for effect in stack.effects))

    def sensed_joint_pos(self) -> torch.Tensor:
        """What the encoders show before their bias is subtracted [rad], (num_envs, num_joints)."""
        distorted = [actuator for actuator in self.actuators.values() if actuator.distorts_measurement]
        if not distorted:
            return self.data.joint_pos
        result = self.data.joint_pos.clone()
        for actuator in distorted:
            ids = actuator.joint_indices
            self._tell_link(actuator)
            result[:, ids] = actuator.observe(pick(self.data.joint_pos, ids), pick(self.data.joint_vel, ids))
        return result

    def held(
        self, position: torch.Tensor, speed: torch.Tensor, free: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """State of the joints where encoders show a position [rad] and a speed [rad/s] before their bias.

        What lies between encoders and joints is put there, too: write the state before the next step.

        Args:
            position: (num_envs, num_joints).
            speed: (num_envs, num_joints).
            free: Joints that stay as they are, (num_envs, num_joints) bool.
        """
        now, position, speed = self.data, position.clone(), speed.clone()
        for actuator in self.actuators.values():
            self._tell_link(actuator)
            state, ids = (now.joint_pos, now.joint_vel, position, speed, free), actuator.joint_indices
            position[:, ids], speed[:, ids] = actuator.held(*(pick(each, ids) for each in state))
        return torch.where(free, now.joint_pos, position), torch.where(free, now.joint_vel, speed)

    def joint_pos_that_shows(self, encoder_pos: torch.Tensor) -> torch.Tensor:
        """Joint positions at which the encoders, just reset, show values before their bias: inverse of sensing.

        Args:
            encoder_pos: [rad], (num_envs, num_joints).
        """
        result = encoder_pos.clone()
        for actuator in self.actuators.values():
            self._tell_link(actuator)
            ids = actuator.joint_indices
            result[:, ids] = actuator.position_that_shows(pick(encoder_pos, ids))
        return result

    def write_effect_parameter_to_sim(
        self,
        effect: str,
        parameter: str,
        values: torch.Tensor,
        joint_ids: Sequence[int] | None = None,
    ) -> None:
        """Write a parameter of an effect to the drives that have it.

        Args:
            values: (num_envs, len(joint_ids)), or (num_envs, 1) for one value of all those joints.
            joint_ids: The joints; ``None`` for all.

        Raises:
            ValueError: If no drive has the effect, or it has no such parameter.
        """
        wanted = list(range(self.num_joints)) if joint_ids is None else list(joint_ids)
        values = self._sim.tensor(values).expand(-1, len(wanted))
        found = False
        for actuator in self.actuators.values():
            if actuator.effects is None or effect not in [e.name for e in actuator.effects.effects]:
                continue
            found = True
            here = actuator.effects.find(effect)
            own = self.joints_of(actuator)
            pairs = [(own.index(j), k) for k, j in enumerate(wanted) if j in own]
            if pairs:
                local, chosen = zip(*pairs, strict=True)
                joints = torch.tensor(local, device=self._sim.device)
                here.set_parameter(parameter, values[here.rows][:, list(chosen)], joints=joints)
            self._write_effect(actuator, here)
        if not found:
            raise ValueError(f"No drive has the effect {effect!r}. Present: {', '.join(self.effects) or 'none'}.")

    def write_effect_to_sim(self, actuator: PaceDCMotor, effect: Effect, values: torch.Tensor) -> None:
        """Write all parameters of an effect of a drive.

        Args:
            values: In the order of its parameters, (rows of the effect, joints of the drive, parameters).
        """
        for parameter, value in zip(effect.parameters, values.unbind(dim=-1), strict=True):
            effect.set_parameter(parameter.name, value)
        self._write_effect(actuator, effect)

    def _write_effect(self, actuator: PaceDCMotor, effect: Effect) -> None:
        """Write what the simulator carries of a drive with an effect whose parameters have changed."""
        self._write_passive(actuator)
        if effect.overrides("write_model"):
            self._write_model(actuator, effect)

    def joints_of(self, actuator: PaceDCMotor) -> list[int]:
        """The joints that a drive moves, by index."""
        ids = actuator.joint_indices
        return list(range(self.num_joints)) if isinstance(ids, slice) else torch.as_tensor(ids).tolist()

    def _columns_of(self, actuator: PaceDCMotor) -> torch.Tensor:
        if actuator not in self._columns:
            self._columns[actuator] = self._layout.dof_columns[actuator.joint_indices]
        return self._columns[actuator]

    def _place_of(self, actuator: PaceDCMotor) -> torch.Tensor | slice:
        """Its columns in the model's arrays; a slice, which is faster, where it drives all joints side by side."""
        whole = self._layout.side_by_side and isinstance(actuator.joint_indices, slice)
        return self._layout.dof_view if whole else self._columns_of(actuator)

    def _tell_link(self, actuator: PaceDCMotor) -> None:
        """Give a drive what its effects read of the link."""
        if actuator.needs_load:
            actuator.set_load_effort(pick(self.load_effort, actuator.joint_indices))
        if actuator.needs_link:
            actuator.set_link(*self._sim.felt_link(self._columns_of(actuator)))

    def _write_model(self, actuator: PaceDCMotor, effect: Effect) -> None:
        """Write an effect on the rigid bodies; loads have been written before."""
        for local, joint in enumerate(self.joints_of(actuator)):
            effect.write_model(self._links.of(effect.rows, joint), local)
        self._sim.note_model_effect(effect, self._columns_of(actuator))
        self._sim.constants_changed()

    def _write_what_drags(self, actuator: PaceDCMotor, place: torch.Tensor | slice) -> None:
        self._sim.write_passive(
            place,
            actuator.joint_armature,
            actuator.joint_friction,
            actuator.joint_viscous_friction,
            actuator.joint_implicit_damping,
        )

    def _write_passive(self, actuator: PaceDCMotor) -> None:
        """Write what the simulator carries of a drive: rotor inertia, friction, the link's rigid body."""
        actuator.update_effects()
        place = self._place_of(actuator)
        self._write_what_drags(actuator, place)
        if (time := actuator.joint_friction_time) is not None:
            self._sim.soften_friction(place, time)
        self._sim.constants_changed()

    def _build_actuators(self) -> None:
        n = self.num_joints
        model_values = {name: self._sim.expand(_field(name))[0, self._layout.dof_columns] for name in CARRIED}
        self.actuators: dict[str, PaceDCMotor] = {}
        owner: dict[str, str] = {}
        for group, cfg in self.cfg.actuators.items():
            ids, names = self.find_joints(cfg.joint_names_expr)
            for name in names:
                if name in owner:
                    raise ValueError(
                        f"The joint {name!r} belongs to the actuator groups {owner[name]!r} and {group!r}. "
                        "Make their joint_names_expr exclusive."
                    )
                owner[name] = group
            joint_ids = slice(None) if ids == list(range(n)) else torch.tensor(ids, device=self._sim.device)
            self.actuators[group] = (cfg.class_type or PaceDCMotor)(
                cfg,
                names,
                joint_ids,
                self.num_envs,
                self._sim.device,
                physics_dt=self._sim.cfg.dt,
                dtype=self._sim.dtype,
                **{key: values[ids] for key, values in model_values.items()},
            )
        for actuator in self.actuators.values():
            trapezoidal = self._sim.is_trapezoidal
            holds_line = actuator.cfg.control_decimation > 1 or trapezoidal
            actuator.take_over_simulator(is_trapezoidal=trapezoidal, holds_line=holds_line)
            driven = actuator.joint_indices
            for name in CARRIED:
                self._write_carried(name, getattr(actuator, name), driven, None)
            configured = {cfg.effect_class.name for cfg in effect_cfgs(actuator.cfg.effects) if cfg.values}
            for effect in [] if actuator.effects is None else actuator.effects.effects:
                if effect.name in configured and effect.overrides("write_model"):
                    self._write_model(actuator, effect)

    def _write_carried(self, name: str, value: torch.Tensor | float, joint_ids: JointIds, env_ids: EnvIds) -> None:
        """Write a parameter that the model's joints carry, and pass it to drives whose torque law depends on it."""
        field = _field(name)
        value = value if isinstance(value, torch.Tensor) else checked_values(value, self._shape, name)
        tensor = self._sim.tensor(value)
        bad = ~((tensor >= 0) & tensor.isfinite())
        if bool(bad.any()):
            raise ValueError(f"{name} is {tensor[bad][0].item():g}, expected a finite number >= 0.")
        self._write(self._sim.expand(field), self._layout.dof_columns, tensor, joint_ids, env_ids, name)
        self._sim.constants_changed()
        for actuator in self.actuators.values():  # their torque law may depend on it
            if actuator.changes_passive or actuator.effects is not None:
                whole = self._sim.expand(field).clone()
                own = getattr(actuator, name)
                columns = self._columns_of(actuator)
                written = torch.zeros_like(whole, dtype=torch.bool)
                self._write(written, self._layout.dof_columns, True, joint_ids, env_ids)
                setattr(actuator, name, torch.where(written[:, columns], whole[:, columns], own))
                self._write_passive(actuator)


def _write_bias(actuator: PaceDCMotor, bias: torch.Tensor, joints: list[int]) -> None:
    whole = actuator.encoder_bias.clone()
    whole[:, joints] = bias
    actuator.update_encoder_bias(whole)


def _write_delay(actuator: PaceDCMotor, delay: torch.Tensor, joints: list[int]) -> None:
    actuator.update_time_lags(delay)


_WRITERS = {"encoder_bias": _write_bias, "delay": _write_delay}
"""What gives a drive the base parameters that its joints do not carry."""


def _field(name: str) -> str:
    """The model's field of a parameter that its joints carry."""
    return f"dof_{BASE_PARAMETERS[name].mujoco}"
