"""Adding effects one after another, each joint by itself, as long as they pay on validation recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from pace_optim.diagnosis.judging.candidate_results import Round
from pace_optim.diagnosis.judging.size_consistency import unevenness
from pace_optim.diagnosis.search.grow import grown
from pace_optim.diagnosis.search.look_ahead import further_with_next_best
from pace_optim.diagnosis.search.state import Branch, Outcome, Search
from pace_optim.single_joint_fits.fitted import Fitted
from pace_optim.single_joint_model.problem import TwinProblem


def add_effects(
    search: Search,
    problem: TwinProblem,
    base: Fitted,
    size_consistency: Callable[[Fitted], torch.Tensor] = unevenness,
) -> Outcome:
    """Look for the effects that are missing.

    Args:
        search: What is looked for, and with what.
        problem: The joints simulated alone.
        base: The base model, fitted, with its Jacobian.
        size_consistency: Tells how much the sizes of a model's effects differ between recordings.
    """
    cfg = search.cfg
    errors = search.fits.validation_errors(problem, [base])[0]
    branch = Branch(problem=problem, now=base, errors=errors)
    found = search.tried(branch)
    while found is not None and any(effect is not None for effect in found.chosen):
        branch, found = added(search, branch, found)
    final = _without_vanished(branch.now)
    return Outcome(
        problem=branch.problem,
        base=base,
        base_errors=errors,
        final=final,
        final_errors=branch.errors,
        unevenness=size_consistency(final),
        rounds=[*branch.rounds, *([] if found is None else [found])],
        cfg=cfg,
    )


def added(search: Search, branch: Branch, found: Round) -> tuple[Branch, Round | None]:
    """The branch with each joint's best effect, or the next best where that leads further; and what could come next."""
    end = grown(search, branch, found)
    ahead = search.tried(end)
    if branch.rounds or ahead is None or not search.cfg.has("look_ahead"):
        return end, ahead
    return further_with_next_best(search, branch, found, end, ahead) or (end, ahead)


def _without_vanished(now: Fitted) -> Fitted:
    """The model without effects that have ended where they vanish: what paid there is another end of the base model."""
    left = now.model.has & ~now.model.vanished(now.x)
    return replace(now, model=replace(now.model, has=left)) if bool(left.any()) else now
