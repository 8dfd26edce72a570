"""What was fitted, and what was noticed when it was read."""

from __future__ import annotations

import numpy as np

from ..markup import Section, bullets, esc, table
from ..run_data import RecordingData, RunData


def recordings(run: RunData) -> Section:
    """A row per recording, its notes underneath."""
    rows, notes = [], list(run.result.notes)
    for recording in run.recordings:
        own = [note for note in notes if note.startswith(f"{recording.name}: ")]
        notes = [note for note in notes if note not in own]
        said = bullets([note.removeprefix(f"{recording.name}: ") for note in own], "notes") if own else ""
        rows.append([f"<b>{esc(recording.name)}</b>", *_facts(recording), said])
    head = ["recording", "used for", "length", "samples", "rate", "notes"]
    html = table(head, rows, "recordings") if rows else ""
    if not rows:
        for use, names in run.result.recordings.items():
            html += f"<p>{esc(use.capitalize())}: {esc(', '.join(names) or 'nothing')}</p>"
    return Section(id="recordings", title="Recordings", html=html + (bullets(notes, "notes") if notes else ""))


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
        esc(use.replace("%", " %")),
        f"{recording.time[-1] - recording.time[0]:.4g} s",
        f"{len(recording.time)}",
        f"{1 / step:.4g} Hz" if step > 0 else "–",
    ]
