"""What is wrong with a log, named before anything is searched."""

from .checks import CHECKS, SIGHTS, Finding, check_log

__all__ = ["CHECKS", "SIGHTS", "Finding", "check_log"]
