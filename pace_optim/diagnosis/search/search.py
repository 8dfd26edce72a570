"""Adding effects one after another, each joint by itself, as long as they pay on validation recordings."""

from __future__ import annotations

from pace_optim.diagnosis.search.grow import grown
from pace_optim.diagnosis.search.look_ahead import further_with_next_best
from pace_optim.diagnosis.search.state import Branch, Outcome, Search
from pace_optim.diagnosis.selection.candidate_results import Round
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
    unexplained = (branch.errors.mse - search.floor**2).clamp(min=0.0)
    rounds = [*branch.rounds, *([] if found is None else [found])]
    return Outcome(
        problem=branch.problem,
        base=base,
        base_errors=errors,
        final=branch.now,
        final_errors=branch.errors,
        trees=search.trees,
        rounds=[each.with_doubtful(unexplained) for each in rounds],
        cfg=cfg,
    )


def added(search: Search, branch: Branch, found: Round) -> tuple[Branch, Round | None]:
    """The branch with each joint's best effect, or the next best where that leads further; and what could come next."""
    end = grown(search, branch, found)
    ahead = search.tried(end)
    if branch.rounds or ahead is None or not search.cfg.has("look_ahead"):
        return end, ahead
    return further_with_next_best(search, branch, found, end, ahead) or (end, ahead)
