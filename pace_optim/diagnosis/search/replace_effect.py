"""Another effect in place of one that was found: better beside a newer effect, or the one that most joints want."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import JudgingCfg
from pace_optim.diagnosis.fitting.validation import BlockErrors
from pace_optim.diagnosis.judging.candidate_results import Round, near_trials
from pace_optim.diagnosis.judging.comparison import within
from pace_optim.diagnosis.judging.decisions import decision
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.model.model import BASE, JointModel
from pace_optim.diagnosis.search.state import Branch, Search

_Exchange = dict[int, tuple[type[Effect], int]]
"""Joint -> the effect that another one takes the place of, and the round that it was chosen in, by index."""


def replace_effects(search: Search, branch: Branch) -> Branch:
    """Try what each joint could have had instead, now that the rest is known; the same branch if nothing is better.

    When an effect was chosen, its neighbours moved as the base model does, and effects that were found since were
    missing: what came close then may be the right one. Where both do equally well, joints agree on the effect that most
    of them want.
    """
    cfg, now, errors, rounds = search.cfg.judging, branch.now, branch.errors, list(branch.rounds)
    exchanges = _exchanges(now, rounds, errors.mse.sqrt() > cfg.near * search.at_floor, cfg)
    if not exchanges:
        return branch
    search.say("trying others in place of what was found")
    starts = [_start(now, rounds, effect, joints) for effect, joints in exchanges.items()]
    which = torch.zeros(now.model.num_joints, dtype=torch.bool)
    which[[j for joints in exchanges.values() for j in joints]] = True
    fitted, blocks = search.fits.on_joints(branch.problem, starts, which, errors)
    after, models = dict(zip(exchanges, blocks, strict=True)), dict(zip(exchanges, fitted, strict=True))
    chosen = _choose(now, errors, exchanges, {effect: block.mse for effect, block in after.items()}, cfg)
    search.log(
        decision(
            "replace",
            which.nonzero()[:, 0].tolist(),
            errors,
            {effect.name: own for effect, own in after.items()},
            {j: effect.name for j, effect in chosen.items()},
            {effect.name: list(joints) for effect, joints in exchanges.items()},
        )
    )
    if not chosen:
        return branch
    other = now
    for j, effect in chosen.items():
        _, at = exchanges[effect][j]
        other = other.with_joints(torch.arange(len(now.x)) == j, models[effect])
        alike = within(float(errors.mse[j]), float(after[effect].mse[j]), cfg.alike)
        rounds[at] = rounds[at].exchanged(j, effect, tie=alike)
    other = search.fits.side_by_side(branch.problem.in_windows(), [other], search.cfg.fitting.again)[0]
    return search.along_own_motion(replace(branch, rounds=tuple(rounds)), other)


def _exchanges(
    now: Fitted, rounds: Sequence[Round], unexplained: torch.Tensor, cfg: JudgingCfg
) -> dict[type[Effect], _Exchange]:
    """What is tried in place of what, joint by joint."""
    model = now.model
    in_use = {effect for effect, has in zip(model.effects, model.has, strict=True) if bool(has.any())}
    result: dict[type[Effect], _Exchange] = {}
    for at, this in enumerate(rounds):
        for j, old in enumerate(this.chosen):
            if old is None or old not in in_use or not bool(model.has[model.effects.index(old), j]):
                continue
            several = int(model.has[:, j].sum()) > 1 and bool(unexplained[j])
            without = model.without_effect(old, torch.arange(model.num_joints) == j)
            near = [t for t in near_trials(this.trials[j], old, cfg=cfg) if bool(without.allowed_joints(t.effect)[j])]
            own = [t.effect for t in near if t.significant][: cfg.in_place if several else 0]
            # what other joints have need not have stood out here
            wanted = [t.effect for t in near if t.effect in in_use or t.effect in own]
            for effect in wanted:
                result.setdefault(effect, {}).setdefault(j, (old, at))
    return result


def _start(now: Fitted, rounds: Sequence[Round], effect: type[Effect], joints: _Exchange) -> Fitted:
    """The present model with an effect, as it was fitted in its round, in place of others."""
    model, physical = now.model, now.physical
    for j, (old, at) in joints.items():
        here = torch.arange(model.num_joints) == j
        model, physical = exchanged(model, physical, here, [old], rounds[at].models[effect], effect, len(BASE))
    return Fitted.start(model, physical, tried=effect)


def exchanged(
    model: JointModel,
    physical: torch.Tensor,
    joints: torch.Tensor,
    old: Sequence[type[Effect]],
    source: Fitted,
    effect: type[Effect],
    size: int,
) -> tuple[JointModel, torch.Tensor]:
    """A model with an effect in place of others on some joints, and its physical values (n, P).

    Args:
        model: The model.
        physical: Its values, (n, P).
        joints: Which joints, (n,) bool.
        old: Effects that they lose.
        source: Where the values come from.
        effect: What they get.
        size: How many of the first entries come along with those of the effect.
    """
    values = source.physical
    for each in old:
        model = model.without_effect(each, joints)
    model, physical = model.extended(physical, effect, joints, values[:, source.model.columns(effect)])
    physical[joints, :size] = values[joints, :size]
    return model.structure_held(effect, physical), physical


def _choose(
    now: Fitted,
    errors: BlockErrors,
    exchanges: Mapping[type[Effect], _Exchange],
    after: Mapping[type[Effect], torch.Tensor],
    cfg: JudgingCfg,
) -> dict[int, type[Effect]]:
    """Joints that change, with their new effect: the best of each; among rivals, the one most wanted."""
    model = now.model
    near: dict[int, dict[type[Effect], float]] = {}
    for j in sorted({j for joints in exchanges.values() for j in joints}):
        options = {effect: float(after[effect][j]) for effect, joints in exchanges.items() if j in joints}
        options |= {joints[j][0]: float(errors.mse[j]) for joints in exchanges.values() if j in joints}
        least = min(options.values())
        near[j] = {effect: mse for effect, mse in options.items() if within(mse, least, cfg.alike)}
    wanted: dict[type[Effect], int] = {}
    for j in range(model.num_joints):
        own = near.get(j, [e for e, has in zip(model.effects, model.has, strict=True) if bool(has[j])])
        for effect in own:
            wanted[effect] = wanted.get(effect, 0) + 1
    total = {effect: sum(options.get(effect, 0.0) for options in near.values()) for effect in wanted}
    used = {effect: int(has.sum()) for effect, has in zip(model.effects, model.has, strict=True)}
    best = {j: min(options, key=lambda e: (-wanted[e], -used.get(e, 0), total[e])) for j, options in near.items()}
    return {j: effect for j, effect in best.items() if j in exchanges.get(effect, {})}
