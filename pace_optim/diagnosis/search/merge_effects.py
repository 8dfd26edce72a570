"""One effect in place of several of a joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import JudgingCfg
from pace_optim.diagnosis.judging.candidate_results import Round, near_trials
from pace_optim.diagnosis.search.alternatives import Alternatives, exchanged
from pace_optim.diagnosis.search.replace_effect import replace_effects
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.single_joint_fits.fitted import Fitted


def merge_effects(search: Search, branch: Branch) -> Branch:
    """Put one effect in place of several of a joint, where those do not pay beside it; the same branch if nowhere.

    A wrong gain of the torque is one of the position and one of the speed: beside neighbours that moved wrongly, the
    two parts of it may have been found one after another.
    """
    now, rounds = branch.now, list(branch.rounds)
    options = _options(now, rounds, search.cfg.judging)
    own, every = [effect for effect in now.model.effects if not effect.shared], range(now.model.num_joints)
    starts = {
        effect: exchanged(now, torch.tensor([j in joints for j in every]), own, rounds[0].models[effect], effect)
        for effect, joints in options.items()
    }
    tried = Alternatives.fitted(search, branch, starts, options)
    taken = tried.taken(search, "merge")
    if not taken:
        return branch
    for j, effect in taken.items():
        rounds = [this.settled(j, effect if at == 0 else None) for at, this in enumerate(rounds)]
    start, iterations = tried.with_taken(taken), search.fits.cfg.again
    one = search.fits.side_by_side(branch.problem.in_windows(), [start], iterations)[0]
    branch = search.along_own_motion(replace(branch, rounds=tuple(rounds)), one)
    return replace_effects(search, branch) if search.cfg.has("replace") else branch


def _options(now: Fitted, rounds: Sequence[Round], cfg: JudgingCfg) -> dict[type[Effect], list[int]]:
    """What came near to the first choice of joints that have several effects now, each with these joints."""
    own = torch.tensor([not effect.shared for effect in now.model.effects], dtype=torch.bool)
    several = now.model.has[own].sum(dim=0) > 1
    result: dict[type[Effect], list[int]] = {}
    for j in several.nonzero()[:, 0].tolist():
        first = rounds[0].chosen[j]
        near = [] if first is None else near_trials(rounds[0].trials[j], first, cfg=cfg)
        for effect in [t.effect for t in near if not t.effect.shared][: cfg.in_place]:
            result.setdefault(effect, []).append(j)
    return result
