"""What is known of a robot's state, batched over environments."""

from dataclasses import dataclass

import torch

from pace_envs.quaternions import down, rotate_inverse


@dataclass(kw_only=True)
class ArticulationData:
    """State, targets and defaults; joints in the articulation's ``joint_names`` order, of the simulation's type.

    Tensors of the state may share memory with the simulation: clone them to keep them.
    """

    joint_pos: torch.Tensor
    """True joint positions [rad], (num_envs, num_joints)."""
    joint_vel: torch.Tensor
    """Joint velocities [rad/s], (num_envs, num_joints)."""
    default_joint_pos: torch.Tensor
    """[rad], (num_envs, num_joints)."""
    default_joint_vel: torch.Tensor
    """[rad/s], (num_envs, num_joints)."""
    joint_pos_limits: torch.Tensor
    """Lower and upper [rad], (num_joints, 2); infinite without a limit."""
    soft_joint_pos_limits: torch.Tensor
    """Lower and upper [rad], (num_joints, 2)."""
    joint_pos_target: torch.Tensor
    """[rad], (num_envs, num_joints)."""
    joint_vel_target: torch.Tensor | None = None
    """[rad/s], (num_envs, num_joints); ``None`` until one is set, which means zero."""
    joint_effort_target: torch.Tensor | None = None
    """Feed-forward [N m], (num_envs, num_joints); ``None`` until one is set, which means zero."""
    computed_torque: torch.Tensor
    """Torque that the controllers ask for [N m], (num_envs, num_joints)."""
    applied_torque: torch.Tensor
    """Torque at the joints [N m], (num_envs, num_joints)."""
    root_pos_w: torch.Tensor | None = None
    """Position of a floating base in the world [m], (num_envs, 3); ``None`` for a fixed base."""
    root_quat_w: torch.Tensor | None = None
    """Orientation of a floating base, w x y z, (num_envs, 4)."""
    root_lin_vel_w: torch.Tensor | None = None
    """Linear velocity of a floating base in the world [m/s], (num_envs, 3)."""
    root_ang_vel_b: torch.Tensor | None = None
    """Angular velocity of a floating base in its frame [rad/s], (num_envs, 3)."""

    @property
    def root_lin_vel_b(self) -> torch.Tensor:
        """Linear velocity of a floating base in its frame [m/s], (num_envs, 3)."""
        return rotate_inverse(of_floating_base(self.root_quat_w), of_floating_base(self.root_lin_vel_w))

    @property
    def projected_gravity_b(self) -> torch.Tensor:
        """Direction of gravity in a floating base's frame, (num_envs, 3)."""
        return down(of_floating_base(self.root_quat_w))


def of_floating_base(state: torch.Tensor | None) -> torch.Tensor:
    """A part of the root's state."""
    if state is None:
        raise ValueError("This robot's base is fixed: it has no root state. Set fix_base=False.")
    return state
