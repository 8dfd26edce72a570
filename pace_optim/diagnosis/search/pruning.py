"""Dropping effects that the others make superfluous."""

from __future__ import annotations

from dataclasses import replace

import torch

from pace_optim.diagnosis.search.alternatives import Alternatives
from pace_optim.diagnosis.search.state import Branch, Search


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
        start, iterations = left.with_taken(dropped), search.fits.cfg.again
        now = search.fits.side_by_side(branch.problem, [start], iterations, keep_jacobian=True)[0]
        branch = replace(branch, now=now, errors=search.fits.validation_errors(branch.problem, [now])[0])
        open_joints = torch.tensor([j in dropped for j in range(model.num_joints)])
