"""Managers: the parts of an environment, each made of named terms."""

from pace_envs.managers.action_manager import ActionManager, ActionTerm, ActionTermCfg
from pace_envs.managers.command_manager import CommandManager, CommandTerm, CommandTermCfg
from pace_envs.managers.curriculum_manager import CurriculumManager, CurriculumTermCfg
from pace_envs.managers.event_manager import EventManager, EventTermCfg
from pace_envs.managers.manager_base import ManagerTermBase, ManagerTermBaseCfg, SceneEntityCfg, Term, state_only
from pace_envs.managers.observation_manager import (
    ObservationGroupCfg,
    ObservationManager,
    ObservationTermCfg,
    UniformNoiseCfg,
)
from pace_envs.managers.reward_manager import RewardManager, RewardTermCfg
from pace_envs.managers.termination_manager import TerminationManager, TerminationTermCfg

__all__ = [
    "ActionManager",
    "ActionTerm",
    "ActionTermCfg",
    "CommandManager",
    "CommandTerm",
    "CommandTermCfg",
    "CurriculumManager",
    "CurriculumTermCfg",
    "EventManager",
    "EventTermCfg",
    "ManagerTermBase",
    "ManagerTermBaseCfg",
    "ObservationGroupCfg",
    "ObservationManager",
    "ObservationTermCfg",
    "RewardManager",
    "RewardTermCfg",
    "SceneEntityCfg",
    "Term",
    "TerminationManager",
    "TerminationTermCfg",
    "UniformNoiseCfg",
    "state_only",
]
