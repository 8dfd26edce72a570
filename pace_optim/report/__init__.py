"""A run as one page to look at, ``report.html``: run folder -> :class:`RunData` -> sections -> page."""

from .page import check_folder, report_text, write_report

__all__ = ["check_folder", "report_text", "write_report"]
