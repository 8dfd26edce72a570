"""Measured torques as a second channel of a fit: of which joints, with how much noise, from where on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pace_actuators.text import listed
from pace_optim.recording import Recording
from pace_optim.recording.noise import noise_floor

from .drives import MeasuredDrives, follows
from .law import SURE, MeasuredLaw

_LARGEST_OFFSET = 0.5
"""Part of the largest torque that a sensor's offset is at most."""


class NoTorqueError(ValueError):
    """No recording has a torque that a fit can follow."""


@dataclass(frozen=True, kw_only=True)
class TorqueChannel:
    """Joints whose measured torques a fit follows, τ_m(t) = s τ(t - l) + o + noise, and what it begins with.

    The scale s and the offset o are sought. The lag l is that of the law: beside one that is free, a damping would be
    viscous friction (a lag of kp (q* - q) is kp l q̇).
    """

    noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of what the best law of the drive leaves of a torque, by joint [N m]."""
    floor: Mapping[str, float] = field(default_factory=dict)
    """That of its noise, by joint [N m]."""
    lag: Mapping[str, float] = field(default_factory=dict)
    """l, by joint [control steps]; below 0: the log has a torque before its position."""
    offsets: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Lower bound, start and upper bound of o, by joint [N m]."""
    notes: tuple[str, ...] = ()
    """Which joints they are, and which are left out, in sentences."""


def torque_channel(recordings: Sequence[Recording], measured: MeasuredDrives, why_not: str = "") -> TorqueChannel:
    """The channel of joints whose torques are those of their drives.

    What a filter or coarse steps make of a torque is noise to a fit: it begins with what the best law of the drive
    leaves, and goes on with what it leaves itself.

    Args:
        recordings: On the control grid.
        measured: What their torques say.
        why_not: Why none can be followed; empty: they can.

    Raises:
        NoTorqueError: If no torque can be followed.
    """
    if not any(recording.dof_effort is not None for recording in recordings):
        raise NoTorqueError("--residual effort needs measured torques (dof_effort), and no recording has any.")
    noise: dict[str, float] = {}
    known: dict[str, list[MeasuredLaw]] = {}
    out: dict[str, list[str]] = {}
    for joint in recordings[0].joint_names:
        laws = list(measured.laws.get(joint, {}).values())
        reason = why_not or _why_not(joint, laws, measured)
        if reason:
            out.setdefault(reason, []).append(joint)
        else:
            noise[joint], known[joint] = max(law.residual for law in laws), laws
    if not noise:
        raise NoTorqueError(
            f"--residual effort: no torque can be followed: {'; '.join(out)}. Fit with --residual position."
        )
    notes = [f"dof_effort of {listed(joints, 6)} is left out of the residuals: {why}." for why, joints in out.items()]
    notes.insert(
        0,
        f"The fit follows dof_effort of {listed(list(noise), 6)} beside the positions. What is read from it is a start "
        "value.",
    )
    return TorqueChannel(
        noise=noise,
        floor={joint: _floor(recordings, joint, measured.laws[joint]) for joint in noise},
        lag={joint: float(np.median([law.feedback_lag for law in laws])) for joint, laws in known.items()},
        offsets={joint: _offsets(laws) for joint, laws in known.items()},
        notes=tuple(notes),
    )


def _offsets(laws: Sequence[MeasuredLaw]) -> tuple[float, float, float]:
    """Where the offset of a joint's sensor is sought [N m]."""
    most = _LARGEST_OFFSET * max(law.peak for law in laws)
    return -most, float(np.clip(np.median([law.offset for law in laws]), -most, most)), most


def _why_not(joint: str, laws: Sequence[MeasuredLaw], measured: MeasuredDrives) -> str:
    """Why the torque of a joint is not followed; empty: it is."""
    if not laws:
        return "it does not change, or is not there"
    if all(_repeats_the_command(law) for law in laws):
        return "it repeats the torque that is commanded"
    if joint in measured.contested_joints:
        return "it contradicts what is stated of the drive"
    if not all(follows(law) for law in laws):
        return "it is not the torque of a PD law"
    return ""


def _repeats_the_command(law: MeasuredLaw) -> bool:
    """Whether a torque shows nothing of a position or a speed."""
    fed_back = [(getattr(law, gain), law.std[gain]) for gain in ("stiffness", "damping") if gain in law.std]
    return law.feed_forward is not None and not any(abs(value) > SURE * std for value, std in fed_back)


def _floor(recordings: Sequence[Recording], joint: str, laws: Mapping[str, MeasuredLaw]) -> float:
    """Standard deviation of the noise of a joint's torque, over recordings that have it [N m].

    It is that of the spectrum above the motion, as an encoder's. A torque that is held has steps in its spectrum: what
    a law leaves of it is noise at most.
    """
    squares = []
    for recording in recordings:
        if recording.name in laws and recording.dof_effort is not None:
            torque = recording.dof_effort[:, recording.joint_names.index(joint)]
            of_spectrum = noise_floor(torque[np.isfinite(torque)], float(np.median(np.diff(recording.time)))).sigma
            squares.append(min(of_spectrum, laws[recording.name].residual) ** 2)
    return float(np.sqrt(np.mean(squares)))
