r"""Choosing a motion before any hardware moves: the one after which the parameters are known best.

>>> design = optimize_motion(make_problem, "chirp", sim2real, unoptimized, limits, x, control_dt=0.0025)
>>> design.trajectory, design.before.std, design.after.std
>>> print(*design_table(design), sep="\n")
"""

from .criterion import expected_uncertainty, mean_log_error
from .design import Design, DesignCfg, optimize_motion
from .information import Information
from .joint_motion import JointMotion, Room, command
from .table import design_table

__all__ = [
    "Design",
    "DesignCfg",
    "Information",
    "JointMotion",
    "Room",
    "command",
    "design_table",
    "expected_uncertainty",
    "mean_log_error",
    "optimize_motion",
]
