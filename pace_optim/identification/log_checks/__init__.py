"""What is wrong with a log, named before anything is searched."""

from .checks import CHECKS, SIGHTS, Finding, check_log, checked

__all__ = ["CHECKS", "SIGHTS", "Finding", "check_log", "checked"]
