"""PACE on MuJoCo: identify drives from recordings, and find the missing effect."""

from typing import TYPE_CHECKING

from pace_actuators.public_names import public_names

if TYPE_CHECKING:
    from pace_optim.comparison import compare, comparison_lines
    from pace_optim.data_collection import CollectionCfg, collect
    from pace_optim.diagnosis import Diagnosis, DiagnosisSettings, diagnose
    from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
    from pace_optim.estimate.convergence import (
        Criterion,
        EarlyStopping,
        MovingWindow,
        ParameterSpread,
        Plateau,
        ScoreGradient,
        ScoreSpread,
        SearchState,
        TargetScore,
    )
    from pace_optim.estimate.least_squares import LeastSquaresCfg, least_squares
    from pace_optim.estimate.search import search
    from pace_optim.identification.fit import fit, resume
    from pace_optim.motion.signals import Motion, Trajectory, make_excitation, register_excitation
    from pace_optim.problem.evaluator import Evaluator
    from pace_optim.problem.parameter_space import ParameterSpace
    from pace_optim.problem.problem import Problem, load_problem
    from pace_optim.problem.rollout import Rollout
    from pace_optim.recording import Recording, load_recording, save_recording
    from pace_optim.run.open import open_problem
    from pace_optim.run.result import FitResult
    from pace_optim.run.settings import FitSettings
    from pace_optim.run.summary import summary

__all__ = [
    "CMAESOptimizer",
    "CMAESOptimizerCfg",
    "CollectionCfg",
    "Criterion",
    "Diagnosis",
    "DiagnosisSettings",
    "EarlyStopping",
    "Evaluator",
    "FitResult",
    "FitSettings",
    "LeastSquaresCfg",
    "Motion",
    "MovingWindow",
    "ParameterSpace",
    "ParameterSpread",
    "Plateau",
    "Problem",
    "Recording",
    "Rollout",
    "ScoreGradient",
    "ScoreSpread",
    "SearchState",
    "TargetScore",
    "Trajectory",
    "collect",
    "compare",
    "comparison_lines",
    "diagnose",
    "fit",
    "least_squares",
    "load_problem",
    "load_recording",
    "make_excitation",
    "open_problem",
    "register_excitation",
    "resume",
    "save_recording",
    "search",
    "summary",
]

__getattr__ = public_names(__file__)
