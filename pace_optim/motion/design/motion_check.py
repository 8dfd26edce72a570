"""Checking a commanded trajectory against a robot before it is sent anywhere.

Positions that the joints cannot reach are errors. Speed and torque are warnings: the drive limits them itself, and
PACE's reference chirp asks for more than the drive gives at its upper end, on purpose. Only a drive that is at its
torque limit most of the time makes an error, since it no longer follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pace_actuators.joint_units import JointType, units_for
from pace_optim.motion.signals import Trajectory

MAX_SHARE_AT_LIMIT = 0.5
"""A joint whose torque is at its limit for a larger share of the time is refused."""

Quantity = Literal["target", "speed", "position", "torque"]

_AT_LIMIT = 1 - 1e-6  # of the limit
_TOLERANCE = 1e-9  # [rad]


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """What a robot's joints can do."""

    joint_names: tuple[str, ...]
    """The joints."""
    position: np.ndarray
    """Lower and upper limit, (n, 2) [rad]; infinite without a limit."""
    velocity: np.ndarray
    """No-load speed of the drive, (n,) [rad/s]; may be infinite."""
    effort: np.ndarray
    """Largest torque of the drive, (n,) [N m]; may be infinite."""
    joint_types: tuple[JointType, ...] = ()
    """Whether each joint turns or slides; none: all turn."""


@dataclass(frozen=True, kw_only=True)
class MotionFinding:
    """One joint that leaves one of its limits."""

    joint: str
    """Name of the joint."""
    quantity: Quantity
    """What leaves its limit: the target [rad] or its speed [rad/s]; in simulation, position [rad] or torque [N m]."""
    value: float
    """The value furthest out."""
    limit: float
    """The limit, in the same unit."""
    time: float
    """When [s]; for a torque, when it first reaches its limit."""
    share: float
    """Share of the time beyond the limit, or at it."""
    is_error: bool
    """Whether the trajectory must not be sent."""
    message: str
    """The finding as a sentence."""


def check_command(trajectory: Trajectory, limits: MotionLimits) -> list[MotionFinding]:
    """Check the targets alone: positions, and speeds by differences.

    A trajectory that jumps on purpose (steps) has no commanded speed; see ``Trajectory.has_jumps``.

    Args:
        limits: The robot's, with the same joints in the same order.
    """
    if trajectory.joint_names != limits.joint_names:
        raise ValueError(
            f"The trajectory {trajectory.name!r} has the joints {', '.join(trajectory.joint_names)}, but the limits "
            f"are for {', '.join(limits.joint_names)}. Give both in the same order."
        )
    target, time = trajectory.des_dof_pos, trajectory.time
    findings = _beyond_position(target, time, limits, "target", is_error=True)
    if trajectory.has_jumps:
        return findings
    speed = np.abs(np.diff(target, axis=0)) / np.diff(time)[:, None]
    for j, joint in enumerate(limits.joint_names):
        over = speed[:, j] > limits.velocity[j]
        if over.any():
            k = int(np.argmax(speed[:, j]))
            value, limit, share = float(speed[k, j]), float(limits.velocity[j]), float(over.mean())
            message = (
                f"{joint}: its target moves at up to {value:.3g} rad/s (at {time[k]:.2f} s), faster than the drive's "
                f"no-load speed of {limit:.3g} rad/s. The drive cannot follow it in {share:.1%} of the time."
            )
            message = units_for(message, limits.joint_types[j : j + 1])
            findings.append(_finding(joint, "speed", value, limit, time[k], share, message))
    return findings


def check_simulated(
    time: np.ndarray, position: np.ndarray, torque: np.ndarray, limits: MotionLimits
) -> list[MotionFinding]:
    """Check how the robot moved in simulation.

    Args:
        time: Instants, (T,) [s].
        position: Joint positions, (T, n) [rad].
        torque: Torques applied between two instants, (T - 1, n) [N m].
    """
    findings = _beyond_position(position, time, limits, "position", is_error=False)
    for j, joint in enumerate(limits.joint_names):
        size, limit = np.abs(torque[:, j]), float(limits.effort[j])
        at_limit = size >= _AT_LIMIT * limit
        if not at_limit.any():
            continue
        k, share = int(np.argmax(at_limit)), float(at_limit.mean())
        message = (
            f"{joint}: in simulation its torque reaches the limit of {limit:.3g} N m, first at {time[k]:.2f} s, and "
            f"is there in {share:.1%} of the time."
        )
        message = units_for(message, limits.joint_types[j : j + 1])
        too_much = share > MAX_SHARE_AT_LIMIT
        if too_much:
            message += " The drive hardly follows: make the motion smaller or slower, or lower the gains."
        findings.append(_finding(joint, "torque", float(size[k]), limit, time[k], share, message, is_error=too_much))
    return findings


def summarise(findings: Sequence[MotionFinding]) -> list[str]:
    """One line per quantity: the worst joint in full, the others by name."""
    groups: dict[str, list[MotionFinding]] = {}
    for finding in findings:
        groups.setdefault(finding.quantity, []).append(finding)
    lines = []
    for group in groups.values():
        worst = max(group, key=_severity)
        others = [finding.joint for finding in group if finding is not worst]
        lines.append(worst.message + (f" Likewise: {', '.join(others)}." if others else ""))
    return lines


def refuse_errors(findings: Sequence[MotionFinding], name: str, robot: str) -> None:
    """Raise a ValueError that lists the errors among the findings."""
    errors = [finding.message for finding in findings if finding.is_error]
    if errors:
        more = f" And {len(errors) - 3} more." if len(errors) > 3 else ""
        raise ValueError(f"The motion {name!r} must not be sent to {robot}. {' '.join(errors[:3])}{more}")


def _severity(finding: MotionFinding) -> float:
    if finding.quantity in ("target", "position"):
        return abs(finding.value - finding.limit)
    if finding.quantity == "torque":
        return finding.share
    return finding.value / finding.limit


def _beyond_position(
    position: np.ndarray, time: np.ndarray, limits: MotionLimits, quantity: Quantity, *, is_error: bool
) -> list[MotionFinding]:
    findings = []
    below, above = limits.position[:, 0] - position, position - limits.position[:, 1]
    excess = np.maximum(below, above)
    for j, joint in enumerate(limits.joint_names):
        k = int(np.argmax(excess[:, j]))
        if excess[k, j] <= _TOLERANCE:
            continue
        low, high = limits.position[j].tolist()
        value, share = float(position[k, j]), float((excess[:, j] > _TOLERANCE).mean())
        what = "its target is" if is_error else "in simulation it reaches"
        cure = " Change PaceCfg.excitation (bias, scale)." if is_error else ""
        message = (
            f"{joint}: {what} {value:.3f} rad at {time[k]:.2f} s, outside its limits of {low:.3f} to "
            f"{high:.3f} rad.{cure}"
        )
        message = units_for(message, limits.joint_types[j : j + 1])
        limit = low if below[k, j] > above[k, j] else high
        findings.append(_finding(joint, quantity, value, limit, time[k], share, message, is_error=is_error))
    return findings


def _finding(
    joint: str,
    quantity: Quantity,
    value: float,
    limit: float,
    time: float,
    share: float,
    message: str,
    *,
    is_error: bool = False,
) -> MotionFinding:
    return MotionFinding(
        joint=joint,
        quantity=quantity,
        value=value,
        limit=limit,
        time=float(time),
        share=share,
        is_error=is_error,
        message=message,
    )
