"""A run as one page to look at: ``report.html``."""

from pathlib import Path


def write_report(folder: Path) -> Path:
    """Write ``report.html`` of a run's folder."""
    return folder / "report.html"
