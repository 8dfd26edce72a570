"""A branch with more effects, and what that changes of the older ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch

from pace_optim.diagnosis.judging.candidate_results import Round
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.search.pruning import drop_superfluous
from pace_optim.diagnosis.search.replace_effect import exchanged, replace_effects
from pace_optim.diagnosis.search.state import Branch, Search

REVISIONS: Mapping[str, Callable[[Search, Branch], Branch]] = {"replace": replace_effects, "drop": drop_superfluous}
"""What is tried on older effects when newer ones have joined them, in this order."""


def grown(search: Search, branch: Branch, found: Round) -> Branch:
    """The branch with each joint's chosen effect, and what that changes of the older ones."""
    now = combined(search, branch, found)
    branch = search.along_own_motion(replace(branch, rounds=(*branch.rounds, found)), now)
    for name, revise in REVISIONS.items():
        if search.cfg.has(name):
            branch = revise(search, branch)
    return branch


def combined(search: Search, branch: Branch, found: Round) -> Fitted:
    """The present model with each joint's chosen effect, as it was fitted with it, and its derivatives there."""
    one = found.models[found.chosen[0]] if len(set(found.chosen)) == 1 and found.chosen[0] is not None else None
    if one is not None and one.jacobian is not None:
        return replace(one, tried=None)
    model, physical, size = branch.now.model, branch.now.physical, branch.now.model.size
    for effect in dict.fromkeys(e for e in found.chosen if e is not None):
        has = torch.tensor([e is effect for e in found.chosen])
        model, physical = exchanged(model, physical, has, [], found.models[effect], effect, size)
    return search.fits.looked_at(branch.problem, [Fitted.start(model, physical)])[0]
