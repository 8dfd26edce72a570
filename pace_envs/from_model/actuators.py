"""What the actuators of a compiled model do to its joints, in the joints' own coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import mujoco
import numpy as np

from pace_actuators.text import listed
from pace_envs.from_model.couplings import followed_ratio, followers
from pace_envs.motor_coordinates import SINGLE

Kind = Literal["position", "velocity", "effort"]

_REFERENCE = "docs/model_files.md"


@dataclass(frozen=True, kw_only=True)
class FileDrive:
    """The drive of a joint as a model file states it: τ = stiffness (q* - q) - damping q̇, within its limits."""

    joint: str
    """The joint; of a motor that moves several, its tendon."""
    kind: Kind
    """What it is commanded by."""
    stiffness: float
    """kp [N m/rad or N/m]; 0 for a velocity or torque drive."""
    damping: float
    """kd [N m s/rad or N s/m]."""
    effort_limit: float
    """Largest torque [N m] or force [N]; infinite where the file has none."""
    target_range: tuple[float, float]
    """Range of position targets [rad or m]; infinite where the file has none."""
    row: Mapping[str, float] = field(default_factory=dict)
    """The joints that a tendon pulls, {joint: ratio}: of joints that follow the first one such that Σ ratio q is its
    position. Empty where the drive moves one joint."""


def read_drives(model: mujoco.MjModel) -> tuple[list[FileDrive], list[str]]:
    """The drives of a model's joints, in the order of the joints, and notes on what was not taken as it is.

    With the force F = gain u + b0 + b1 L + b2 L̇ of an actuator and its length L = G q + L0, the joint feels G F. A
    position servo has kp = -b1 G², kd = -b2 G² and the target (gain u + b0)/(-b1 G) - L0/G.

    Args:
        model: The compiled model, with its actuators.
    """
    found: dict[str, FileDrive] = {}
    notes: list[str] = []
    gears: dict[str, float] = {}
    for i in range(model.nu):
        drive, note = _read(model, i)
        notes += [note] if note else []
        if drive is not None:
            found[drive.joint] = _both(found[drive.joint], drive) if drive.joint in found else drive
            gears[drive.joint] = float(model.actuator_gear[i, 0])
    order = [model.joint(j).name for j in range(model.njnt)]
    notes += _gear_notes(gears)
    drives = sorted(found.values(), key=lambda drive: min(order.index(joint) for joint in drive.row or [drive.joint]))
    if motors := [drive.joint for drive in drives if drive.row and drive.joint not in drive.row]:
        moved = sorted({joint for drive in drives if drive.joint in motors for joint in drive.row}, key=order.index)
        notes.append(
            f"motors that move {listed(moved)} together: {listed(motors)}: armature, friction, bias, gains and limits "
            "are the motors', and their positions are the tendons' lengths"
        )
    return [_within_joint_limit(model, drive) for drive in drives], list(dict.fromkeys(notes))


def _gear_notes(gears: Mapping[str, float]) -> list[str]:
    """Where a log may have the motor's side, or the other sign, of what is the joint's here."""
    notes = []
    if geared := [f"{joint} {gear:g}" for joint, gear in gears.items() if abs(gear) != 1]:
        notes.append(f"gears: {', '.join(geared)}: gains, limits, targets and torques are the joint's, not the motor's")
    if turned := [joint for joint, gear in gears.items() if gear < 0]:
        notes.append(f"negative gear: {', '.join(turned)}: targets and torques count in the joint's own direction")
    return notes


def _read(model: mujoco.MjModel, i: int) -> tuple[FileDrive | None, str]:
    name = model.actuator(i).name or f"number {i}"
    place = _transmission(model, i, name)
    if place is None:
        return None, f"The actuator {name} moves no joint (a site, body or slider-crank) and is left out."
    joint, gear, rest, row = place
    gain, bias, damping = _law(model, i, name)
    note = _activation_note(model, i)
    limit = _limit(model.actuator_forcerange[i]) if model.actuator_forcelimited[i] else np.inf
    ctrl = model.actuator_ctrlrange[i] if model.actuator_ctrllimited[i] else np.array([-np.inf, np.inf])
    if bias[1] > 0 or damping < 0:
        raise ValueError(
            f"The actuator {name} pushes away from its target (biasprm {bias[1]:g}, damping {damping:g}): a drive with "
            f"negative gains cannot be followed. Correct the model file, or write a configuration: see {_REFERENCE}."
        )
    kind: Kind = "position" if bias[1] < 0 else "velocity" if damping > 0 else "effort"
    target = (-np.inf, np.inf)
    if kind == "position":
        with np.errstate(invalid="ignore"):
            ends = (gain * ctrl + bias[0]) / (-bias[1] * gear) - rest / gear if gain else np.array([-np.inf, np.inf])
        target = (float(np.min(ends)), float(np.max(ends)))
    elif kind == "effort" and np.isfinite(ctrl).all():
        limit = min(limit, _limit(gain * ctrl + bias[0]))
    drive = FileDrive(
        joint=joint,
        kind=kind,
        stiffness=abs(float(bias[1])) * gear**2,
        damping=float(damping) * gear**2,
        effort_limit=float(limit) * abs(gear),
        target_range=target,
        row=row,
    )
    return drive, note


def _transmission(model: mujoco.MjModel, i: int, name: str) -> tuple[str, float, float, dict[str, float]] | None:
    """Joint or motor, gear G and rest length L0 of an actuator, L = G q + L0, and the joints that a tendon pulls.

    ``None`` where no joint is moved directly.
    """
    kind, gear, row = int(model.actuator_trntype[i]), float(model.actuator_gear[i, 0]), dict[str, float]()
    target = int(model.actuator_trnid[i, 0])
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        if int(model.jnt_type[target]) not in SINGLE:
            return None
        joint, ratio, rest = model.joint(target).name, gear, 0.0
    elif kind == mujoco.mjtTrn.mjTRN_TENDON:
        joint, ratio, rest, row = _through_tendon(model, target, name)
        ratio, rest = ratio * gear, rest * gear
    else:
        return None
    if ratio == 0:
        return None
    return joint, ratio, rest, row


def _through_tendon(model: mujoco.MjModel, tendon: int, name: str) -> tuple[str, float, float, dict[str, float]]:
    """A tendon as a gear on the first of its joints, where the others follow that one, else as a separate motor."""
    label = model.tendon(tendon).name or f"number {tendon}"
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    wraps = range(first, first + count)
    if any(int(model.wrap_type[w]) != mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
        raise ValueError(
            f"The actuator {name} pulls the spatial tendon {label}, whose lever arm changes with the posture: no drive "
            f"here follows that. Give each joint an actuator, or remove this one: see {_REFERENCE}."
        )
    row: dict[int, float] = {}
    for w in wraps:
        joint = int(model.wrap_objid[w])
        row[joint] = row.get(joint, 0.0) + float(model.wrap_prm[w])
    names = {joint: model.joint(joint).name for joint in row}
    follow = {joint: followed_ratio(model, joint, next(iter(row))) for joint in row}
    tied = {joint: each for joint, each in follow.items() if each is not None}
    if len(tied) < len(row):
        if len(tied) > 1 or followers(model) & set(row) or not model.tendon(tendon).name:
            raise ValueError(
                f"The actuator {name} pulls the tendon {label} over {listed(list(names.values()))}. A motor of several "
                "joints needs a tendon with a name, over joints that follow no other. Name it. Remove joints from it "
                f"that <equality><joint/></equality> ties to others: see {_REFERENCE}."
            )
        return label, 1.0, 0.0, {names[joint]: ratio for joint, ratio in row.items()}
    ratio = sum(row[joint] * of_first for joint, (of_first, _) in tied.items())
    rest = sum(row[joint] * offset for joint, (_, offset) in tied.items())
    shares = len(row) > 1 and ratio and not rest
    pulls = {names[joint]: each / ratio for joint, each in row.items()} if shares else {}
    return names[next(iter(row))], ratio, rest, pulls


def _law(model: mujoco.MjModel, i: int, name: str) -> tuple[float, np.ndarray, float]:
    """Gain, (b0, b1) and -b2 of an actuator's force F = gain u + b0 + b1 L + b2 L̇."""
    gain, bias = int(model.actuator_gaintype[i]), int(model.actuator_biastype[i])
    gains = model.actuator_gainprm[i]
    constant = gain == mujoco.mjtGain.mjGAIN_FIXED or (gain == mujoco.mjtGain.mjGAIN_AFFINE and not gains[1:3].any())
    known = bias in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    if not (constant and known):
        kind = mujoco.mjtGain(gain).name.removeprefix("mjGAIN_").lower()
        raise ValueError(
            f"The actuator {name} is of the kind {kind!r}. Expected position, velocity, intvelocity, motor, or a "
            f"general one of the same form. Write a configuration for it: see {_REFERENCE}."
        )
    values = model.actuator_biasprm[i] if bias == mujoco.mjtBias.mjBIAS_AFFINE else np.zeros(3)
    return float(gains[0]), values[:2], 0.0 - float(values[2])


