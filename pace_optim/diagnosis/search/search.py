"""Adding effects one after another, each joint by itself, as long as they pay on validation recordings."""

from __future__ import annotations

import torch

from pace_optim.diagnosis.search.grow import grown
from pace_optim.diagnosis.search.look_ahead import further_with_next_best
from pace_optim.diagnosis.search.state import Branch, Outcome, Search
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.diagnosis.selection.rules import decide
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.simulation.problem import TwinProblem


def add_effects(search: Search, problem: TwinProblem, base: Fitted) -> Outcome:
    """Look for the effects that are missing.

    Args:
        search: What is looked for, and with what.
        problem: The joints simulated alone.
        base: The base model, fitted, with its Jacobian.
    """
    cfg = search.cfg
    errors = search.fits.validation_errors(problem, [base])[0]
    branch = Branch(problem=problem, now=base, errors=errors)
    found = search.tried(branch)
    while found is not None and any(effect is not None for effect in found.chosen):
        branch, found = added(search, branch, found)
    branch = without_echoes(search, branch, errors)
    return Outcome(
        problem=branch.problem,
        base=base,
        base_errors=errors,
        final=branch.now,
        final_errors=branch.errors,
        trees=search.trees,
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


def without_echoes(search: Search, branch: Branch, base: BlockErrors) -> Branch:
    """The branch with an effect on one alone of joints that move each other, where that is as good along its motion.

    What one joint lacks moves the others too, which then seem to lack the same.

    Args:
        search: What is looked for.
        branch: Where the search ended.
        base: Errors of the base model.
    """
    for effect in (each for each in branch.now.model.effects if each not in search.own):
        has = branch.now.model.has[branch.now.model.effects.index(effect)]
        echoes = torch.zeros_like(has)
        for tree in map(list, search.trees):
            own = [j for j in tree if bool(has[j])]
            echoes[[j for j in own if j != max(own, key=lambda j: float(base.mse[j]))]] = True
        if effect.shared or not bool(echoes.any()) or not search.cfg.has("echo"):
            continue
        now = branch.now
        start = Fitted.start(now.model.without_effect(effect, echoes), now.physical, tried=effect)
        start = search.fits.side_by_side(branch.problem.in_windows(), [start], search.fits.cfg.again)[0]
        without = search.along_own_motion(branch, start)
        joints = [j for tree in search.trees for j in tree if bool(echoes[list(tree)].any())]
        after = {effect.name: without.errors}
        if len(decide("echo", joints, branch.errors, after, cfg=search.cfg, log=search.log)) == len(joints):
            branch = without
    return branch
