"""Dropping effects that the others make superfluous."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.fitting.coarse_to_fine import fit_side_by_side
from pace_optim.diagnosis.judging.acceptance import BlockErrors, judge
from pace_optim.diagnosis.judging.some_joints import SomeJoints
from pace_optim.diagnosis.judging.validation import validation_errors
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.single_joint_model.problem import TwinProblem

SUPERFLUOUS = 1.05
"""An older effect is dropped where the validation RMSE without it is no larger than this multiple."""


def pruned(
    problem: TwinProblem, now: Fitted, errors: BlockErrors, newest: Sequence[type[Effect] | None]
) -> tuple[Fitted, BlockErrors]:
    """Drop what the newest effects made superfluous: an older effect without which a joint's error is no larger.

    Args:
        problem: The joints simulated alone.
        now: The present model.
        errors: Its errors.
        newest: Each joint's newest effect, which stays.
    """
    latest = torch.tensor([e is not None for e in newest])
    older = {
        effect: has & latest & torch.tensor([e is not effect for e in newest])
        for effect, has in zip(now.model.effects, now.model.has, strict=True)
    }
    without = Without(problem, now, errors, older)
    dropped = {}
    for j, effects in without.tried.items():
        best = min(effects, key=lambda effect: without.mse(effect, j))
        if without.mse(best, j) <= SUPERFLUOUS**2 * float(errors.mse[j]):
            dropped[j] = best
    return without.dropping(dropped)


def pruned_at_last(problem: TwinProblem, now: Fitted, errors: BlockErrors, tried: int) -> tuple[Fitted, BlockErrors]:
    """Drop, one after another, effects that would not be added to the others of their joint now.

    When they were found, others were missing, and neighbours moved wrongly.

    Args:
        problem: The joints simulated alone.
        now: The model at the end of the search.
        errors: Its errors.
        tried: How many candidates were tried, over all joints.
    """
    open_joints = torch.ones(now.model.num_joints, dtype=torch.bool)
    while True:
        several = open_joints & (now.model.has.sum(dim=0) > 1)
        own = zip(now.model.effects, now.model.has, strict=True)
        without = Without(problem, now, errors, {e: has & several for e, has in own if not e.shared})
        dropped = {}
        for j, effects in without.tried.items():
            least = min(effects, key=lambda effect: without.mse(effect, j))
            if not judge(without.errors[least], errors, j, tried, first=False).significant:
                dropped[j] = least
        if not dropped:
            return now, errors
        now, errors = without.dropping(dropped)
        open_joints = torch.tensor([j in dropped for j in range(now.model.num_joints)])


class Without:
    """A model without each of its effects in turn, the rest refitted."""

    def __init__(
        self, problem: TwinProblem, now: Fitted, errors: BlockErrors, effects: Mapping[type[Effect], torch.Tensor]
    ):
        """Refit.

        Args:
            problem: The joints simulated alone.
            now: The model.
            errors: Its errors.
            effects: What is left out, and of which joints, (n,) bool.
        """
        self._problem, self._now, self._now_errors = problem, now, errors
        model, physical = now.model, now.model.to_physical(now.x)
        effects = {effect: joints for effect, joints in effects.items() if bool(joints.any())}
        self.tried: dict[int, list[type[Effect]]] = {}
        """Joint -> effects left out of it."""
        for effect, joints in effects.items():
            for j in joints.nonzero()[:, 0].tolist():
                self.tried.setdefault(j, []).append(effect)
        self.errors: dict[type[Effect], BlockErrors] = {}
        """Effect -> errors without it."""
        self._fitted: dict[type[Effect], Fitted] = {}
        if effects:
            starts = [Fitted.start(model.without_effect(e, joints), physical, tried=e) for e, joints in effects.items()]
            part = SomeJoints(torch.stack(list(effects.values())).any(dim=0))
            fitted, after = part.refitted(problem, starts, errors)
            self.errors = dict(zip(effects, after, strict=True))
            self._fitted = dict(zip(effects, fitted, strict=True))

    def mse(self, effect: type[Effect], joint: int) -> float:
        """Of a joint without an effect [rad²]."""
        return float(self.errors[effect].mse[joint])

    def dropping(self, effects: Mapping[int, type[Effect]]) -> tuple[Fitted, BlockErrors]:
        """The model without an effect on some joints, {joint: effect}, fitted, and its errors."""
        if not effects:
            return self._now, self._now_errors
        model, x = self._now.model, self._now.x.clone()
        for j, effect in effects.items():
            model = model.without_effect(effect, torch.arange(model.num_joints) == j)
            x[j] = self._fitted[effect].x[j]
        left = Fitted.start(model, model.to_physical(x))
        now = fit_side_by_side(self._problem, [left], max_iteration=4, keep_jacobian=True)[0]
        return now, validation_errors(self._problem, [now])[0]
