"""An independent plant: recordings of a robot with hidden physical effects, to judge the identification honestly.

It shares no code with `pace_actuators`: other integration, other friction, its own controller and effects.

>>> files = write_case(Case(effects=("stribeck_friction",), seed=3), "logs/cases/stribeck_3")
>>> files.train, files.validation, files.truth
"""

from .case import Case, CaseFiles, make_case, write_case, write_truth
from .draw import Drawn, draw_base, draw_effect, draw_visible, joints_of, motion_change, with_background
from .hidden import EFFECTS, effect_named, library_effects, outside_effects
from .robot import PlantRobot, plant_robot
from .simulate import Motion, simulate_motions, simulate_runs, simulate_truths
from .suite import BENCH_LOAD, Suite, make_suite, session_of
from .truth import BaseTruth, PlantCfg, Run, Truth

__all__ = [
    "BENCH_LOAD",
    "EFFECTS",
    "BaseTruth",
    "Case",
    "CaseFiles",
    "Drawn",
    "Motion",
    "PlantCfg",
    "PlantRobot",
    "Run",
    "Suite",
    "Truth",
    "draw_base",
    "draw_effect",
    "draw_visible",
    "effect_named",
    "joints_of",
    "library_effects",
    "make_case",
    "make_suite",
    "motion_change",
    "outside_effects",
    "plant_robot",
    "session_of",
    "simulate_motions",
    "simulate_runs",
    "simulate_truths",
    "with_background",
    "write_case",
    "write_truth",
]
