"""The page: its head, its sections one after another, style and script inside, nothing loaded from elsewhere."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from plotly.offline import get_plotlyjs

from pace_optim.terminal.atomic import write_atomically

from .markup import Section, esc
from .run_data import RunData
from .sections import SECTIONS

_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""Makes the browser refuse whatever is not in the page itself."""


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` of a run: one file that opens offline.

    Args:
        folder: The run's folder; ``result.json`` must be there, a section whose files are missing is left out.

    Returns:
        The file.

    Raises:
        ValueError: If there is no result.
    """
    folder = Path(folder)
    run = RunData.load(folder)
    text = render(run, [section for make in SECTIONS if (section := make(run)) is not None])
    path = folder / "report.html"
    write_atomically(path, lambda file: file.write(text.encode()))
    return path


def render(run: RunData, sections: list[Section]) -> str:
    """The page's HTML."""
    here = files(__package__)
    links = "".join(f'<a href="#{esc(s.id)}">{esc(s.title)}</a>' for s in sections)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{esc(run.result.robot_name)} · {esc(run.folder.resolve().name)}</title>
<link rel="icon" href="data:,">
<style>{here.joinpath("style.css").read_text("utf-8")}</style>
</head>
<body>
<nav>{links}</nav>
<main>
{"".join(_section(section, first=i == 0) for i, section in enumerate(sections))}
</main>
<footer>The numbers behind this page are in <code>result.json</code> beside it; positions in
<code>best_trajectory.pt</code>.</footer>
<script>{get_plotlyjs()}</script>
<script>{here.joinpath("script.js").read_text("utf-8")}</script>
</body>
</html>
"""


def _section(section: Section, *, first: bool) -> str:
    level = "h1" if first else "h2"
    lead = f'<p class="lead">{esc(section.lead)}</p>' if section.lead else ""
    heading = "" if first else f"<{level}>{esc(section.title)}</{level}>"
    return f'<section id="{esc(section.id)}">{heading}{lead}{section.html}</section>\n'
