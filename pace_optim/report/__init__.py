"""A run as one page to look at, ``report.html``: run folder -> :class:`RunData` -> sections -> page."""

from .page import write_report

__all__ = ["write_report"]
