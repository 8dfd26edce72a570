"""From the laws of single joints to the facts of a robot's drives: what is taken, and what contradicts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import listed
from pace_optim.recording import Recording
from pace_optim.recording.commands import acting_loops
from pace_optim.recording.noise import noise_floor

from .law import APART, SURE, MeasuredLaw, has_offset, read_law

FOLLOWS = 0.9
"""A torque of which the law explains less is not that of this law: a current with much else in it, or another unit."""
_OF_THE_LAW = ("stiffness", "damping")
_ROOM_WITH_SCALE = 5.0
"""How far from a gain that is read a fit seeks it, both ways, where a scale of the torque is sought beside it."""
_LEAST_ROOM, _MOST_ROOM = 0.01, 0.5
"""Parts of a gain that is read within which a fit refines it, at least and at most."""


@dataclass(frozen=True, kw_only=True)
class MeasuredDrives:
    """What the torques of some recordings say of the drives."""

    recordings: tuple[Recording, ...] = ()
    """The recordings with the facts that were taken from their torques."""
    laws: Mapping[str, Mapping[str, MeasuredLaw]] = field(default_factory=dict)
    """By joint and recording."""
    taken: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """Joints on which a fact (field of ``Drive``) was taken in every recording, by the fact."""
    delay_bounds: tuple[float, float] | None = None
    """Between what all torques have the delay of commands [control steps]; ``None`` where they do not say it."""
    notes: tuple[str, ...] = ()
    """What was read, a line for each joint."""
    warnings: tuple[str, ...] = ()
    """What contradicts what is stated."""
    contested: tuple[str, ...] = ()
    """Facts that are stated and that a torque contradicts: what is stated is used."""
    contested_joints: frozenset[str] = frozenset()
    """Joints of which such a fact is."""

    def gain_bounds(
        self, facts: Collection[str], factors: Mapping[str, str], sensed: Collection[str] = ()
    ) -> dict[str, dict[str, Any]]:
        """Within what unknown gains are refined that torques say: lower, start and upper factor, by label and joint.

        Args:
            factors: The parameter that is a factor of each gain.
            sensed: Joints whose torques a fit follows: their gains are as unsure as their sensors' scales.
        """
        result: dict[str, dict[str, Any]] = {}
        for fact in facts:
            for joint in self.taken.get(fact, ()) if fact in factors else ():
                laws = self.laws[joint].values()
                known = [law for law in laws if fact in law.std and getattr(law, fact)]
                off = max((law.std[fact] / abs(getattr(law, fact)) for law in known), default=0.0)
                width = min(max(SURE * off, _LEAST_ROOM), _MOST_ROOM)
                bounds = (
                    (1 / _ROOM_WITH_SCALE, 1.0, _ROOM_WITH_SCALE) if joint in sensed else (1 - width, 1.0, 1 + width)
                )
                result.setdefault(factors[fact], {})[joint] = bounds
        return result

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """The laws for a JSON file, by joint and recording."""
        return {
            joint: {name: {k: v for k, v in asdict(law).items() if k != "joint"} for name, law in laws.items()}
            for joint, laws in self.laws.items()
        }


def read_drives(
    recordings: Sequence[Recording],
    configured: Mapping[str, np.ndarray],
    *,
    delay_bounds: tuple[float, float],
    delay_mode: str,
    control_dt: float,
    unknown: Collection[str] = (),
    assumed: Collection[str] = (),
    slides: Collection[str] = (),
    sensed: Collection[str] = (),
) -> MeasuredDrives:
    """Read the law of every joint in every recording that has its torque, and take the facts that are not stated.

    Args:
        configured: Gains and limits where a recording states none, by field, (n,).
        delay_bounds: Between what the delay is sought [control steps].
        control_dt: Control step [s].
        unknown: Facts that are stated and that are not to be believed.
        assumed: Joints without stated gains: the configured ones are assumed.
        sensed: Joints whose torques a fit follows: a constant part is one of their sensors, and not of their drives.
    """
    laws: dict[str, dict[str, MeasuredLaw]] = {}
    changed: list[Recording] = []
    warnings: dict[str, str] = {}
    taken_in: list[dict[str, set[str]]] = []
    contested: dict[str, dict[str, None]] = {}
    for recording in recordings:
        own = {j: law for j in range(recording.num_joints) if (law := read_law(recording, j, delay_bounds[1]))}
        for law in own.values():
            laws.setdefault(law.joint, {})[recording.name] = law
        good = {j: law for j, law in own.items() if follows(law)}
        new, taken, said = _with_facts(recording, good, configured, unknown, assumed, slides, sensed)
        for fact, joint, text in said:
            warnings.setdefault(f"{fact} {joint}", f"{recording.name}: {text}")
            if joint not in taken.get(fact, ()):
                contested.setdefault(fact, {})[joint] = None
        changed.append(new)
        taken_in.append(taken)
    every = [law for by_recording in laws.values() for law in by_recording.values() if follows(law)]
    bounds, sentence = _delay(every, delay_bounds, delay_mode, control_dt)
    lines = [_line_of_joint(list(by.values()), control_dt, _type(j, slides)) for j, by in laws.items()]
    return MeasuredDrives(
        recordings=tuple(changed),
        laws=laws,
        taken={
            fact: frozenset.intersection(*(frozenset(t.get(fact, ())) for t in taken_in))
            for fact in {f for t in taken_in for f in t}
        },
        delay_bounds=bounds,
        notes=(*lines, *([sentence] if sentence else [])),
        warnings=tuple(warnings.values()),
        contested=tuple(contested),
        contested_joints=frozenset(joint for joints in contested.values() for joint in joints),
    )


def _type(joint: str, slides: Collection[str]) -> JointType:
    return "slide" if joint in slides else "hinge"


def follows(law: MeasuredLaw) -> bool:
    """Whether a torque is that of a PD law."""
    gains = ((law.stiffness, law.std.get("stiffness", 0.0)), (law.damping, law.std.get("damping", 0.0)))
    return law.r_squared >= FOLLOWS and all(gain >= -SURE * std for gain, std in gains)


def _with_facts(
    recording: Recording,
    laws: Mapping[int, MeasuredLaw],
    configured: Mapping[str, np.ndarray],
    unknown: Collection[str],
    assumed: Collection[str],
    slides: Collection[str],
    sensed: Collection[str],
) -> tuple[Recording, dict[str, set[str]], list[tuple[str, str, str]]]:
    """A recording with the facts that its torques show; the facts taken; the contradictions as fact, joint, text.

    What the recording or the robot's configuration states holds, unless it is declared unknown.
    """
    facts: dict[str, np.ndarray] = {}
    taken: dict[str, set[str]] = {}
    said: list[tuple[str, str, str]] = []
    for fact in (*_OF_THE_LAW, "effort_limit"):
        stated = getattr(recording.drive, fact)
        values = np.array(configured[fact] if stated is None else stated, dtype=np.float64, copy=True)
        if stated is None and fact == "damping":  # a position loop without targets does not act, nor does its damping
            values = np.where(acting_loops(recording, np.asarray(configured["stiffness"]))[1], values, np.nan)
        for j, law in laws.items():
            value, std = _value(law, fact)
            if value is None:
                continue
            known = stated is not None or (
                np.isfinite(values[j]) and (law.joint not in assumed or fact not in _OF_THE_LAW)
            )
            holds = known and fact not in unknown
            if known and apart(value, std, float(values[j])):
                text = contradiction(
                    law, fact, float(values[j]), value, std, stated is not None, holds, _type(law.joint, slides)
                )
                said.append((fact, law.joint, text))
            if not holds:
                values[j] = value
                taken.setdefault(fact, set()).add(law.joint)
        if fact in taken:
            facts[fact] = values
    changed = replace(recording, drive=replace(recording.drive, **facts)) if facts else recording
    return _with_feed_forward(replace(changed, logged=None), laws, sensed), taken, said


def _value(law: MeasuredLaw, fact: str) -> tuple[float | None, float]:
    """What a torque says of a fact, with its standard deviation."""
    if fact == "effort_limit":
        return law.limit, 0.0
    return (getattr(law, fact), law.std[fact]) if fact in law.std else (None, 0.0)


def apart(value: float, std: float, stated: float) -> bool:
    """Whether a value contradicts what is stated."""
    if not np.isfinite(stated):
        return False
    return abs(value - stated) > max(SURE * std, APART * abs(stated))


def _with_feed_forward(recording: Recording, laws: Mapping[int, MeasuredLaw], sensed: Collection[str]) -> Recording:
    """The commanded torques as the drives take them, with the constant ones that no command says."""
    shape = (recording.num_samples - 1) * recording.sample_stride + 1, recording.num_joints
    effort = np.zeros(shape) if recording.command_effort is None else recording.command_effort.copy()
    changed = False
    for j, law in laws.items():
        if law.feed_forward is not None and apart(law.feed_forward, law.std["feed_forward"], 1.0):
            effort[:, j] *= law.feed_forward
            changed = True
        if has_offset(law) and law.joint not in sensed:
            effort[:, j] += law.offset
            changed = True
    return replace(recording, command_effort=effort) if changed else recording


def _delay(
    laws: Sequence[MeasuredLaw], bounds: tuple[float, float], delay_mode: str, control_dt: float
) -> tuple[tuple[float, float] | None, str]:
    """Where the delay is sought for what all torques say of it [control steps], and a sentence on that or why not."""
    known = [law for law in laws if law.stiffness > 0 or law.feed_forward is not None]
    if not known:
        return None, ""
    low = max(bounds[0], *(law.delay - law.resolution for law in known))
    high = min(bounds[1], *(law.delay + law.resolution for law in known))
    step = 1e3 * control_dt
    if all(law.feedback_lag > 0 and abs(law.delay) < law.resolution for law in known):
        return None, (
            "In dof_effort the position is as late as the command: the log has its torques late, or the drives delay "
            "their torque (--delay_mode effort)."
        )
    if delay_mode != "command":
        return None, ""
    if low < high:
        return (low, high), f"By dof_effort the delay is sought from {step * low:.3g} to {step * high:.3g} ms."
    first, last = min(law.delay for law in known), max(law.delay for law in known)
    return None, (
        f"By dof_effort the delays are {step * first:.3g} to {step * last:.3g} ms. No delay within the bounds fits all "
        "of them, so it is sought within its bounds."
    )


_WORDS = {"stiffness": "stiffness", "damping": "damping", "effort_limit": "torque limit"}
_EXACT = 0.02
"""How near a ratio is to one of units."""
_FACTORS = (
    (180 / np.pi, ("180/pi", "positions or speeds may be in degrees, or the gain per degree")),
    (2 * np.pi, ("2 pi", "positions or speeds may be in turns, or the gain per turn")),
    (1000.0, ("1000", "a series may be in thousandths (mrad, mN m, permille)")),
)
_UNITS = {"stiffness": "N m/rad", "damping": "N m s/rad", "effort_limit": "N m"}


def _line_of_joint(laws: Sequence[MeasuredLaw], control_dt: float, joint_type: JointType) -> str:
    """One line on a joint, of its laws in all recordings."""
    good = [law for law in laws if follows(law)]
    joint = laws[0].joint
    if not good:
        best = max(law.r_squared for law in laws)
        return (
            f"{joint}: dof_effort is not the torque of a PD law of its error (R² {best:.2g}): nothing is read from it."
        )
    parts = [
        f"kp {kp} N m/rad" if (kp := _values(good, "stiffness")) else "",
        f"kd {kd} N m s/rad" if (kd := _values(good, "damping")) else "",
        f"feed-forward {part}" if (part := _values(good, "feed_forward")) else "",
        f"constant {_values(good, 'offset')} N m" if any(has_offset(law) for law in good) else "",
        f"delay {_range([1e3 * control_dt * law.delay for law in good])} ms",
        _limit(good),
    ]
    r_squared = min(law.r_squared for law in good)
    residual = max(law.residual for law in good)
    text = (
        f"{joint}: its dof_effort says {', '.join(part for part in parts if part)} "
        f"(R² {r_squared:.4f}, residual {residual:.2g} N m)."
    )
    return units_for(text, [joint_type])


def contradiction(
    law: MeasuredLaw,
    fact: str,
    stated: float,
    value: float,
    std: float,
    by_recording: bool,
    holds: bool,
    joint_type: JointType,
) -> str:
    """What is stated, what the torque says, which of the two counts, and whether a unit is the reason."""
    error = f" ± {std:.1g}" if std else ""
    where = "stated" if by_recording else "configured"
    text = f"{_WORDS[fact]} of {law.joint} is {where} as {stated:.4g} {_UNITS[fact]}, and its dof_effort says "
    text += f"{value:.4g}{error}"
    if unit := _unit_between(value / stated if stated else 0.0):
        text += f", {unit}"
    if holds:
        text += f": the {where} value is used. Correct {fact}, or fit with --unknown {fact}. [W4]"
    else:
        text += ": the torque's value is used. [W4]"
    return units_for(text, [joint_type])


def _unit_between(ratio: float) -> str:
    """The units that a ratio of a gain by torque to that which is stated may come from; "" for none."""
    for factor, words in _FACTORS:
        for own, what in ((factor, f"{words[0]} times that"), (1 / factor, f"{words[0]} times less")):
            if abs(ratio / own - 1) < _EXACT:
                return f"{what}: {words[1]}"
    return ""


def _values(laws: Sequence[MeasuredLaw], field: str) -> str:
    """A value with its error, or from the smallest to the largest of several recordings; "" where no law has it."""
    laws = [law for law in laws if field in law.std]
    if not laws:
        return ""
    text = _range([getattr(law, field) for law in laws])
    return text if " to " in text else f"{text} ± {max(law.std[field] for law in laws):.1g}"


def _range(values: Sequence[float]) -> str:
    low, high = (f"{0.0 + round(each, 9):.4g}" for each in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _limit(laws: Sequence[MeasuredLaw]) -> str:
    cut = [law.limit for law in laws if law.limit is not None]
    if cut:
        return f"limit {_range(cut)} N m"
    return f"no limit up to {max(law.peak for law in laws):.3g} N m"


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
    notes = (
        f"The fit follows dof_effort of {listed(noise, 6)} beside the positions. What is read from it is a "
        "start value.",
        *(f"dof_effort of {listed(joints, 6)} is left out of the residuals: {why}." for why, joints in out.items()),
    )
    return TorqueChannel(
        noise=noise,
        floor={joint: _floor(recordings, joint, measured.laws[joint]) for joint in noise},
        lag={joint: float(np.median([law.feedback_lag for law in laws])) for joint, laws in known.items()},
        offsets={joint: _offsets(laws) for joint, laws in known.items()},
        notes=notes,
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
