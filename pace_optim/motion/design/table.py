"""The expected error bars as text for a terminal."""

from __future__ import annotations

import math

from pace_actuators.joint_units import units_for
from pace_envs.tasks.pace import GLOBAL
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.error_bars.warnings import in_words

from .design import Design


def design_table(design: Design) -> list[str]:
    """Expected error bars of every parameter, before and after; how each joint moves; what stays unknown.

    Returns:
        Its lines.
    """
    space = design.space
    own = [p for p in space.parameters if not p.shared]
    joints = design.trajectory.joint_names
    width = max(len(joint) for joint in [*joints, "joint"])
    titles = [f"{p.name} [{' or '.join(dict.fromkeys(p.units or (p.unit,)))}]" for p in own]
    columns = [max(len(title), 19) for title in titles]
    noise = units_for(f"{design.noise:g} rad", design.joint_types)
    lines = [
        f"expected error bars (one standard deviation) for encoder noise of {noise}: "
        f"unoptimised -> optimised, {design.tried} candidates tried",
        "  ".join(["joint".ljust(width), *(t.rjust(c) for t, c in zip(titles, columns, strict=True)), "  motion"]),
    ]
    for j, joint in enumerate(joints):
        cells = [_change(design, f"{p.name}/{joint}").rjust(c) for p, c in zip(own, columns, strict=True)]
        lines.append("  ".join([joint.ljust(width), *cells, f"  {_motion(design, j)}"]))
    lines += [f"{p.name}: {_change(design, f'{p.name}/{GLOBAL}')} {p.unit}" for p in space.parameters if p.shared]
    before, after = (100 * math.exp(v) for v in (design.criterion_before, design.criterion_after))
    lines.append(
        f"geometric mean of the error bars: {before:.3g} % -> {after:.3g} % of the bound range "
        f"({math.exp(design.criterion_before - design.criterion_after):.2f} times better)"
    )
    if design.slowed:
        lines.append(
            f"The motion asked for has targets faster than the drive on {', '.join(design.slowed)} (its error bars: "
            f"{100 * math.exp(design.criterion_asked):.3g} %); unoptimised is the same, smaller where too fast."
        )
    return lines + _unknown("unoptimised", design.before) + _unknown("optimised", design.after)


def _change(design: Design, label: str) -> str:
    i = design.space.labels.index(label)
    return " -> ".join("-" if math.isnan(u.std[i]) else f"{u.std[i]:.2g}" for u in (design.before, design.after))


def _motion(design: Design, j: int) -> str:
    motion = design.joints[j]
    if motion is None:
        return "as it was"
    place = units_for(f"{motion.centre:+.2f} ± {abs(motion.amplitude):.2f} rad", design.joint_types[j : j + 1])
    return f"{place}, {motion.min_frequency:.2g} to {motion.max_frequency:.2g} Hz"


def _unknown(which: str, uncertainty: Uncertainty) -> list[str]:
    lines = [f"{which}: the recording cannot separate {in_words(group)}." for group in uncertainty.indistinguishable]
    if uncertainty.no_influence:
        lines.append(f"{which}: no influence: {', '.join(uncertainty.no_influence)}.")
    return lines
