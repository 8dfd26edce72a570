"""Dropping effects that the others make superfluous."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.fitting.validation import BlockErrors
from pace_optim.diagnosis.judging.comparison import judge, within
from pace_optim.diagnosis.judging.decisions import decision
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.search.state import Branch, Search


def drop_superfluous(search: Search, branch: Branch) -> Branch:
    """Drop what the newest effects made superfluous: an older effect without which a joint's error is as good.

    Each joint's newest effect stays.
    """
    model, newest = branch.now.model, branch.rounds[-1].chosen
    latest = torch.tensor([e is not None for e in newest])
    older = {
        effect: has & latest & torch.tensor([e is not effect for e in newest])
        for effect, has in zip(model.effects, model.has, strict=True)
    }
    left = LeftOut.of(search, branch, older)
    if left.tried:
        search.say("trying to do without what was found earlier")
    dropped = {}
    for j, effects in left.tried.items():
        best = min(effects, key=lambda effect: left.mse(effect, j))
        if within(left.mse(best, j), float(branch.errors.mse[j]), search.cfg.judging.as_good):
            dropped[j] = best
    _tell(search, branch, "drop", left, dropped)
    return _without(search, branch, left, dropped)


def drop_last(search: Search, branch: Branch) -> Branch:
    """Drop, one after another, effects that would not be added to the others of their joint now.

    When they were found, others were missing, and neighbours moved wrongly.
    """
    begun = branch
    open_joints = torch.ones(branch.now.model.num_joints, dtype=torch.bool)
    while True:
        model, tried = branch.now.model, search.tried_over_joints
        several = open_joints & (model.has.sum(dim=0) > 1)
        own = zip(model.effects, model.has, strict=True)
        left = LeftOut.of(search, branch, {e: has & several for e, has in own if not e.shared})
        dropped = {}
        for j, effects in left.tried.items():
            least = min(effects, key=lambda effect: left.mse(effect, j))
            pays = judge(left.errors[least], branch.errors, j, tried, first=False, cfg=search.cfg.judging)
            if not pays.significant:
                dropped[j] = least
        _tell(search, branch, "drop_last", left, dropped)
        if not dropped:
            return branch if branch is begun else search.along_own_motion(branch, branch.now)
        branch = _without(search, branch, left, dropped)
        open_joints = torch.tensor([j in dropped for j in range(model.num_joints)])


@dataclass(frozen=True, kw_only=True, eq=False)
class LeftOut:
    """A model without each of its effects in turn, the rest refitted."""

    tried: Mapping[int, list[type[Effect]]] = field(default_factory=dict)
    """Joint -> effects left out of it."""
    fitted: Mapping[type[Effect], Fitted] = field(default_factory=dict)
    """Effect -> the model without it."""
    errors: Mapping[type[Effect], BlockErrors] = field(default_factory=dict)
    """Effect -> errors without it."""

    @classmethod
    def of(cls, search: Search, branch: Branch, effects: Mapping[type[Effect], torch.Tensor]) -> LeftOut:
        """Refit a branch's model without each of some effects; where each is left out, (n,) bool."""
        effects = {effect: joints for effect, joints in effects.items() if bool(joints.any())}
        if not effects:
            return cls()
        now = branch.now
        tried: dict[int, list[type[Effect]]] = {}
        for effect, joints in effects.items():
            for j in joints.nonzero()[:, 0].tolist():
                tried.setdefault(j, []).append(effect)
        starts = [
            Fitted.start(now.model.without_effect(effect, joints), now.physical, tried=effect)
            for effect, joints in effects.items()
        ]
        which = torch.stack(list(effects.values())).any(dim=0)
        fitted, after = search.fits.on_joints(branch.problem, starts, which, branch.errors)
        return cls(
            tried=tried, fitted=dict(zip(effects, fitted, strict=True)), errors=dict(zip(effects, after, strict=True))
        )

    def mse(self, effect: type[Effect], joint: int) -> float:
        """Of a joint without an effect [rad²]."""
        return float(self.errors[effect].mse[joint])


def _without(search: Search, branch: Branch, left: LeftOut, dropped: Mapping[int, type[Effect]]) -> Branch:
    """The branch without an effect on some joints, fitted along the same motion."""
    if not dropped:
        return branch
    now = branch.now
    for j, effect in dropped.items():
        now = now.with_joints(torch.arange(len(now.x)) == j, left.fitted[effect])
    now = search.fits.side_by_side(branch.problem, [now], search.cfg.fitting.settle, keep_jacobian=True)[0]
    return replace(branch, now=now, errors=search.fits.validation_errors(branch.problem, [now])[0])


def _tell(search: Search, branch: Branch, rule: str, left: LeftOut, dropped: Mapping[int, type[Effect]]) -> None:
    if left.tried:
        after = {effect.name: errors for effect, errors in left.errors.items()}
        on = {effect.name: [j for j, own in left.tried.items() if effect in own] for effect in left.errors}
        names = {j: effect.name for j, effect in dropped.items()}
        search.log(
            decision(rule, list(left.tried), branch.errors, after, names, on, candidates=search.tried_over_joints)
        )
