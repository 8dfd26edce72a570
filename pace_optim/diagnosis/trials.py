"""What was tried on top of a model, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from pace_actuators.effects import Effect
from pace_optim.diagnosis.descent import Fitted

RIVAL = 1.10
"""Effects whose validation RMSE is within this factor of the best one's cannot be told apart from it."""
NEXT_FLOOR = 1.3
"""Nearer to the floor than this a further effect could not lower the error by as much as it must."""


@dataclass(kw_only=True, eq=False)
class Trial:
    """One effect, refitted on top of the present model, on one joint."""

    effect: type[Effect]
    joint: int
    screen_score: float
    mse_before: float
    """On validation [rad²]."""
    mse_after: float
    ratio: float
    """RMSE before / after."""
    t: float
    significant: bool
    values: dict[str, float]


@dataclass(kw_only=True, eq=False)
class Round:
    """What was tried on top of a model, joint by joint; each joint's list begins with its best."""

    trials: list[list[Trial]]
    chosen: list[type[Effect] | None]
    rivals: list[list[type[Effect]]]
    """For each joint, effects that do as well as the chosen one."""
    models: dict[type[Effect], Fitted] = field(default_factory=dict)
    """The present model with each effect that was refitted."""
