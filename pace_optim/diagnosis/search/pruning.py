"""Dropping effects that the others make superfluous."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.search.alternatives import Alternatives
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
    if any(bool(has.any()) for has in older.values()):
        search.say("trying to do without what was found earlier")
    left = Alternatives.without(search, branch, older)
    return _dropped(search, left, left.taken(search, "drop"))


def drop_last(search: Search, branch: Branch) -> Branch:
    """Drop, one after another, effects that would not be added to the others of their joint now.

    When they were found, others were missing, and neighbours moved wrongly.
    """
    begun = branch
    open_joints = torch.ones(branch.now.model.num_joints, dtype=torch.bool)
    while True:
        model = branch.now.model
        several = open_joints & (model.has.sum(dim=0) > 1)
        own = zip(model.effects, model.has, strict=True)
        left = Alternatives.without(search, branch, {e: has & several for e, has in own if not e.shared})
        dropped = left.taken(search, "drop_last")
        if not dropped:
            return branch if branch is begun else search.along_own_motion(branch, branch.now)
        branch = _dropped(search, left, dropped)
        open_joints = torch.tensor([j in dropped for j in range(model.num_joints)])


def _dropped(search: Search, left: Alternatives, dropped: Mapping[int, type[Effect]]) -> Branch:
    """The branch without an effect on some joints, fitted along the same motion."""
    branch = left.branch
    if not dropped:
        return branch
    start, iterations = left.with_taken(dropped), search.cfg.fitting.again
    now = search.fits.side_by_side(branch.problem, [start], iterations, keep_jacobian=True)[0]
    return replace(branch, now=now, errors=search.fits.validation_errors(branch.problem, [now])[0])
