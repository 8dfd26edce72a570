"""The page: its head, its sections one after another, style and script inside, nothing loaded from elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from plotly.offline import get_plotlyjs

from pace_actuators.files import write_atomically

from .markup import ENVIRONMENT, Section, packed_script
from .run_data import RunData
from .sections import SECTIONS
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
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: file.write(render(run, [section], figures=False).encode()))
    return path


_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""Makes the browser refuse all that is not in the page itself."""


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` of a run: one file that opens offline.

    Args:
        folder: The run's folder; ``result.json`` must be there, a section whose files are missing is left out.

    Returns:
        The file.
    """
    path = Path(folder) / "report.html"
    text = report_text(folder)
    write_atomically(path, lambda file: file.write(text))
    return path


def report_text(folder: str | Path, new: Mapping[str, Any] | None = None) -> bytes:
    """The page's content.

    Args:
        new: Content of JSON files that are about to be written, by name, instead of the present one.
    """
    run = RunData.load(Path(folder), new)
    return render(run, make_sections(run)).encode()


def check_folder(folder: str | Path, *, anew: str = "") -> None:
    """Read all that the report of a run is made of, so that damage is reported before the work.

    Args:
        anew: The file that the work writes anew, which need not be sound.
    """
    make_sections(RunData.load(Path(folder), {anew: None}))


def make_sections(run: RunData) -> list[Section]:
    """All sections that the run's files are there for."""
    sections = []
    for make, name in SECTIONS.items():
        with run.blaming(name):
            section = make(run)
        if section is not None:
            sections.append(section)
    return sections


def render(run: RunData, sections: list[Section], *, figures: bool = True) -> str:
    """The page's HTML; without ``figures`` it is smaller, as it does not hold plotly."""
    here = files(__package__)
    texts = [here.joinpath("script.js").read_text("utf-8")] if figures else []
    texts.append(here.joinpath("motion", "viewer.js").read_text("utf-8"))
    return ENVIRONMENT.get_template("page.html").render(
        policy=_POLICY,
        robot=run.result.robot_name,
        folder=run.folder.resolve().name,
        style=here.joinpath("style.css").read_text("utf-8"),
        sections=sections,
        plotly=packed_script(get_plotlyjs(), "text/javascript") if figures else "",
        scripts=[here.joinpath("unpack.js").read_text("utf-8"), *texts],
    )
