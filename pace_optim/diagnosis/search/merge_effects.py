"""One effect in place of several of a joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import JudgingCfg
from pace_optim.diagnosis.judging.candidate_results import Round, near_trials
from pace_optim.diagnosis.judging.comparison import judge
from pace_optim.diagnosis.judging.decisions import decision
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.model.model import BASE
from pace_optim.diagnosis.search.replace_effect import exchanged, replace_effects
from pace_optim.diagnosis.search.state import Branch, Search


def merge_effects(search: Search, branch: Branch) -> Branch:
    """Put one effect in place of several of a joint, where those do not pay beside it; the same branch if nowhere.

    A wrong gain of the torque is one of the position and one of the speed: beside neighbours that moved wrongly, the
    two parts of it may have been found one after another.
    """
    now, errors, rounds, tried = branch.now, branch.errors, list(branch.rounds), search.tried_over_joints
    options = _options(now, rounds, search.cfg.judging)
    if not options:
        return branch
    own = [effect for effect in now.model.effects if not effect.shared]
    starts, masks = [], []
    for effect, joints in options.items():
        here = torch.zeros(now.model.num_joints, dtype=torch.bool)
        here[joints] = True
        model, physical = exchanged(now.model, now.physical, here, own, rounds[0].models[effect], effect, len(BASE))
        starts.append(Fitted.start(model, physical, tried=effect))
        masks.append(here)
    which = torch.stack(masks).any(dim=0)
    fitted, blocks = search.fits.on_joints(branch.problem, starts, which, errors)
    after, models = dict(zip(options, blocks, strict=True)), dict(zip(options, fitted, strict=True))

    def pays(several_beside: type[Effect], joint: int) -> bool:
        cfg = search.cfg.judging
        return judge(after[several_beside], errors, joint, tried, first=False, cfg=cfg).significant

    enough = {effect: [j for j in joints if not pays(effect, j)] for effect, joints in options.items()}
    merged, taken = now, {}
    for j in {j for joints in enough.values() for j in joints}:
        fitting = [effect for effect, joints in enough.items() if j in joints]
        best = min(fitting, key=lambda effect: (-len(enough[effect]), float(after[effect].mse[j])))
        here = torch.arange(now.model.num_joints) == j
        merged = merged.with_joints(here, models[best])
        rounds = [this.settled(j, best if at == 0 else None) for at, this in enumerate(rounds)]
        taken[j] = best.name
    search.log(
        decision(
            "merge",
            which.nonzero()[:, 0].tolist(),
            errors,
            {effect.name: block for effect, block in after.items()},
            taken,
            {effect.name: joints for effect, joints in options.items()},
            candidates=tried,
        )
    )
    if not taken:
        return branch
    one = search.fits.side_by_side(branch.problem.in_windows(), [merged], search.cfg.fitting.again)[0]
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
