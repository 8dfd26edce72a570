"""What was fitted: what was noticed when it was read, and what it asked of the drives."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from pace_actuators.text import position_unit, three_figures
from pace_optim.run.tensors import RecordingData, rms

from ..markup import Section, bold, bullets, folded, html, table
from ..run_data import RunData

_DRIVES = 40
"""Rows of the table of drives that are shown at once."""


def recordings(run: RunData) -> Section:
    """A row per recording, its notes underneath; then the drives in each."""
    rows, notes = [], [*run.result.findings, *run.result.notes]
    factor, unit = position_unit([error_of(recording) for recording in run.recordings], run.result.joint_types)
    for recording in run.recordings:
        own = [note for note in notes if note.startswith(f"{recording.name}: ")]
        notes = [note for note in notes if note not in own]
        said = bullets([note.removeprefix(f"{recording.name}: ") for note in own], "notes") if own else ""
        error = three_figures(factor * error_of(recording))
        rows.append([bold(recording.name), error, *_facts(recording), said])
    head = ["recording", f"error [{unit}]", "used for", "length", "samples", "rate", "notes"]
    uses = (
        "{% for use, names in uses.items() %}<p>{{ use.capitalize() }}: {{ names | join(', ') or 'nothing' }}</p>"
        "{% endfor %}"
    )
    shown = table(head, rows, "recordings") if rows else html(uses, uses=run.result.recordings)
    shown += bullets(notes, "notes") if notes else ""
    drives = _drives(run, [each.name for each in run.recordings])
    return Section(id="recordings", title="Recordings", html=shown + drives)


def error_of(recording: RecordingData) -> float:
    """Root mean square over all joints and samples; large where it is no number."""
    return rms(np.nan_to_num(recording.error, nan=1e3, posinf=1e3, neginf=-1e3)) or 0.0


def _facts(recording: RecordingData) -> list[str]:
    share = float(recording.train.mean())
    use = (
        "training"
        if share == 1
        else "validation"
        if share == 0
        else f"training {share:.0%}, validation {1 - share:.0%}"
    )
    step = float(np.median(np.diff(recording.time))) if len(recording.time) > 1 else np.nan
    return [
        use.replace("%", " %"),
        f"{recording.time[-1] - recording.time[0]:.4g} s",
        f"{len(recording.time)}",
        f"{1 / step:.4g} Hz" if step > 0 else "–",
    ]


def _drives(run: RunData, order: list[str]) -> Markup:
    """The drive in force in each recording, what was asked of it, and what gravity takes."""
    every = run.read_json("drives.json") or []
    every = sorted(every, key=lambda each: order.index(each["recording"]) if each["recording"] in order else len(order))
    rows = [[bold(each["recording"]), joint, *_drive(own)] for each in every for joint, own in each["joints"].items()]
    if not rows:
        return Markup("")
    head = [
        "recording",
        "joint",
        "kp",
        "kd",
        "torque asked, peak",
        "RMS",
        "limit",
        "gravity, peak",
        "speed, peak",
        "limit",
    ]
    shown = table(head, rows[:_DRIVES])
    if more := rows[_DRIVES:]:
        shown += folded(len(more), table(head, more))
    about = "gains and limits in force; torques in N m, speeds in rad/s, of a slide in N and m/s"
    return html("<h3>What was asked of the drives<small>{{ about }}</small></h3>{{ shown }}", about=about, shown=shown)


def _drive(own: dict[str, Any]) -> list[str]:
    limits = [own[name] for name in ("effort_limit", "saturation_effort") if own[name] is not None]
    limit = min(limits) if limits else None
    return [
        _number(own["stiffness"]),
        _number(own["damping"]),
        _beyond(own["asked_peak"], limit),
        f"{own['asked_rms']:.3g}",
        _number(limit),
        f"{own['gravity_peak']:.3g}",
        # without a stall torque there is no torque-speed line, and the limit does not act
        _beyond(own["speed_peak"], None if own["saturation_effort"] is None else own["velocity_limit"]),
        _number(own["velocity_limit"]),
    ]


def _beyond(value: float, limit: float | None) -> str:
    """A value, flagged where it is beyond its limit."""
    text = f"{value:.3g}"
    within = limit is None or value <= limit
    return text if within else html('{{ value }} <span class="flag">beyond</span>', value=text)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
