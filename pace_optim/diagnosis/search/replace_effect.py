"""Another effect in place of one that was found: better beside a newer effect, or the one that most joints want."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import JudgingCfg
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.diagnosis.selection.candidate_results import Round, near_trials
from pace_optim.diagnosis.selection.comparison import within
from pace_optim.diagnosis.selection.rules import decide
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE

_Exchange = dict[int, tuple[type[Effect], int]]
"""Joint -> the effect that another one takes the place of, and the round that it was chosen in, by index."""


def replace_effects(search: Search, branch: Branch) -> Branch:
    """Try what each joint could have had instead, now that the rest is known; the same branch if nothing is better.

    When an effect was chosen, its neighbours moved as the base model does, and effects that were found since were
    missing: what came close then may be the right one. Where both do equally well, joints agree on the effect that most
    of them want.
    """
    cfg, now, errors, rounds = search.cfg.judging, branch.now, branch.errors, list(branch.rounds)
    exchanges = _exchanges(now, rounds, errors.mse.sqrt() > cfg.next_effect * search.at_floor, cfg)
    if not exchanges:
        return branch
    search.say("trying replacements for the found effects")
    joints = {effect: list(own) for effect, own in exchanges.items()}
    every = sorted({j for own in joints.values() for j in own})
    starts = [_start(now, rounds, effect, own) for effect, own in exchanges.items()]
    fitted, after = search.fits.on_joints(branch.problem, starts, _these(every, now), errors)
    models, tried = dict(zip(exchanges, fitted, strict=True)), dict(zip(exchanges, after, strict=True))
    taken = decide(
        "replace",
        every,
        errors,
        {effect.name: own for effect, own in tried.items()},
        {effect.name: own for effect, own in joints.items()},
        cfg=search.cfg,
        log=search.log,
        has=now.model.names_of_joints,
        olds={e.name: {str(j): old.name for j, (old, _) in own.items()} for e, own in exchanges.items()},
    )
    if not taken:
        return branch
    effects = {effect.name: effect for effect in exchanges}
    for j, name in taken.items():
        effect = effects[name]
        at, mse = exchanges[effect][j][1], float(tried[effect].mse[j])
        rounds[at] = rounds[at].exchanged(j, effect, tie=within(float(errors.mse[j]), mse, cfg.alike))
        now = now.with_joints(_these([j], now), models[effect])
    other = search.fits.side_by_side(branch.problem.in_windows(), [now], search.fits.cfg.again)[0]
    return search.along_own_motion(replace(branch, rounds=tuple(rounds)), other)


def _exchanges(
    now: Fitted, rounds: Sequence[Round], unexplained: torch.Tensor, cfg: JudgingCfg
) -> dict[type[Effect], _Exchange]:
    """Which effect is tried instead of which, joint by joint."""
    model = now.model
    in_use = {effect for effect, has in zip(model.effects, model.has, strict=True) if bool(has.any())}
    result: dict[type[Effect], _Exchange] = {}
    for at, this in enumerate(rounds):
        for j, old in enumerate(this.chosen):
            if old is None or old not in in_use or not bool(model.has[model.effects.index(old), j]):
                continue
            several = int(model.has[:, j].sum()) > 1 and bool(unexplained[j])
            without = model.without_effect(old, _these([j], now))
            near = [t for t in near_trials(this.trials[j], old, cfg=cfg) if bool(without.allowed_joints(t.effect)[j])]
            own = [t.effect for t in near if t.significant][: cfg.in_place if several else 0]
            # what other joints have need not have stood out here
            wanted = [t.effect for t in near if t.effect in in_use or t.effect in own]
            for effect in wanted:
                result.setdefault(effect, {}).setdefault(j, (old, at))
    return result


def _start(now: Fitted, rounds: Sequence[Round], effect: type[Effect], joints: _Exchange) -> Fitted:
    """The present model with an effect, as it was fitted in its round, in place of others."""
    for j, (old, at) in joints.items():
        now = exchanged(now, _these([j], now), old, rounds[at].models[effect], effect)
    return now


def exchanged(now: Fitted, joints: torch.Tensor, old: type[Effect], source: Fitted, effect: type[Effect]) -> Fitted:
    """A start with an effect in place of another on some joints, and the base parameters that it was fitted with.

    Args:
        now: The present model.
        joints: Which joints, (n,) bool.
        old: What they lose.
        source: A model of all joints with the effect, fitted.
        effect: What they get.
    """
    model, values = now.model.without_effect(old, joints), source.physical
    model, physical = model.extended(now.physical, effect, joints, values[:, source.model.columns(effect)])
    physical[joints, : len(BASE)] = values[joints, : len(BASE)]
    return Fitted.start(model.structure_held(effect, physical), physical, tried=effect)


def _these(joints: Sequence[int], now: Fitted) -> torch.Tensor:
    """Joints by their index, (n,) bool."""
    result = torch.zeros(now.model.num_joints, dtype=torch.bool)
    result[list(joints)] = True
    return result
