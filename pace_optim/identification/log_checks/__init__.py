"""What is wrong with a log, named before anything is searched."""

from .checks import Finding, check_log, checked

__all__ = ["Finding", "check_log", "checked"]
