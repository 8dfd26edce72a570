"""Drawing a motion: targets and what was measured, joint by joint."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pace_actuators.files import write_atomically
from pace_actuators.joint_units import JointType, units_for
from pace_optim.motion.signals import Trajectory

_TARGET, _TARGET_ALONE, _MEASURED, _LIMIT = "#b4b9bf", "#5f6368", "#1f5fa8", "#c0392b"


def plot_motion(
    path: str | os.PathLike[str],
    trajectory: Trajectory,
    measured: np.ndarray | None = None,
    *,
    title: str,
    position_limits: np.ndarray | None = None,
    joint_types: Sequence[JointType] = (),
) -> Path:
    """Draw targets and positions over time as PNG, one panel per joint. The file appears whole or not at all.

    Args:
        measured: Encoder positions, (T, n) [rad].
        position_limits: (n, 2) [rad]; drawn where they lie in or near the range of motion.
        joint_types: Whether each joint turns or slides; none: all turn.
    """
    path = Path(path)
    names = trajectory.joint_names
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(max(4.6 * columns, 9.0), 1.0 + max(2.0 * rows, 3.4)), layout="constrained")
    FigureCanvasAgg(figure)
    target_color = _TARGET if measured is not None else _TARGET_ALONE
    label = "target" if measured is not None else "target (nothing was simulated)"
    end = trajectory.time[-1] + trajectory.time[1] - trajectory.time[0]
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for j, panel in enumerate(panels.flat):
        if j >= len(names):
            panel.set_visible(False)
            continue
        style = "steps-post" if trajectory.has_jumps else "default"
        panel.plot(
            trajectory.time, trajectory.des_dof_pos[:, j], color=target_color, lw=0.9, drawstyle=style, label=label
        )
        if measured is not None:
            panel.plot(trajectory.time, measured[:, j], color=_MEASURED, lw=0.8, label="measured by the encoder")
        low, high = panel.get_ylim()
        if position_limits is not None:
            margin = 0.3 * (high - low)
            near = [x for x in position_limits[j] if low - margin <= x <= high + margin]
            for n, limit in enumerate(near):
                panel.axhline(limit, color=_LIMIT, lw=0.9, ls="--", label="joint limit" if n == 0 else None)
        panel.set_title(names[j], fontsize=9)
        panel.set_xlim(0.0, end)
        panel.grid(alpha=0.25)
        panel.tick_params(labelsize=8)
        if j % columns == 0 or joint_types[j : j + 1] != joint_types[j - 1 : j]:
            panel.set_ylabel(units_for("position [rad]", joint_types[j : j + 1]), fontsize=9)
        if j + columns >= len(names):
            panel.set_xlabel("time [s]", fontsize=9)
            panel.tick_params(labelbottom=True)
    entries = {label: line for p in panels.flat for line, label in zip(*p.get_legend_handles_labels(), strict=True)}
    figure.suptitle(title, fontsize=11)
    legend = figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=len(entries), frameon=False, fontsize=9
    )
    for line in legend.get_lines():
        line.set_linewidth(2)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=110))
    return path
