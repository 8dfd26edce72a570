"""The moves of a search: each says where a branch leads with what was tried on top of it, or that it leads nowhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.judging.candidate_results import Round, Trial
from pace_optim.diagnosis.judging.rules import decide
from pace_optim.diagnosis.search.grow import grown
from pace_optim.diagnosis.search.look_ahead import further_with_next_best
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.single_joint_fits.fitted import Fitted

Step = tuple[Branch, Round | None]
"""A branch, and what could come next on it."""


def add_to_group(search: Search, branch: Branch, found: Round) -> Step | None:
    """An effect of other joints on all those far from the floor at once, where it pays on each.

    Neighbours that all lack the same hide it from each other: while one joint is tried, the others move wrongly. So
    they are judged together, along the motion that the robot then has.
    """
    model, far = branch.now.model, search.far(branch.errors)
    lacking = [j for j in far.nonzero()[:, 0].tolist() if found.chosen[j] is None]
    in_use = [e for e, has in zip(model.effects, model.has, strict=True) if bool(has.any())]
    in_use.sort(key=branch.squared_fall_with, reverse=True)
    for effect in [e for e in in_use if e in found.models and not e.shared]:
        joints = [j for j in lacking if any(t.effect is effect for t in found.trials[j])]
        while joints:
            search.say(f"trying {effect.name} on {len(joints)} more joint{'' if len(joints) == 1 else 's'} at once")
            chosen = [effect if j in joints else old for j, old in enumerate(found.chosen)]
            end = grown(search, branch, found.choosing(chosen))
            trials = _judged_again(search, effect, joints, found, end)
            if all(trial.significant for trial in trials.values()):
                end = replace(end, rounds=(*end.rounds[:-1], end.rounds[-1].with_trials(trials)))
                return end, search.tried(end)
            joints = [j for j, trial in trials.items() if trial.significant]
    return None


def add(search: Search, branch: Branch, found: Round) -> Step | None:
    """Each joint's best effect; the next best where that leads further."""
    if not any(effect is not None for effect in found.chosen):
        return None
    end = grown(search, branch, found)
    ahead = search.tried(end)
    if branch.rounds or ahead is None or not search.cfg.has("look_ahead"):
        return end, ahead
    return further_with_next_best(search, branch, found, end, ahead) or (end, ahead)


def _judged_again(
    search: Search, effect: type[Effect], joints: Sequence[int], found: Round, end: Branch
) -> dict[int, Trial]:
    """What an effect brings each of several joints, held against them without it along the same motion."""
    model = end.now.model
    here = torch.zeros(model.num_joints, dtype=torch.bool)
    here[list(joints)] = True
    here &= model.has[model.effects.index(effect)]
    before = end.errors  # nothing is gained where it is not there any more
    if bool(here.any()):
        start = Fitted.start(model.without_effect(effect, here), end.now.physical, tried=effect)
        before = search.fits.on_joints(end.problem, [start], here, end.errors)[1][0]
    tried, cfg = search.tried_over_joints, search.cfg.judging
    old = {j: next(t for t in found.trials[j] if t.effect is effect) for j in joints}
    trials = {j: trial.judged(before, end.errors, tried, first=False, cfg=cfg) for j, trial in old.items()}
    after = {effect.name: end.errors}
    decide("add_to_group", joints, before, after, cfg=search.cfg, log=search.log, candidates=tried)
    return trials


MOVES: Mapping[str, Callable[[Search, Branch, Round], Step | None]] = {
    "add_to_group": add_to_group,
    "add": add,
}
"""What is tried with each round, in this order; the first that leads somewhere is made."""
