r"""Choosing a motion before any hardware moves: the one after which the parameters are known best.

>>> design = optimize_motion(make_problem, "chirp", sim2real, unoptimized, limits, x, control_dt=0.0025)
>>> design.trajectory, design.before.std, design.after.std
>>> print(*design_table(design), sep="\n")
"""

from .design import Design, DesignCfg, design_table, optimize_motion
from .information import Information, expected_uncertainty, mean_log_error
from .joint_motion import JointMotion, Room, command

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
