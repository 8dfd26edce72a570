"""What a controller asks of a group of joints."""

from dataclasses import dataclass

import torch


@dataclass
class ActuatorActions:
    """Commands to joints, or the efforts that an actuator makes of them.

    The same fields as Isaac Lab's ``ArticulationActions``; either class can be given to an actuator.
    """

    joint_positions: torch.Tensor | None = None
    """Target positions q* [rad], shape (num_envs, num_joints)."""
    joint_velocities: torch.Tensor | None = None
    """Target velocities [rad/s], shape (num_envs, num_joints); ``None`` means zero."""
    joint_efforts: torch.Tensor | None = None
    """Feed-forward efforts, or the actuator's result [N m], shape (num_envs, num_joints)."""
    joint_indices: torch.Tensor | slice | None = None
    """Which joints of the articulation these are; carried along, not used."""
