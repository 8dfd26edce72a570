"""The best effect of the first round may stand in for two others: the next best leads on for a round, too."""

from __future__ import annotations

from typing import Any

import torch

from pace_optim.diagnosis.diagnosis_cfg import JudgingCfg
from pace_optim.diagnosis.search.grow import combined, grown
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.diagnosis.selection.candidate_results import Round, near_trials
from pace_optim.diagnosis.selection.rules import decide


def ends(branch: Branch, found: Round | None) -> list[dict[str, Any]]:
    """Where the best of what could come next leads each joint: its ``effects`` by name, its ``mse`` [rad²]."""
    result = []
    for j, (own, mse) in enumerate(zip(branch.now.model.names_of_joints, branch.errors.mse.tolist(), strict=True)):
        trials = [] if found is None else [t for t in found.trials[j] if t.significant and t.mse_after < mse]
        best = min(trials, key=lambda trial: trial.mse_after, default=None)
        more, least = ([], mse) if best is None else ([best.effect.name], best.mse_after)
        result.append({"effects": sorted({*own, *more}), "mse": least})
    return result


def further_with_next_best(
    search: Search, branch: Branch, found: Round, first: Branch, ahead: Round
) -> tuple[Branch, Round | None] | None:
    """The branch with the effects that lead furthest, and what could come next; ``None`` if the best ones do.

    If the best effect leaves much unexplained, the next best of each joint is followed for a round too. It is taken if
    it ends lower, or as low with fewer parameters. Effects with many parameters absorb other missing effects.

    Args:
        search: What is looked for.
        branch: Where the round began.
        found: The round.
        first: The branch with the best effects.
        ahead: What could come next on it.
    """
    firsts, enough = ends(first, ahead), (search.cfg.judging.far * search.floor) ** 2
    unexplained = (first.errors.mse > enough) & (torch.tensor([end["mse"] for end in firsts]) > enough)
    other = _next_choice(found, unexplained, search.cfg.judging)
    if other is None:
        return None
    search.say(f"looking ahead with {', '.join(dict.fromkeys(e.name for e in other.chosen if e is not None))}")
    # along the present reference, which is near enough for a look
    now, errors = search.settled(branch.problem, combined(search, branch, other))
    way = Branch(problem=branch.problem, now=now, errors=errors, rounds=(other,))
    beyond = search.tried(way)
    others = ends(way, beyond)
    joints = unexplained.nonzero()[:, 0].tolist()
    taken = decide(
        "look_ahead",
        joints,
        first.errors,
        {},
        cfg=search.cfg,
        log=search.log,
        names=[str(effect and effect.name) for effect in (other.chosen[j] for j in joints)],
        first=[firsts[j] for j in joints],
        next=[others[j] for j in joints],
    )
    if not taken:
        return None
    chosen = [other.chosen[j] if j in taken else effect for j, effect in enumerate(found.chosen)]
    end = grown(search, branch, found.choosing(chosen))
    return end, beyond if _is_same(end, way) else search.tried(end)


def _is_same(one: Branch, two: Branch) -> bool:
    """Whether two branches end at one model along one reference, so that what was tried on one holds for both."""
    same_effects = one.now.model.effects == two.now.model.effects
    return one.problem is two.problem and same_effects and torch.equal(one.now.x, two.now.x)


def _next_choice(found: Round, unexplained: torch.Tensor, cfg: JudgingCfg) -> Round | None:
    """The round with the effect that came nearest to the best, on unexplained joints that have one."""
    chosen = list(found.chosen)
    for j in unexplained.nonzero()[:, 0].tolist():
        if (best := found.chosen[j]) is not None:
            near = [trial.effect for trial in near_trials(found.trials[j], best, cfg=cfg) if trial.significant]
            chosen[j] = near[0] if near else best
    return None if chosen == found.chosen else found.choosing(chosen)
