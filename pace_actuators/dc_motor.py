"""The closed forms of a PD-controlled DC motor."""

import torch


def pd_effort(
    position_error: torch.Tensor, velocity_error: torch.Tensor, stiffness: torch.Tensor, damping: torch.Tensor
) -> torch.Tensor:
    """PD law, τ = kp (q* - q) + kd (q̇* - q̇).

    Args:
        position_error: q* - q [rad], shape (num_envs, num_joints).
        velocity_error: q̇* - q̇ [rad/s], same shape.
        stiffness: kp [N m/rad], broadcastable to that shape.
        damping: kd [N m s/rad], broadcastable to that shape.

    Returns:
        The effort [N m], shape (num_envs, num_joints).
    """
    return (stiffness * position_error).addcmul_(damping, velocity_error)


def effort_bounds(
    joint_vel: torch.Tensor,
    saturation_effort: torch.Tensor,
    effort_limit: torch.Tensor,
    velocity_limit: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Lowest and highest effort of a DC motor at a speed: the four-quadrant torque-speed curve.

    With stall torque τ_s, no-load speed v_0 and continuous limit τ_c (Isaac Lab's ``DCMotor``):

        τ_max(v) = min(τ_s (1 - v / v_0), τ_c),   τ_min(v) = max(τ_s (-1 - v / v_0), -τ_c)

    with v limited to ±v_0 (1 + τ_c / τ_s), so that a motor driven faster than that brakes with τ_c.

    Args:
        joint_vel: v [rad/s], shape (num_envs, num_joints).
        saturation_effort: τ_s [N m].
        effort_limit: τ_c [N m].
        velocity_limit: v_0 [rad/s]; infinite means no dependence on speed.

    Returns:
        (τ_min, τ_max) [N m], each of the shape of ``joint_vel``.
    """
    drop = saturation_effort / velocity_limit * joint_vel
    highest = (saturation_effort - drop).clamp_(max=effort_limit).clamp_(min=-effort_limit)
    lowest = (-saturation_effort - drop).clamp_(min=-effort_limit).clamp_(max=effort_limit)
    return lowest, highest
