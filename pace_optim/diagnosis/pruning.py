"""Dropping what a newer effect makes superfluous."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.acceptance import BlockErrors
from pace_optim.diagnosis.descent import Fitted, fit_side_by_side
from pace_optim.diagnosis.some_joints import SomeJoints
from pace_optim.diagnosis.validation import validation_errors
from pace_optim.joint_twins.problem import TwinProblem

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
    model, n = now.model, now.model.num_joints
    latest = torch.tensor([e is not None for e in newest])
    older = []
    for effect, has in zip(model.effects, model.has, strict=True):
        joints = has & latest & torch.tensor([e is not effect for e in newest])
        if bool(joints.any()):
            older.append((effect, joints))
    if not older:
        return now, errors
    starts = [Fitted.start(model.without_effect(e, joints), model.to_physical(now.x), tried=e) for e, joints in older]
    which = torch.stack([joints for _, joints in older]).any(dim=0)
    fitted, after = SomeJoints(which).refitted(problem, starts, errors)
    dropped, x = model, now.x.clone()
    for j in range(n):
        without = [k for k, (_, joints) in enumerate(older) if bool(joints[j])]
        if not without:
            continue
        best = min(without, key=lambda k: float(after[k].mse[j]))
        if float(after[best].mse[j]) <= SUPERFLUOUS**2 * float(errors.mse[j]):
            dropped = dropped.without_effect(older[best][0], torch.arange(n) == j)
            x[j] = fitted[best].x[j]
    if dropped is model:
        return now, errors
    left = Fitted.start(dropped, dropped.to_physical(x))
    now = fit_side_by_side(problem, [left], max_iteration=4, keep_jacobian=True)[0]
    return now, validation_errors(problem, [now])[0]
