"""Recordings of real (or simulated) joints: reading, checking, and bringing them onto the simulation's grid.

>>> recording = load_recording("leg.csv")
>>> recording = conform_recording(recording, joint_order=("hip", "knee"), control_dt=0.0025)
>>> recording.dof_pos, recording.command, recording.notes
"""

from .conform import conform_recording, with_columns
from .data import Drive, ImuPose, Load, Recording, validation_start
from .files import SUFFIXES, load_recording, save_recording, without_fact_files, written_files

__all__ = [
    "SUFFIXES",
    "Drive",
    "ImuPose",
    "Load",
    "Recording",
    "conform_recording",
    "load_recording",
    "save_recording",
    "validation_start",
    "with_columns",
    "without_fact_files",
    "written_files",
]
