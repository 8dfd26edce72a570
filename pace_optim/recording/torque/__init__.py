"""What the torque in a recording says of the drive: its gains, feed-forward, limit and delay."""

from .drives import MeasuredDrives, read_drives
from .law import MeasuredLaw, read_law

__all__ = ["MeasuredDrives", "MeasuredLaw", "read_drives", "read_law"]
