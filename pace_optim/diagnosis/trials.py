"""What was tried on top of a model, and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from pace_actuators.effects import Effect
from pace_optim.diagnosis.descent import Fitted

RIVAL = 1.10
"""Effects whose validation RMSE is within this factor of the best one's cannot be told apart from it."""
NEXT_FLOOR = 1.3
"""Nearer to the floor than this a further effect could not lower the error by as much as it must."""
_BEHIND = 3.0
"""An effect whose RMSE was this many times the chosen one's does not come near to it."""


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

    def copy(self) -> Round:
        """The same, whose choices can change by themselves."""
        return replace(self, chosen=list(self.chosen), rivals=[list(each) for each in self.rivals])


def near_trials(trials: Sequence[Trial], chosen: type[Effect]) -> list[Trial]:
    """Significant trials of a joint that came near to the chosen effect, best first."""
    most = next(t.mse_after for t in trials if t.effect is chosen) * _BEHIND**2
    return [t for t in trials if t.effect is not chosen and t.significant and t.mse_after <= most]
