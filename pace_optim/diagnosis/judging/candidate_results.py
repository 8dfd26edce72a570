"""What was tried on top of a model, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from pace_actuators.effects import Effect
from pace_optim.diagnosis.judging.acceptance import BlockErrors, judge
from pace_optim.diagnosis.model.fitted import Fitted

RIVAL = 1.10
"""Effects whose validation RMSE is within this factor of the best one's cannot be told apart from it."""
ALIKE = 1.02
"""Of effects whose validation RMSE is within this factor of the best, the one with the fewest numbers is taken."""
FAR = 3.0
"""A joint is far from the floor above this many times it."""
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
    values: dict[str, float]
    mse_before: float = 0.0
    """On validation [rad²]."""
    mse_after: float = 0.0
    ratio: float = 1.0
    """RMSE before / after."""
    t: float = 0.0
    significant: bool = False
    likely: bool = False

    def judged(self, before: BlockErrors, after: BlockErrors, tried: int, first: bool) -> Trial:
        """The trial with what the effect has brought its joint; arguments as for :func:`judge`."""
        verdict = judge(before, after, self.joint, tried, first)
        return replace(
            self,
            mse_before=float(before.mse[self.joint]),
            mse_after=float(after.mse[self.joint]),
            ratio=verdict.ratio,
            t=verdict.t,
            significant=verdict.significant,
            likely=verdict.likely,
        )


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

    def choosing(self, chosen: Sequence[type[Effect] | None]) -> Round:
        """The same with other choices: where joints chose a rival, what they had is a rival in turn."""
        result = self.copy()
        for j, (old, new) in enumerate(zip(self.chosen, chosen, strict=True)):
            if new is not old:
                result.exchange(j, new, tie=new in self.rivals[j])
        return result

    def exchange(self, joint: int, new: type[Effect] | None, tie: bool) -> None:
        """Choose another effect on a joint; with ``tie`` what it had becomes its rival."""
        old, others = self.chosen[joint], [effect for effect in self.rivals[joint] if effect is not new]
        self.chosen[joint] = new
        self.rivals[joint] = others if old is None or not tie else [*others, old]

    def with_trials(self, judged: Mapping[int, Trial]) -> Round:
        """The same with a joint's trial of an effect in place of what it was, best first."""
        trials = [list(each) for each in self.trials]
        for j, trial in judged.items():
            others = [t for t in trials[j] if t.effect is not trial.effect]
            trials[j] = sorted([trial, *others], key=lambda t: t.mse_after)
        return replace(self, trials=trials)


def near_trials(trials: Sequence[Trial], chosen: type[Effect]) -> list[Trial]:
    """Trials of a joint that came near to the chosen effect, best first."""
    most = next(t.mse_after for t in trials if t.effect is chosen) * _BEHIND**2
    return [t for t in trials if t.effect is not chosen and t.mse_after <= most]
