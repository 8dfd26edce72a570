"""What was commanded, measured and simulated: one joint of one recording at a time, error underneath."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import position_unit, three_figures
from pace_optim.run.tensors import RecordingData, held_out_spans, rms

from ..markup import Section, choice, curve, html, json_script
from ..run_data import RunData

_SAMPLES_ON_PAGE = 70_000
"""Of all joints and recordings together; each takes some 7 bytes of the page."""
_STEP = 1e-6
"""To which positions and times are rounded [rad, m, s]."""
_FEWEST_PER_CURVE = 1200
_MOST_PER_CURVE = 20_000


def trajectories(run: RunData) -> Section | None:
    """Curves to choose from."""
    if not run.recordings:
        return None
    per_curve = _SAMPLES_ON_PAGE // (len(run.recordings) * len(run.joint_names))
    per_curve = min(max(per_curve, _FEWEST_PER_CURVE), _MOST_PER_CURVE)
    content = {
        "joints": list(run.joint_names),
        "recordings": [_encode(recording, per_curve, run.result.joint_types) for recording in run.recordings],
    }
    r, j = _largest_error(run.recordings)
    return Section(
        id="trajectories",
        title="Trajectories",
        lead="Drag to zoom, double click to see all. The zoom stays when the joint changes.",
        html=html(
            '<div class="explorer">{{ recording }}{{ joint }}<p class="errors-here"></p>'
            '<div class="canvas" style="height:540px"></div>{{ script }}</div>',
            recording=choice("recording", [each.name for each in run.recordings], at=r),
            joint=choice("joint", run.joint_names, at=j),
            script=json_script(content),
        ),
    )


def _largest_error(recordings: Sequence[RecordingData]) -> tuple[int, int]:
    """Recording and joint that the curves open on: those with the largest error."""
    errors = [
        rms(np.nan_to_num(recording.error[:, j], nan=1e3, posinf=1e3, neginf=-1e3)) or 0.0
        for recording in recordings
        for j in range(recording.error.shape[1])
    ]
    return divmod(int(np.argmax(errors)), recordings[0].error.shape[1])


def _encode(recording: RecordingData, per_curve: int, joint_types: Sequence[JointType]) -> dict:
    """One recording for the page's script: curves rounded to a step below what can be seen."""
    time = recording.time - recording.time[0]
    return {
        "name": recording.name,
        "time": curve(time, _STEP),
        "held_out": held_out_spans(time, ~recording.held_out),
        "joints": [_encode_joint(recording, j, per_curve, own) for j, own in enumerate(joint_types)],
    }


def _encode_joint(recording: RecordingData, j: int, per_curve: int, joint_type: JointType) -> dict:
    target, measured, error = recording.target[:, j], recording.measured[:, j], recording.error[:, j]
    kept = samples_to_draw((error, measured, target), per_curve)
    factor, unit = position_unit([float(np.abs(error).max(initial=0.0))], [joint_type])
    step = 5e-5 * float(np.abs(error[np.isfinite(error)]).max(initial=0.0))
    train, held_out = rms(error[recording.train]), rms(error[recording.held_out])
    parts = [(name, value) for name, value in (("training", train), ("validation", held_out)) if value is not None]
    words = ", ".join(f"{three_figures(factor * value)} {unit} in {name}" for name, value in parts)
    return {
        "sample": None if len(kept) == len(error) else curve(kept, 1.0),
        "target": curve(target[kept], _STEP),
        "measured": curve(measured[kept], _STEP),
        "error": curve(error[kept], min(_STEP, step) or _STEP),
        "factor": factor,
        "unit": unit,
        "position_unit": units_for("rad", [joint_type]),
        "text": f"Error: {words}",
    }


def samples_to_draw(curves: tuple[np.ndarray, ...], most: int) -> np.ndarray:
    """Which of K samples keep the look of curves: the lowest and highest of each in every stretch, and both ends.

    Args:
        curves: Each (K,).
        most: About how many samples to keep.

    Returns:
        Sorted indices; all of them if there are at most ``most``.
    """
    count = len(curves[0])
    if count <= most:
        return np.arange(count)
    stretches = max(1, most // (2 * len(curves)))
    width = -(-count // stretches)
    grid = np.minimum(np.arange(-(-count // width) * width), count - 1).reshape(-1, width)
    rows = np.arange(len(grid))
    kept = [np.array([0, count - 1])]
    for each in curves:
        values = np.nan_to_num(each)[grid]
        kept += [grid[rows, values.argmin(axis=1)], grid[rows, values.argmax(axis=1)]]
    return np.unique(np.concatenate(kept))
