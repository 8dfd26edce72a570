"""What the effects of a drive see and change."""

from __future__ import annotations

import copy

import torch

_WRITABLE = (
    "joint_pos_target",
    "encoder_pos",
    "encoder_vel",
    "stiffness",
    "damping",
    "effort",
    "speed_slope",
    "friction",
    "viscous_friction",
    "implicit_damping",
    "armature",
    "joint_pos",
    "joint_vel",
    "motor_pos",
    "motor_vel",
    "motor_effort",
    "load_effort",
    "load_stiffness",
    "link_inertia",
    "spare_inertia",
    "base_friction",
    "base_viscous_friction",
    "base_armature",
    "time",
)


class DriveState:
    """The quantities of a drive at one instant, each (rows, num_joints); a field is changed in place or assigned.

    What effects change:
        joint_pos_target: q* [rad].
        encoder_pos: What the encoder shows before its bias is subtracted [rad].
        encoder_vel: The speed that the controller sees [rad/s].
        stiffness: kp [N m/rad].
        damping: kd [N m s/rad].
        effort: The torque on its way to the joint [N m].
        speed_slope: How fast a limit in force lets the torque fall with the speed [N m s/rad], ≥ 0.
        friction: Level of Coulomb friction that the simulator is to apply [N m]; it holds a joint that sticks.
        viscous_friction: What the simulator is to apply [N m s/rad].
        implicit_damping: More of it, which must act on the speed at the end of the step [N m s/rad].
        armature: Rotor inertia that the simulator carries [kg m²].

    What effects read:
        joint_pos, joint_vel: True joint position [rad] and speed [rad/s].
        motor_pos, motor_vel: Position [rad] and speed [rad/s] of the motor at the joint; other than the joint's where
            the transmission gives way.
        motor_effort: The motor's torque [N m]; ``effort`` may be split up between a torque and a friction.
        load_effort: Torque of gravity and load on the joint [N m]; zero where the simulator does not give it.
        load_stiffness: How fast gravity pulls back with the angle [N m/rad]; zero where it is not given.
        link_inertia: Inertia of what the joint carries [kg m²]; zero where it is not given.
        spare_inertia: What may be taken from the joint's inertia beyond the armature [kg m²].
        base_friction, base_viscous_friction, base_armature: The identified base parameters.
        time: Since the session began [s].
    """

    __slots__ = ("_fields",)
    _fields: dict[str, torch.Tensor]

    def __init__(self, fields: dict[str, torch.Tensor]):
        """Keep the tensors of the fields."""
        object.__setattr__(self, "_fields", fields)

    @classmethod
    def zeros(cls, num_envs: int, num_joints: int, device: torch.device, dtype: torch.dtype) -> DriveState:
        """All fields zero."""
        return cls({name: torch.zeros(num_envs, num_joints, device=device, dtype=dtype) for name in _WRITABLE})

    def of_rows(self, rows: slice) -> DriveState:
        """The same fields, seen through some rows."""
        return DriveState({name: tensor[rows] for name, tensor in self._fields.items()})

    def __getattr__(self, name: str) -> torch.Tensor:
        """A field."""
        if name.startswith("_"):  # copying and pickling ask before there are any
            raise AttributeError(name)
        try:
            return self._fields[name]
        except KeyError:
            raise AttributeError(f"The drive's state has no {name!r}. Available: {', '.join(self._fields)}.") from None

    def __deepcopy__(self, memo: dict) -> DriveState:
        """A copy with tensors of its own; what shares memory with it still does in its copy."""
        return DriveState(copy.deepcopy(self._fields, memo))

    def __setattr__(self, name: str, value: torch.Tensor) -> None:
        """Write into a field."""
        field = getattr(self, name)
        if field is not value:
            field.copy_(value)
