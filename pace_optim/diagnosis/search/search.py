"""Adding effects one after another, each joint by itself, as long as they pay on validation recordings."""

from __future__ import annotations

from collections.abc import Callable

import torch

from pace_optim.diagnosis.judging.candidate_results import Round
from pace_optim.diagnosis.judging.size_consistency import unevenness
from pace_optim.diagnosis.search.moves import MOVES, Step
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
    while found is not None and (step := _first_step(search, branch, found)) is not None:
        branch, found = step
    return Outcome(
        problem=branch.problem,
        base=base,
        base_errors=errors,
        final=branch.now,
        final_errors=branch.errors,
        unevenness=size_consistency(branch.now),
        rounds=[*branch.rounds, *([] if found is None else [found])],
        cfg=cfg,
    )


def _first_step(search: Search, branch: Branch, found: Round) -> Step | None:
    """The first move that leads somewhere."""
    for name, move in MOVES.items():
        if search.cfg.has(name) and (step := move(search, branch, found)) is not None:
            return step
    return None
