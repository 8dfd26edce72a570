"""Logs of other programs as recordings: rosbag2, ROS 1 bags, LeRobot datasets, parquet, and CSV with any names.

>>> LogReader(["leg_mcap"]).recordings("leg_mcap", Robot(joint_names=("hip", "knee")))
"""

from .column_map import ColumnMap, read_map, with_rate, write_map
from .load import LogReader, Robot, column_names, is_log, paired_files, set_aside

__all__ = [
    "ColumnMap",
    "LogReader",
    "Robot",
    "column_names",
    "is_log",
    "paired_files",
    "read_map",
    "set_aside",
    "with_rate",
    "write_map",
]
