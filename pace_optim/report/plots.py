"""Figures of a run: what was commanded, measured and simulated, and how the score fell."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from pace_actuators.joint_units import JointType, all_hinges, units_for
from pace_actuators.text import count_in_short, position_text, position_unit
from pace_optim.run.history import History
from pace_optim.run.tensors import RecordingData, Trajectories, held_out_spans, rms

_TARGET, _MEASURED, _SIMULATED, _HELD_OUT = "#a5abb2", "#1f5fa8", "#e07b00", "#8a6fc4"
_JOINTS_PER_FIGURE = 12
_GRID: dict[str, Any] = {"alpha": 0.25, "linewidth": 0.6}


def plot_trajectories(
    trajectories: Trajectories,
    *,
    joint_types: Sequence[JointType] = (),
    title: str = "",
    make_figure: Callable[..., Figure] = Figure,
) -> dict[str, Figure]:
    """Draw every joint of every recording: positions above, the error underneath, validation data shaded.

    Args:
        trajectories: As :func:`pace_optim.run.tensors.read_trajectory` reads them.
        joint_types: Whether each joint turns or slides; none: all turn.
        make_figure: Makes a figure of a ``figsize`` and ``layout``; ``matplotlib.pyplot.figure`` to see it on screen.

    Returns:
        One figure per recording and dozen joints, by a name fit for a file.
    """
    names = trajectories.joint_names
    types = joint_types or all_hinges(len(names))
    parts = [range(i, min(i + _JOINTS_PER_FIGURE, len(names))) for i in range(0, len(names), _JOINTS_PER_FIGURE)]
    figures = {}
    for r, recording in enumerate(trajectories.recordings):
        for p, joints in enumerate(parts):
            stem = "trajectory_" + (re.sub(r"[^\w.-]+", "_", recording.name).strip("._") or str(r + 1))
            stem += f"_{p + 1}" if len(parts) > 1 else ""
            stem += f"_recording_{r + 1}" if stem in figures else ""
            heading = " · ".join(text for text in (title, recording.name) if text)
            figures[stem] = _plot_joints(recording, names, types, joints, heading, make_figure)
    return figures


def _tight_layout() -> ConstrainedLayoutEngine:
    return ConstrainedLayoutEngine(h_pad=0.02, hspace=0.0)


def _plot_joints(
    recording: RecordingData,
    names: Sequence[str],
    types: Sequence[JointType],
    joints: Sequence[int],
    title: str,
    make_figure: Callable[..., Figure],
) -> Figure:
    """One figure of some joints of one recording."""
    columns = min(3, len(joints))
    rows = -(-len(joints) // columns)
    figure = make_figure(figsize=(max(9.0, 5.4 * columns), 1.1 + max(3.9, 3.1 * rows)), layout=_tight_layout())
    largest = np.abs(recording.error)[:, list(joints)].max(axis=0)
    factor, unit = position_unit(largest, ["hinge"])
    outer = figure.add_gridspec(rows, columns)
    for place, j in enumerate(joints):
        inner = outer[place // columns, place % columns].subgridspec(2, 1, height_ratios=(2.6, 1), hspace=0.04)
        above = figure.add_subplot(inner[0])
        below = figure.add_subplot(inner[1], sharex=above)
        _plot_joint(above, below, recording, j, factor)
        above.set_title(names[j], fontsize=10, loc="left")
        above.set_title(_errors(recording, j, types[j]), fontsize=8, loc="right", color="#5f6368")
        if place % columns == 0 or types[j] != types[joints[place - 1]]:
            above.set_ylabel(units_for("position [rad]", [types[j]]), fontsize=9)
            below.set_ylabel(units_for(f"error [{unit}]", [types[j]]), fontsize=9)
        if place + columns >= len(joints):
            below.set_xlabel("time [s]", fontsize=9)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=color, lw=2, label=label)
        for color, label in ((_TARGET, "target"), (_MEASURED, "measured"), (_SIMULATED, "simulated"))
    ]
    if recording.held_out.any():
        handles.append(Patch(color=_HELD_OUT, alpha=0.14, lw=0, label="kept for validation"))
    figure.suptitle(title, fontsize=11)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)
    return figure


def _plot_joint(above: Axes, below: Axes, recording: RecordingData, j: int, factor: float) -> None:
    time = recording.time
    above.plot(time, recording.target[:, j], color=_TARGET, lw=0.9, alpha=0.7)
    above.plot(time, recording.measured[:, j], color=_MEASURED, lw=1.3)
    above.plot(time, recording.simulated[:, j], color=_SIMULATED, lw=0.9, ls=(0, (4, 1.5)))
    below.plot(time, factor * recording.error[:, j], color=_SIMULATED, lw=0.7)
    below.axhline(0.0, color="0.5", lw=0.6)
    for axes in (above, below):
        for start, end in held_out_spans(time, ~recording.held_out):
            axes.axvspan(start, end, color=_HELD_OUT, alpha=0.14, lw=0)
        axes.grid(**_GRID)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    above.set_xlim(time[0], time[-1])
    above.tick_params(labelbottom=False)


def _errors(recording: RecordingData, j: int, joint_type: JointType) -> str:
    error = recording.error[:, j]
    parts = (("train", rms(error[recording.train])), ("validation", rms(error[recording.held_out])))
    return ",  ".join(f"{name} {position_text(value, [joint_type])}" for name, value in parts if value is not None)


def plot_scores(
    history: History,
    *,
    joint_types: Iterable[JointType] = ("hinge",),
    title: str = "",
    make_figure: Callable[..., Figure] = Figure,
) -> Figure:
    """Draw the score over the iterations of search and refinement; the axis above counts simulated steps.

    Args:
        joint_types: Of the joints whose errors are in the score.
        make_figure: Makes a figure of a ``figsize`` and ``layout``; ``matplotlib.pyplot.figure`` to see it on screen.
    """
    figure = make_figure(figsize=(9.0, 5.0), layout=_tight_layout())
    axes = figure.add_subplot()
    search, refine = history.places()
    mark = "o" if len(search) + len(refine) < 60 else None
    if search:
        axes.plot(search, history.search_mean, color=_TARGET, lw=1.2, label="search, mean of the generation")
        axes.plot(search, history.search_best, color=_MEASURED, lw=1.8, marker=mark, ms=3, label="search, best so far")
    if refine:
        axes.plot(refine, history.refine_best, color=_SIMULATED, lw=1.8, marker=mark, ms=3, label="refinement, best")
    if search or refine:
        axes.set_yscale("log", nonpositive="mask")
        axes.legend(frameon=False, fontsize=9)
        _steps_above(axes, sorted([*history.search_steps, *history.refine_steps]))
    else:
        axes.text(0.5, 0.5, "no iteration was recorded", ha="center", va="center", transform=axes.transAxes)
    axes.set_xlabel("iteration (generations of the search, iterations of the refinement)" if refine else "generation")
    axes.set_ylabel(units_for("score [rad²]", joint_types))
    axes.grid(**_GRID)
    axes.spines["right"].set_visible(False)
    figure.suptitle(title, fontsize=11)
    return figure


def _steps_above(axes: Axes, steps: Sequence[int]) -> None:
    """A second x axis in simulated steps, which do not grow evenly with the iterations."""
    count = len(steps)
    axes.set_xlim(0.5, count + 0.5)
    marks = np.unique(np.linspace(1, count, min(6, count)).round().astype(int))
    upper = axes.secondary_xaxis("top")
    upper.set_xticks(marks, [count_in_short(steps[mark - 1]) for mark in marks])
    upper.set_xlabel("simulated steps")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
