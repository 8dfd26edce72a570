"""What was tried on top of a model, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, JudgingCfg
from pace_optim.diagnosis.selection.comparison import judge, within
from pace_optim.estimate.error_bars.loop_rate import UNEXPLAINED
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fitted import Fitted


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One effect, refitted on top of the present model, on one joint."""

    effect: type[Effect]
    joint: int
    screen_score: float
    values: dict[str, float]
    implausible: bool = False
    """Whether its size is one that no drive has."""
    mse_before: float = 0.0
    """On validation [rad²]."""
    mse_after: float = 0.0
    ratio: float = 1.0
    """RMSE before / after."""
    t: float = 0.0
    significant: bool = False

    def judged(
        self, before: BlockErrors, after: BlockErrors, tried: int, first: bool, *, cfg: JudgingCfg = DEFAULT.judging
    ) -> Trial:
        """The trial with what the effect has brought its joint; arguments as for :func:`judge`."""
        verdict = judge(before, after, self.joint, tried, first, cfg=cfg)
        return replace(
            self,
            mse_before=float(before.mse[self.joint]),
            mse_after=float(after.mse[self.joint]),
            ratio=verdict.ratio,
            t=verdict.t,
            significant=verdict.significant,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Round:
    """What was tried on top of a model, joint by joint; each joint's list begins with its best."""

    trials: Sequence[Sequence[Trial]]
    chosen: Sequence[type[Effect] | None]
    rivals: Sequence[Sequence[type[Effect]]]
    """For each joint, effects that do as well as the chosen one."""
    models: Mapping[type[Effect], Fitted] = field(default_factory=dict)
    """The present model with each effect that was refitted."""

    def choosing(self, chosen: Sequence[type[Effect] | None]) -> Round:
        """The same with other choices: where joints chose a rival, what they had is a rival in turn."""
        result = self
        for j, (old, new) in enumerate(zip(self.chosen, chosen, strict=True)):
            if new is not old:
                result = result.exchanged(j, new, tie=new in self.rivals[j])
        return result

    def exchanged(self, joint: int, new: type[Effect] | None, tie: bool) -> Round:
        """The same with another effect on a joint; with ``tie`` what it had becomes its rival."""
        old, others = self.chosen[joint], [effect for effect in self.rivals[joint] if effect is not new]
        chosen, every = list(self.chosen), list(self.rivals)
        chosen[joint], every[joint] = new, others if old is None or not tie else [*others, old]
        return replace(self, chosen=chosen, rivals=every)

    def with_doubtful(self, unexplained: torch.Tensor) -> Round:
        """The same with all effects as rivals that lose to the chosen one by less than what no model explains may do.

        An effect that left less, and lost by another rule, stays none.

        Args:
            unexplained: Of each joint, squared error of the final model above the floor, (n,) [rad²].
        """
        every = list(self.rivals)
        for j, (chosen, trials) in enumerate(zip(self.chosen, self.trials, strict=True)):
            least = next((t.mse_after for t in trials if t.effect is chosen), None)
            if least is not None:
                most = least + UNEXPLAINED * float(unexplained[j])
                lost = (t for t in trials if t.significant and not t.implausible and least < t.mse_after <= most)
                near = [t.effect for t in lost]
                every[j] = [*every[j], *(effect for effect in near if effect not in every[j])]
        return replace(self, rivals=every)

    def among_all(self, joints: torch.Tensor, now: Fitted) -> Round:
        """A round of some joints, (n,) bool, as one of all, whose model is known: nothing was tried on the others."""
        n, places = len(joints), joints.nonzero()[:, 0].tolist()
        trials: list[Sequence[Trial]] = [()] * n
        chosen: list[type[Effect] | None] = [None] * n
        rivals: list[Sequence[type[Effect]]] = [()] * n
        for j, own, choice, others in zip(places, self.trials, self.chosen, self.rivals, strict=True):
            trials[j], chosen[j], rivals[j] = [replace(trial, joint=j) for trial in own], choice, others
        models = {e: replace(now.with_joints(joints, own), tried=e) for e, own in self.models.items()}
        return Round(trials=trials, chosen=chosen, rivals=rivals, models=models)


def near_trials(trials: Sequence[Trial], chosen: type[Effect], *, cfg: JudgingCfg = DEFAULT.judging) -> list[Trial]:
    """Trials of a joint that came near to the chosen effect, best first."""
    best = next(t.mse_after for t in trials if t.effect is chosen)
    return [t for t in trials if t.effect is not chosen and within(t.mse_after, best, cfg.far)]
