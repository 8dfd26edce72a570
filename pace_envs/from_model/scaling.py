"""Gains, bounds and motion of a joint, from what its model file says of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from pace_actuators.base_parameters import CARRIED
from pace_actuators.joint_units import SLIDE_LENGTH
from pace_envs.from_model import defaults
from pace_envs.from_model.joints import JointFacts

_ACCELERATION, _SLIDE_ACCELERATION = 25.0, 10.0
"""A drive's largest torque over its rotor inertia is above this [rad/s^2] (a slide: [m/s^2])."""
_OF_EFFORT = 0.2
"""Largest Coulomb friction, as a part of the drive's largest torque."""
OF_BOUNDS = 0.1
"""Where a fit begins, as a part of the upper bounds: from their middle, friction that hides the rest leads astray."""
_SEEN_BY_FILE = 10.0
"""How much larger than the file says a parameter may be."""
_NO_ARMATURE, _BESIDE_LINK = 1e-5, 1e-3
"""The least armature, as a part of the largest, and of the inertia of the joint's link if that is less."""
_SAFE = 0.7
"""Part of the torque that gravity leaves, and of the speed limit, that the excitation may use."""
_MARGIN = 0.05
"""Part of the joint's range at each end that the excitation stays away from."""

Bounds = tuple[float, float]


def unit_length(joint: JointFacts) -> float:
    """What counts as a radian: 1 for a hinge, some metres for a slide."""
    return SLIDE_LENGTH if joint.is_slide else 1.0


def has_gains(joint: JointFacts) -> bool:
    """Whether the file says by which gains the joint is held: a motor, or no actuator at all, says nothing of them."""
    return joint.drive is not None and joint.drive.kind != "effort"


def gains(joint: JointFacts) -> tuple[float, float]:
    """Stiffness kp [N m/rad] and damping kd [N m s/rad]: the file's, or the named defaults."""
    if joint.drive is not None and has_gains(joint):
        return joint.drive.stiffness, joint.drive.damping
    inertia, length = joint.inertia + joint.armature, unit_length(joint)
    natural = (2 * math.pi * defaults.NATURAL_FREQUENCY) ** 2 * inertia
    stiffness = max(joint.effort / (defaults.ERROR_AT_LIMIT * length), natural)
    damping = 2 * defaults.DAMPING_RATIO * math.sqrt(stiffness * inertia)
    return (0.0 if joint.command == "velocity" else stiffness), damping


def runs_continuously(joints: Sequence[JointFacts], model: mujoco.MjModel, control_dt: float) -> bool:
    """Whether the drives' loops are those of the file's actuators, which MuJoCo evaluates at every step.

    Loops are held at the control rate, as in PACE, where the file has no gains (no actuators, or motors). So are
    gains with a damping that is stable there and that the file's own integrator treats explicitly too.
    """
    if not all(has_gains(joint) for joint in joints):
        return False
    implicit = (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    if int(model.opt.integrator) in implicit or not any(gains(joint)[1] for joint in joints):
        return True
    return any(
        gains(joint)[1] * control_dt + 0.5 * gains(joint)[0] * control_dt**2 > joint.inertia + joint.armature
        for joint in joints
    )


def largest_parameters(effort: float, velocity_limit: float, *, is_slide: bool) -> dict[str, float]:
    """What a drive has at most of armature, viscous and Coulomb friction, by its largest torque [N m] and speed."""
    length = SLIDE_LENGTH if is_slide else 1.0
    speed = min(velocity_limit, defaults.USUAL_SPEED * length)  # of a faster drive friction may take more
    return {
        "armature": effort / (_SLIDE_ACCELERATION if is_slide else _ACCELERATION),
        "viscous_friction": effort / speed,
        "friction": _OF_EFFORT * effort,
    }


def base_bounds(joint: JointFacts) -> dict[str, Bounds]:
    """Bounds of armature, viscous friction, Coulomb friction and encoder bias."""
    most = largest_parameters(joint.effort, joint.velocity_limit, is_slide=joint.is_slide)
    slowest = most["armature"]
    armature = max(_SEEN_BY_FILE * joint.armature, 0.25 * slowest) if joint.armature else slowest
    viscous = max(4.0 * joint.viscous_friction, most["viscous_friction"])
    friction = max(4.0 * joint.friction, most["friction"])
    bias = defaults.LARGEST_BIAS
    if joint.is_slide:
        low, high = joint.range
        bias = min(defaults.LARGEST_SLIDE_BIAS, 0.1 * (high - low))
    return {
        "armature": (_least_armature(joint, armature), armature),
        "viscous_friction": (0.0, viscous),
        "friction": (0.0, friction),
        "encoder_bias": (-bias, bias),
    }


def _least_armature(joint: JointFacts, most: float) -> float:
    """An armature that is as good as none: beside the link's own inertia, or beside the largest where it has none.

    Effort limits of many a file are placeholders: a part of what they allow may be more than a small drive has.
    """
    least = _NO_ARMATURE * most
    return min(least, _BESIDE_LINK * joint.inertia) if joint.inertia > 0 else least


def start_values(joint: JointFacts) -> dict[str, float]:
    """Where a fit begins: the bounds are what a drive may have at most, and most have a small part of it."""
    bounds = base_bounds(joint)
    return {group: OF_BOUNDS * bounds[group][1] for group in CARRIED}


def motion(joint: JointFacts) -> tuple[float, float]:
    """Centre and amplitude of the excitation's target [rad]: around home, within range, speed and torque."""
    low, high = _target_range(joint)
    width, length = high - low, unit_length(joint)
    amplitude = min(defaults.LARGEST_AMPLITUDE * length, 0.25 * width, safe_amplitude(joint))
    if not math.isfinite(width):
        return joint.home, amplitude
    keep = _MARGIN * width + amplitude
    return min(max(joint.home, low + keep), high - keep), amplitude


def safe_amplitude(joint: JointFacts) -> float:
    """Largest amplitude of a target [rad] whose sine, up to the top frequency, needs neither torque nor speed too much.

    The joint alone, with inertia I (armature included), follows a target q* = a sin(ω t) as

        q / q* = kp / (kp - I ω² + i ω (kd + d)),     τ = (i ω d - I ω²) q,     q̇ = i ω q
    """
    kp, kd = gains(joint)
    if kp == 0:
        return math.inf
    omega = 2 * math.pi * np.geomspace(0.1, defaults.TOP_FREQUENCY, 200)
    inertia, viscous = joint.inertia + joint.armature, joint.viscous_friction
    answer = kp / (kp - inertia * omega**2 + 1j * omega * (kd + viscous))
    torque = float(np.abs((1j * omega * viscous - inertia * omega**2) * answer).max())
    speed = float(np.abs(omega * answer).max())
    left = max(joint.effort - joint.gravity - joint.friction, 0.1 * joint.effort)
    return _SAFE * min(left / max(torque, 1e-12), joint.velocity_limit / speed)


def sample_values(joint: JointFacts) -> dict[str, float]:
    """True parameters of a simulated recording: the file's, or small parts of the bounds."""
    bounds = base_bounds(joint)
    return {
        **{name: getattr(joint, name) or 0.05 * bounds[name][1] for name in CARRIED},
        "encoder_bias": 0.2 * bounds["encoder_bias"][1],
    }


def _target_range(joint: JointFacts) -> tuple[float, float]:
    """Where position targets may be: the joint's range and the actuator's control range."""
    low, high = joint.range
    if joint.drive is not None:
        low, high = max(low, joint.drive.target_range[0]), min(high, joint.drive.target_range[1])
    return low, high
