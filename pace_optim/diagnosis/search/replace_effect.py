"""Another effect in place of one that was found: better beside a newer effect, or the one that most joints want."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.fitting.coarse_to_fine import fit_side_by_side
from pace_optim.diagnosis.judging.acceptance import BlockErrors
from pace_optim.diagnosis.judging.candidate_results import NEXT_FLOOR, RIVAL, Round, near_trials
from pace_optim.diagnosis.judging.some_joints import SomeJoints
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.model.model import BASE, JointModel
from pace_optim.single_joint_model.problem import TwinProblem

_PER_JOINT = 3
"""How many effects are tried in place of one that a newer effect has joined."""

_Exchange = dict[int, tuple[type[Effect], Round]]
"""Joint -> the effect that another one takes the place of, and the round that it was chosen in."""


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
    starts = [_start(now, effect, joints) for effect, joints in exchanges.items()]
    which = torch.zeros(now.model.num_joints, dtype=torch.bool)
    which[[j for joints in exchanges.values() for j in joints]] = True
    fitted, blocks = SomeJoints(which).refitted(problem, starts, errors)
    after, models = dict(zip(exchanges, blocks, strict=True)), dict(zip(exchanges, fitted, strict=True))
    chosen = _choose(now, errors, exchanges, {effect: block.mse for effect, block in after.items()})
    if not chosen:
        return None
    model, physical = now.model, now.model.to_physical(now.x)
    for j, effect in chosen.items():
        (old, this), here = exchanges[effect][j], torch.arange(model.num_joints) == j
        model, physical = exchanged(model, physical, here, [old], models[effect], effect, now.model.size)
        this.exchange(j, effect, tie=float(errors.mse[j]) <= RIVAL**2 * float(after[effect].mse[j]))
    return fit_side_by_side(problem.in_windows(), [Fitted.start(model, physical)], max_iteration=6)[0]


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
                result.setdefault(effect, {}).setdefault(j, (old, this))
    return result


def _start(now: Fitted, effect: type[Effect], joints: _Exchange) -> Fitted:
    """The present model with an effect, as it was fitted in its round, in place of others."""
    model, physical = now.model, now.model.to_physical(now.x)
    for j, (old, this) in joints.items():
        here = torch.arange(model.num_joints) == j
        model, physical = exchanged(model, physical, here, [old], this.models[effect], effect, len(BASE))
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
    values = source.model.to_physical(source.x)
    for each in old:
        model = model.without_effect(each, joints)
    model, physical = model.extended(physical, effect, joints, values[:, source.model.columns(effect)])
    physical[joints, :size] = values[joints, :size]
    return model.structure_held(effect, physical), physical


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
        options |= {joints[j][0]: float(errors.mse[j]) for joints in exchanges.values() if j in joints}
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
