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


def clip_effort(
    effort: torch.Tensor,
    joint_vel: torch.Tensor,
    saturation_effort: torch.Tensor,
    effort_limit: torch.Tensor,
    velocity_limit: torch.Tensor,
) -> torch.Tensor:
    """What a DC motor gives of a torque asked of it: the four-quadrant torque-speed curve.

    With stall torque τ_s, no-load speed v_0 and continuous limit τ_c (Isaac Lab's ``DCMotor``):

        τ = clip(clip(τ_cmd, -τ_s (1 + v / v_0), τ_s (1 - v / v_0)), -τ_c, τ_c)

    A motor that is driven faster than v_0 (1 + τ_c / τ_s) brakes with τ_c.

    Args:
        effort: τ_cmd [N m], shape (num_envs, num_joints).
        joint_vel: v [rad/s], same shape.
        saturation_effort: τ_s [N m].
        effort_limit: τ_c [N m].
        velocity_limit: v_0 [rad/s]; infinite means no dependence on speed.

    Returns:
        τ [N m], shape (num_envs, num_joints).
    """
    drop = saturation_effort / velocity_limit * joint_vel
    within_curve = torch.clamp(effort, (saturation_effort + drop).neg_(), saturation_effort - drop)
    return torch.clamp(within_curve, -effort_limit, effort_limit)


def clip_to_line(
    effort: torch.Tensor,
    joint_vel: torch.Tensor,
    saturation_effort: torch.Tensor,
    effort_limit: torch.Tensor,
    velocity_limit: torch.Tensor,
) -> torch.Tensor:
    """What the supply's voltage leaves of a motor's torque: the torque-speed line alone.

        τ = clip(τ, min(-τ_s (1 + v / v_0), τ_c), max(τ_s (1 - v / v_0), -τ_c))

    Of a torque that was clipped to ± τ_c before, it makes what :func:`clip_effort` does, exactly; between the two, what
    is asked of a motor can become another torque.

    Args:
        effort: τ [N m], shape (num_envs, num_joints).
        joint_vel: v [rad/s], same shape.
        saturation_effort: τ_s [N m].
        effort_limit: τ_c, with which it brakes beyond its speeds [N m].
        velocity_limit: v_0 [rad/s]; infinite means no dependence on speed.

    Returns:
        τ [N m], shape (num_envs, num_joints).
    """
    drop = saturation_effort / velocity_limit * joint_vel
    lower = torch.minimum((saturation_effort + drop).neg_(), effort_limit)
    upper = torch.maximum(saturation_effort - drop, -effort_limit)
    return torch.clamp(effort, lower, upper)
