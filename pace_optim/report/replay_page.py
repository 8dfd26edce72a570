"""The replay alone on a page."""

from __future__ import annotations

from pathlib import Path

from pace_actuators.files import write_atomically

from .page import render
from .run_data import RunData
from .sections.replay import replay


def write_replay(folder: str | Path, output: Path | None = None) -> Path:
    """Write ``replay.html`` of a run: one file that opens offline.

    Args:
        output: The file; ``None``: in the run's folder.

    Returns:
        The file.
    """
    folder = Path(folder)
    run = RunData.load(folder)
    run.model()
    section = replay(run)
    if section is None:
        raise ValueError(
            f"{folder / 'best_trajectory.pt'} does not exist: the fit that made {folder} has not ended. Resume it."
        )
    path = output or folder / "replay.html"
    write_atomically(path, lambda file: file.write(render(run, [section], figures=False).encode()))
    return path
