"""Another effect in place of one that was found: better beside a newer effect, or the one that most joints want."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.acceptance import BlockErrors, judge
from pace_optim.diagnosis.descent import Fitted, fit_side_by_side
from pace_optim.diagnosis.model import BASE
from pace_optim.diagnosis.some_joints import SomeJoints
from pace_optim.diagnosis.trials import NEXT_FLOOR, RIVAL, Round, near_trials
from pace_optim.diagnosis.validation import validation_errors
from pace_optim.joint_twins.problem import TwinProblem

_PER_JOINT = 3
"""How many effects are tried in place of one that a newer effect has joined."""

_Exchange = dict[int, type[Effect]]
"""Joint -> the effect that another one takes the place of."""


def swapped(
    problem: TwinProblem, now: Fitted, errors: BlockErrors, rounds: Sequence[Round], floor: torch.Tensor
) -> Fitted | None:
    """Try what each joint could have had instead, now that the rest is known; ``None`` if nothing is better.

    When an effect was chosen, its neighbours moved as the base model does, and effects that were found since were
    missing: what came close then may be the right one. Where both do equally well, joints agree on the effect that most
    of them want.

    Args:
        problem: The joints simulated alone, along the motion of the present model.
        now: The present model.
        errors: Its errors.
        rounds: What was tried; their choices are updated.
        floor: Nearer to this RMSE of each joint there is nothing to gain, (n,) [rad].
    """
    exchanges = _exchanges(now, rounds, errors.mse.sqrt() > NEXT_FLOOR * floor)
    if not exchanges:
        return None
    starts = [_start(now, effect, joints, rounds) for effect, joints in exchanges.items()]
    which = torch.zeros(now.model.num_joints, dtype=torch.bool)
    which[[j for joints in exchanges.values() for j in joints]] = True
    fitted, blocks = SomeJoints(which).refitted(problem, starts, errors)
    after, models = dict(zip(exchanges, blocks, strict=True)), dict(zip(exchanges, fitted, strict=True))
    chosen = _choose(now, errors, exchanges, {effect: block.mse for effect, block in after.items()})
    if not chosen:
        return None
    model, physical = now.model, now.model.to_physical(now.x)
    for j, effect in chosen.items():
        old, here, source = exchanges[effect][j], torch.arange(model.num_joints) == j, models[effect]
        values = source.model.to_physical(source.x)
        model, physical = model.extended(physical, effect, here, values[:, source.model.columns(effect)])
        model = model.without_effect(old, here)
        physical[j, : now.model.size] = values[j, : now.model.size]
        _note(rounds, j, old, effect, tie=float(errors.mse[j]) <= RIVAL**2 * float(after[effect].mse[j]))
    return fit_side_by_side(problem, [Fitted.start(model, physical)], max_iteration=6, keep_jacobian=True)[0]


def one_for_several(
    problem: TwinProblem, now: Fitted, errors: BlockErrors, rounds: Sequence[Round], tried: int
) -> tuple[Fitted, BlockErrors]:
    """Put one effect in place of several of a joint, where the several do not pay beside it.

    A wrong gain of the torque is one of the position and one of the speed: beside neighbours that moved wrongly, the
    two parts of it may have been found one after another.

    Args:
        problem: The joints simulated alone, along the motion of the model.
        now: The model at the end of the search.
        errors: Its errors.
        rounds: What was tried; the choices of the first one are updated.
        tried: How many candidates were tried, over all joints.
    """
    several = (now.model.has.sum(dim=0) > 1).nonzero()[:, 0].tolist()
    options: dict[type[Effect], list[int]] = {}
    for j in several:
        near = near_trials(rounds[0].trials[j], rounds[0].chosen[j]) if rounds[0].chosen[j] is not None else []
        for effect in [t.effect for t in near][:_PER_JOINT]:
            options.setdefault(effect, []).append(j)
    if not options:
        return now, errors
    starts = [_alone(now, effect, joints, rounds[0]) for effect, joints in options.items()]
    which = torch.zeros(now.model.num_joints, dtype=torch.bool)
    which[several] = True
    fitted, blocks = SomeJoints(which).refitted(problem, starts, errors)
    after, models = dict(zip(options, blocks, strict=True)), dict(zip(options, fitted, strict=True))
    enough = {
        effect: [j for j in joints if not judge(after[effect], errors, j, tried, first=False).significant]
        for effect, joints in options.items()
    }
    model, physical = now.model, now.model.to_physical(now.x)
    for j in several:
        best = max((e for e in enough if j in enough[e]), key=lambda e: len(enough[e]), default=None)
        if best is None:
            continue
        here, source = torch.arange(model.num_joints) == j, models[best]
        values = source.model.to_physical(source.x)
        for old in model.effects:
            model = model.without_effect(old, here)
        model, physical = model.extended(physical, best, here, values[:, source.model.columns(best)])
        physical[j, : len(BASE)] = values[j, : len(BASE)]
        rounds[0].chosen[j], rounds[0].rivals[j] = best, []
    if model is now.model:
        return now, errors
    now = fit_side_by_side(problem, [Fitted.start(model, physical)], max_iteration=6, keep_jacobian=True)[0]
    return now, validation_errors(problem, [now])[0]


def _alone(now: Fitted, effect: type[Effect], joints: Sequence[int], this: Round) -> Fitted:
    """The present model with an effect, as it was fitted in its round, in place of all others of some joints."""
    model, physical = now.model, now.model.to_physical(now.x)
    here = torch.zeros(model.num_joints, dtype=torch.bool)
    here[list(joints)] = True
    source = this.models[effect]
    values = source.model.to_physical(source.x)
    for old in model.effects:
        model = model.without_effect(old, here)
    model, physical = model.extended(physical, effect, here, values[:, source.model.columns(effect)])
    physical[here, : len(BASE)] = values[here, : len(BASE)]
    return Fitted.start(model, physical, tried=effect)


def _exchanges(now: Fitted, rounds: Sequence[Round], unexplained: torch.Tensor) -> dict[type[Effect], _Exchange]:
    """What is tried in place of what, joint by joint."""
    model = now.model
    in_use = {effect for effect, has in zip(model.effects, model.has, strict=True) if bool(has.any())}
    result: dict[type[Effect], _Exchange] = {}
    for this in rounds:
        for j, old in enumerate(this.chosen):
            if old is None or old not in in_use or not bool(model.has[model.effects.index(old), j]):
                continue
            several = int(model.has[:, j].sum()) > 1 and bool(unexplained[j])
            without = model.without_effect(old, torch.arange(model.num_joints) == j)
            near = [t for t in near_trials(this.trials[j], old) if bool(without.may_get(t.effect)[j])]
            own = [t.effect for t in near if t.significant][: _PER_JOINT if several else 0]
            # what other joints have need not have stood out here
            wanted = [t.effect for t in near if t.effect in in_use or t.effect in own]
            for effect in wanted:
                result.setdefault(effect, {}).setdefault(j, old)
    return result


def _start(now: Fitted, effect: type[Effect], joints: _Exchange, rounds: Sequence[Round]) -> Fitted:
    """The present model with an effect, as it was fitted in its round, in place of others."""
    model, physical = now.model, now.model.to_physical(now.x)
    for j, old in joints.items():
        here = torch.arange(model.num_joints) == j
        this = next(r for r in rounds if r.chosen[j] is old)
        source = this.models[effect]
        values = source.model.to_physical(source.x)
        model, physical = model.extended(physical, effect, here, values[:, source.model.columns(effect)])
        model = model.without_effect(old, here)
        physical[j, : len(BASE)] = values[j, : len(BASE)]
    return Fitted.start(model, physical, tried=effect)


def _choose(
    now: Fitted,
    errors: BlockErrors,
    exchanges: dict[type[Effect], _Exchange],
    after: dict[type[Effect], torch.Tensor],
) -> dict[int, type[Effect]]:
    """Joints that change, with their new effect: the best of each; among rivals, the one most wanted."""
    model = now.model
    near: dict[int, dict[type[Effect], float]] = {}
    for j in sorted({j for joints in exchanges.values() for j in joints}):
        options = {effect: float(after[effect][j]) for effect, joints in exchanges.items() if j in joints}
        options |= {joints[j]: float(errors.mse[j]) for joints in exchanges.values() if j in joints}
        least = min(options.values())
        near[j] = {effect: mse for effect, mse in options.items() if mse <= RIVAL**2 * least}
    wanted: dict[type[Effect], int] = {}
    for j in range(model.num_joints):
        own = near.get(j, [e for e, has in zip(model.effects, model.has, strict=True) if bool(has[j])])
        for effect in own:
            wanted[effect] = wanted.get(effect, 0) + 1
    total = {effect: sum(options.get(effect, 0.0) for options in near.values()) for effect in wanted}
    used = {effect: int(has.sum()) for effect, has in zip(model.effects, model.has, strict=True)}
    best = {j: min(options, key=lambda e: (-wanted[e], -used.get(e, 0), total[e])) for j, options in near.items()}
    return {j: effect for j, effect in best.items() if j in exchanges.get(effect, {})}


def _note(rounds: Sequence[Round], joint: int, old: type[Effect], new: type[Effect], tie: bool) -> None:
    """Write the exchange into the round that had chosen the old effect."""
    this = next(r for r in rounds if r.chosen[joint] is old)
    this.chosen[joint] = new
    others = [effect for effect in this.rivals[joint] if effect is not new]
    this.rivals[joint] = [*others, old] if tie else others
