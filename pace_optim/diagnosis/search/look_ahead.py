"""The best effect of the first round may stand in for two others: the next best leads on for a round, too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, JudgingCfg
from pace_optim.diagnosis.judging.candidate_results import Round, near_trials
from pace_optim.diagnosis.judging.comparison import within
from pace_optim.diagnosis.judging.decisions import decision
from pace_optim.diagnosis.search.grow import combined, grown
from pace_optim.diagnosis.search.state import Branch, Search


@dataclass(frozen=True, kw_only=True)
class End:
    """Where a way leads a joint."""

    effects: frozenset[type[Effect]]
    mse: float
    """On validation [rad²]."""

    def beats(self, other: End, *, cfg: JudgingCfg = DEFAULT.judging) -> bool:
        """Whether to go this way in place of another: for less error, or for as little with fewer parameters."""
        own, others = (sum(len(e.parameters) for e in end.effects) for end in (self, other))
        if self.effects == other.effects or own > others:
            return not within(other.mse, self.mse, cfg.alike)
        return within(self.mse, other.mse, cfg.as_good) if own < others else self.mse < other.mse

    def told(self) -> dict[str, Any]:
        """In names and numbers."""
        return {"effects": sorted(effect.name for effect in self.effects), "mse": self.mse}


def ends(branch: Branch, found: Round | None) -> list[End]:
    """Where the best of what could come next leads each joint."""
    model, mse, result = branch.now.model, branch.errors.mse, []
    for j in range(model.num_joints):
        own = {effect for effect, has in zip(model.effects, model.has, strict=True) if has[j]}
        trials = [] if found is None else [t for t in found.trials[j] if t.significant and t.mse_after < mse[j]]
        best = min(trials, key=lambda trial: trial.mse_after, default=None)
        result.append(
            End(effects=frozenset(own), mse=float(mse[j]))
            if best is None
            else End(effects=frozenset({*own, best.effect}), mse=best.mse_after)
        )
    return result


def further_with_next_best(
    search: Search, branch: Branch, found: Round, first: Branch, ahead: Round
) -> tuple[Branch, Round | None] | None:
    """The branch with the effects that lead furthest, and what could come next; ``None`` if the best ones do.

    Where the best effect leaves much unexplained, the next one of each joint leads on for a round too, and is taken if
    it ends lower, or as low with fewer parameters: the others that are missing give much to whatever has parameters to
    spare.

    Args:
        search: What is looked for.
        branch: Where the round began.
        found: The round.
        first: The branch with the best effects.
        ahead: What could come next on it.
    """
    firsts, enough = ends(first, ahead), (search.cfg.judging.far * search.floor) ** 2
    unexplained = (first.errors.mse > enough) & (torch.tensor([end.mse for end in firsts]) > enough)
    other = _next_choice(found, unexplained, search.cfg.judging)
    if other is None:
        return None
    search.say(f"looking ahead with {', '.join(dict.fromkeys(e.name for e in other.chosen if e is not None))}")
    # along the present reference, which is near enough for a look
    now, errors = search.settled(branch.problem, combined(search, branch, other))
    way = Branch(problem=branch.problem, now=now, errors=errors, rounds=(other,))
    beyond = search.tried(way)
    others = ends(way, beyond)
    better = [
        yes and two.beats(one, cfg=search.cfg.judging)
        for one, two, yes in zip(firsts, others, unexplained.tolist(), strict=True)
    ]
    joints = unexplained.nonzero()[:, 0].tolist()
    taken = {j: str(effect and effect.name) for j, effect in enumerate(other.chosen) if better[j]}
    one, two = ([each[j].told() for j in joints] for each in (firsts, others))
    search.log(decision("look_ahead", joints, first.errors, {}, taken, first=one, next=two))
    if not any(better):
        return None
    chosen = [two if yes else one for one, two, yes in zip(found.chosen, other.chosen, better, strict=True)]
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
