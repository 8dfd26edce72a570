"""What the torque in a recording says of the drive: its gains, feed-forward, limit and delay; and its noise."""

from .drives import MeasuredDrives, NoTorqueError, TorqueChannel, read_drives, torque_channel
from .law import MeasuredLaw, read_law

__all__ = [
    "MeasuredDrives",
    "MeasuredLaw",
    "NoTorqueError",
    "TorqueChannel",
    "read_drives",
    "read_law",
    "torque_channel",
]
