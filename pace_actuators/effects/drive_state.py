"""What the effects of a drive see and change."""

from __future__ import annotations

import operator

import torch

from pace_actuators.part import Part

_LINK_FIELDS = ("load_stiffness", "link_inertia", "spare_inertia")


class DriveState(Part):
    """The quantities of a drive at one instant, each (rows, num_joints); a field is changed in place or assigned.

    What effects change:
        joint_pos_target: q* [rad].
        encoder_pos: What the encoder shows before its bias is subtracted [rad].
        encoder_vel: The speed that the controller sees [rad/s].
        stiffness: kp [N m/rad].
        damping: kd [N m s/rad].
        effort: The torque on its way to the joint [N m].
        speed_slope: How fast the torque falls with the speed within a physics step, by a limit in force or a controller
            that runs continuously [N m s/rad], ≥ 0; while the speed is sensed, the part of it that the controller sees.
        friction: Level of Coulomb friction that the simulator is to apply [N m]; it holds a joint that sticks.
        viscous_friction: What the simulator is to apply [N m s/rad].
        implicit_damping: More of it, which must act on the speed at the end of the step [N m s/rad].
        armature: Rotor inertia that the simulator carries [kg m²].
        friction_time: Time constant with which the simulator's Coulomb friction gives way [s]; 0: it is hard.

    What effects read:
        position_error: Of the controller, q* less what it takes for the position [rad].
        joint_pos, joint_vel: True joint position [rad] and speed [rad/s].
        motor_pos, motor_vel: Position [rad] and speed [rad/s] of the motor at the joint; other than the joint's where
            the transmission gives way.
        motor_effort: The motor's torque [N m]; ``effort`` may be split up between a torque and a friction.
        load_effort: Torque of weight, Coriolis and centrifugal forces on the joint [N m]; zero where the simulator does
            not give it.
        load_stiffness: How fast gravity pulls back with the angle [N m/rad]; zero where it is not given.
        link_inertia: Inertia of what the joint carries [kg m²]; zero where it is not given.
        spare_inertia: What may be taken from the joint's inertia beyond the armature [kg m²].
        base_friction, base_viscous_friction, base_armature: The identified base parameters.
        time: Since the session began [s].
        enabled: 1 where the drive gives torque, 0 where it is switched off.

    While joints are held (``Effect.hold``):
        held: 1 where a joint is, 0 where it is free.
        held_pos, held_vel: What its encoder shows [rad], [rad/s]; effects change it to what the joint has.
    """

    joint_pos_target: torch.Tensor
    encoder_pos: torch.Tensor
    encoder_vel: torch.Tensor
    stiffness: torch.Tensor
    damping: torch.Tensor
    effort: torch.Tensor
    speed_slope: torch.Tensor
    friction: torch.Tensor
    viscous_friction: torch.Tensor
    implicit_damping: torch.Tensor
    armature: torch.Tensor
    friction_time: torch.Tensor
    position_error: torch.Tensor
    joint_pos: torch.Tensor
    joint_vel: torch.Tensor
    motor_pos: torch.Tensor
    motor_vel: torch.Tensor
    motor_effort: torch.Tensor
    load_effort: torch.Tensor
    load_stiffness: torch.Tensor
    link_inertia: torch.Tensor
    spare_inertia: torch.Tensor
    base_friction: torch.Tensor
    base_viscous_friction: torch.Tensor
    base_armature: torch.Tensor
    time: torch.Tensor
    enabled: torch.Tensor
    held: torch.Tensor
    held_pos: torch.Tensor
    held_vel: torch.Tensor

    memory = tuple(__annotations__)
    __slots__ = tuple(f"_{name}" for name in memory)

    def __init__(self, fields: dict[str, torch.Tensor]):
        """Keep the tensors of the fields."""
        for name, tensor in fields.items():
            setattr(self, f"_{name}", tensor)

    @classmethod
    def zeros(cls, num_envs: int, num_joints: int, device: torch.device, dtype: torch.dtype) -> DriveState:
        """All fields zero."""
        return cls({name: torch.zeros(num_envs, num_joints, device=device, dtype=dtype) for name in _FIELDS})

    def of_rows(self, rows: slice, with_load: bool = True, with_link: bool = True) -> DriveState:
        """The same fields, seen through some rows; those of load and link only where they are wanted."""
        left_out = (() if with_load else ("load_effort",)) + (() if with_link else _LINK_FIELDS)
        return DriveState({name: getattr(self, name)[rows] for name in _FIELDS if name not in left_out})

    def scale_torque(self, gain: torch.Tensor) -> None:
        """Multiply the torque, and how fast it falls with the speed."""
        self.effort *= gain
        self.speed_slope *= gain

    def add_friction(self, change: torch.Tensor) -> None:
        """Add a part of itself to both base frictions."""
        self.friction += change * self.base_friction
        self.viscous_friction += change * self.base_viscous_friction

    def __getattr__(self, name: str) -> torch.Tensor:
        """Only reached by names that are no field.

        Raises:
            AttributeError: Always.
        """
        if name == "load_effort" or name in _LINK_FIELDS:
            flag = "reads_load" if name == "load_effort" else "reads_link"
            raise AttributeError(f"{name} is not computed for this effect: declare {flag} = True in its class.")
        raise AttributeError(f"The drive's state has no {name!r}. Available: {', '.join(_FIELDS)}.")

    def tensors(self) -> dict[str, torch.Tensor]:
        """All fields, but those of load and link where they are not wanted."""
        return {name: getattr(self, name) for name in _FIELDS if hasattr(self, name)}


def _field(name: str) -> property:
    """Reading gives the tensor, assigning writes into it."""
    read = operator.attrgetter(f"_{name}")

    def write(state: DriveState, value: torch.Tensor) -> None:
        field = read(state)
        if field is not value:
            field.copy_(value)

    return property(read, write)


_FIELDS = DriveState.memory
for _name in _FIELDS:
    setattr(DriveState, _name, _field(_name))
