"""One effect in place of several of a joint."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.fitting.coarse_to_fine import fit_side_by_side
from pace_optim.diagnosis.judging.acceptance import BlockErrors, judge
from pace_optim.diagnosis.judging.candidate_results import Round, near_trials
from pace_optim.diagnosis.judging.some_joints import SomeJoints
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.model.model import BASE
from pace_optim.diagnosis.search.replace_effect import exchanged
from pace_optim.single_joint_model.problem import TwinProblem

_PER_JOINT = 3
"""How many effects are tried in place of several."""


def one_for_several(
    problem: TwinProblem, now: Fitted, errors: BlockErrors, rounds: Sequence[Round], tried: int
) -> Fitted | None:
    """Put one effect in place of several of a joint, where the several do not pay beside it; ``None`` if nowhere.

    A wrong gain of the torque is one of the position and one of the speed: beside neighbours that moved wrongly, the
    two parts of it may have been found one after another.

    Args:
        problem: The joints simulated alone, along the motion of the model.
        now: The model at the end of the search.
        errors: Its errors.
        rounds: What was tried; their choices are updated.
        tried: How many candidates were tried, over all joints.
    """
    options = _options(now, rounds)
    if not options:
        return None
    own = [effect for effect in now.model.effects if not effect.shared]
    starts, masks = [], []
    for effect, joints in options.items():
        here = torch.zeros(now.model.num_joints, dtype=torch.bool)
        here[joints] = True
        physical = now.model.to_physical(now.x)
        model, physical = exchanged(now.model, physical, here, own, rounds[0].models[effect], effect, len(BASE))
        starts.append(Fitted.start(model, physical, tried=effect))
        masks.append(here)
    fitted, blocks = SomeJoints(torch.stack(masks).any(dim=0)).refitted(problem, starts, errors)
    after, models = dict(zip(options, blocks, strict=True)), dict(zip(options, fitted, strict=True))
    enough = {
        effect: [j for j in joints if not judge(after[effect], errors, j, tried, first=False).significant]
        for effect, joints in options.items()
    }
    model, physical = now.model, now.model.to_physical(now.x)
    for j in {j for joints in enough.values() for j in joints}:
        fitting = [effect for effect, joints in enough.items() if j in joints]
        best = min(fitting, key=lambda effect: (-len(enough[effect]), float(after[effect].mse[j])))
        here = torch.arange(model.num_joints) == j
        model, physical = exchanged(model, physical, here, own, models[best], best, len(BASE))
        for this in rounds:
            this.chosen[j], this.rivals[j] = (best if this is rounds[0] else None), []
    if model is now.model:
        return None
    return fit_side_by_side(problem.in_windows(), [Fitted.start(model, physical)], max_iteration=6)[0]


def _options(now: Fitted, rounds: Sequence[Round]) -> dict[type[Effect], list[int]]:
    """What came near to the first choice of joints that have several effects now, each with these joints."""
    own = torch.tensor([not effect.shared for effect in now.model.effects], dtype=torch.bool)
    several = now.model.has[own].sum(dim=0) > 1
    result: dict[type[Effect], list[int]] = {}
    for j in several.nonzero()[:, 0].tolist():
        first = rounds[0].chosen[j]
        near = [] if first is None else near_trials(rounds[0].trials[j], first)
        for effect in [t.effect for t in near if not t.effect.shared][:_PER_JOINT]:
            result.setdefault(effect, []).append(j)
    return result
