"""What a measured torque says of a drive, in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pace_actuators.joint_units import JointType, units_for

from .law import MeasuredLaw, has_offset

_WORDS = {"stiffness": "stiffness", "damping": "damping", "effort_limit": "torque limit"}
_EXACT = 0.02
"""How near a ratio is to one of units."""
_FACTORS = (
    (180 / np.pi, ("180/pi", "positions or speeds may be in degrees, or the gain per degree")),
    (2 * np.pi, ("2 pi", "positions or speeds may be in turns, or the gain per turn")),
    (1000.0, ("1000", "a series may be in thousandths (mrad, mN m, permille)")),
)
_UNITS = {"stiffness": "N m/rad", "damping": "N m s/rad", "effort_limit": "N m"}


def line_of_joint(
    laws: Sequence[MeasuredLaw], follows: Callable[[MeasuredLaw], bool], control_dt: float, joint_type: JointType
) -> str:
    """One line on a joint, of all its recordings.

    Args:
        laws: Of the joint, one for each recording.
        follows: Whether a torque follows a law.
        control_dt: Control step [s].
        joint_type: Whether the joint turns or slides.
    """
    good = [law for law in laws if follows(law)]
    joint = laws[0].joint
    if not good:
        best = max(law.r_squared for law in laws)
        return (
            f"{joint}: dof_effort is not the torque of a PD law of its error (R² {best:.2g}): nothing is read from it."
        )
    parts = [
        f"kp {_values(good, 'stiffness')} N m/rad" if "stiffness" in good[0].std else "",
        f"kd {_values(good, 'damping')} N m s/rad" if "damping" in good[0].std else "",
        f"feed-forward {_values(good, 'feed_forward')}" if good[0].feed_forward is not None else "",
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


def delay_sentence(
    span: tuple[float, float],
    bounds: tuple[float, float],
    used: bool,
    late: bool,
    delay_mode: str,
    control_dt: float,
) -> str:
    """Where the delay is sought for what the torques say, or why they say nothing of it.

    Args:
        span: Smallest and largest delay of the joints [control steps].
        bounds: Where all of them allow it [control steps].
        used: Whether it is sought there.
        late: Whether position and command are as late as each other in every torque.
        delay_mode: What the drives delay.
        control_dt: Control step [s].
    """
    low, high = (1e3 * control_dt * each for each in bounds)
    if used:
        return f"By dof_effort the delay is sought from {low:.3g} to {high:.3g} ms."
    if late:
        return (
            "In dof_effort the position is as late as the command: the log has its torques late, or the drives delay "
            "their torque (--delay_mode effort)."
        )
    if delay_mode == "command":
        first, last = (1e3 * control_dt * each for each in span)
        return (
            f"By dof_effort the delays are {first:.3g} to {last:.3g} ms. No delay within the bounds fits all of them, "
            "so it is sought within its bounds."
        )
    return ""


def _values(laws: Sequence[MeasuredLaw], field: str) -> str:
    """A value with its error, or from the smallest to the largest of several recordings."""
    values = [getattr(law, field) for law in laws]
    text = _range(values)
    return text if " to " in text else f"{text} ± {max(law.std[field] for law in laws):.1g}"


def _range(values: Sequence[float]) -> str:
    low, high = (f"{0.0 + round(each, 9):.4g}" for each in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _limit(laws: Sequence[MeasuredLaw]) -> str:
    cut = [law.limit for law in laws if law.limit is not None]
    if cut:
        return f"limit {_range(cut)} N m"
    return f"no limit up to {max(law.peak for law in laws):.3g} N m"
