"""A branch with more effects, and what that changes of the older ones."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch

from pace_optim.diagnosis.search.carried_links import judged_over_trees
from pace_optim.diagnosis.search.replace_effect import replace_effects
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.joints.fits.fitted import Fitted


def grown(search: Search, branch: Branch, found: Round) -> Branch:
    """The branch with each joint's chosen effect, and what that changes of the older ones."""
    choosing = partial(_with_choice, search, branch)
    branch = judged_over_trees(search, choosing(found), choosing)
    return replace_effects(search, branch) if search.cfg.has("replace") else branch


def combined(search: Search, branch: Branch, found: Round) -> Fitted:
    """The present model with each joint's chosen effect, as it was fitted with it, and its derivatives there."""
    now = branch.now
    for effect in dict.fromkeys(e for e in found.chosen if e is not None):
        now = now.with_joints(torch.tensor([e is effect for e in found.chosen]), found.models[effect])
    return search.fits.looked_at(branch.problem, [now])[0] if now.jacobian is None else now


def _with_choice(search: Search, branch: Branch, found: Round) -> Branch:
    """The branch with each joint's chosen effect, along the motion that the robot then has."""
    now = combined(search, branch, found)
    return search.along_own_motion(replace(branch, rounds=(*branch.rounds, found)), now)