def _activation_note(model: mujoco.MjModel, i: int) -> str:
    kind = int(model.actuator_dyntype[i])
    if kind in (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT):
        return (
            f"The file filters the commands of {model.actuator(i).name} with {model.actuator_dynprm[i, 0]:g} s: left "
            "out. The delay stands in for a part of it."
        )
    if kind == mujoco.mjtDyn.mjDYN_INTEGRATOR:
        return f"{model.actuator(i).name} is commanded a speed that it integrates: record the target that comes of it."
    return ""


def _both(one: FileDrive, other: FileDrive) -> FileDrive:
    """Two actuators of one joint: their forces add."""
    kinds = {one.kind, other.kind}
    return replace(
        one,
        kind="position" if "position" in kinds else "velocity" if "velocity" in kinds else "effort",
        stiffness=one.stiffness + other.stiffness,
        damping=one.damping + other.damping,
        effort_limit=one.effort_limit + other.effort_limit,
        target_range=(
            max(one.target_range[0], other.target_range[0]),
            min(one.target_range[1], other.target_range[1]),
        ),
    )


def _within_joint_limit(model: mujoco.MjModel, drive: FileDrive) -> FileDrive:
    if drive.row and drive.joint not in drive.row:
        return drive
    joint = model.joint(drive.joint)
    if not int(model.jnt_actfrclimited[joint.id]):
        return drive
    return replace(drive, effort_limit=min(drive.effort_limit, _limit(model.jnt_actfrcrange[joint.id])))


def _limit(span: Sequence[float] | np.ndarray) -> float:
    """The larger side of a range of force: drives here have one limit for both directions."""
    return float(np.max(np.abs(span)))
