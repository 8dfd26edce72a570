"""From what was tried to a verdict, in numbers and in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from pace_actuators.effects import Effect
from pace_actuators.joint_units import JointType, all_hinges, units_for
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.selection.candidate_results import Round, Trial
from pace_optim.diagnosis.selection.comparison import least_ratio, within
from pace_optim.diagnosis.verdict.names import above_floor, curves_in, new_effects
from pace_optim.joints.fits.fitted import Fitted


def verdict(outcome: Outcome, floor: torch.Tensor, named: torch.Tensor) -> tuple[str, Outcome]:
    """The verdict, and the outcome with the effects and curves that stand.

    ``effect`` where effects are named on some joints; others then have the base model, or a curve. Else ``unknown``
    where a joint ends clearly above the floor or has something that lowers its error, which stays; else
    ``nothing_missing``.

    Args:
        outcome: Where the search ended.
        floor: Of each joint, (n,) [rad].
        named: Joints with effects that are named, (n,) bool.
    """
    with_curve = curves_in(outcome.final.model).any(dim=0)
    named = named & ~with_curve
    if bool(named.any()):
        return "effect", restricted(outcome, named | with_curve)
    hinted = new_effects(outcome, outcome.final.model).any(dim=0)
    above = outcome.final_errors.mse.sqrt() > outcome.cfg.judging.clear * floor
    return "unknown" if bool((above | with_curve | hinted).any()) else "nothing_missing", outcome


def part_explained(outcome: Outcome, floor: torch.Tensor) -> float:
    """The part of the error above the floor that the effects and curves explain, of all joints together."""
    before, after = above_floor(outcome, floor)
    return 1 - float(after.sum() / before.sum().clamp(min=1e-30))


def restricted(outcome: Outcome, joints: torch.Tensor) -> Outcome:
    """The outcome with the base model on all joints but these, (n,) bool."""
    others = ~joints & outcome.final.model.has.any(dim=0)
    return replace(
        outcome,
        final=outcome.final.with_joints(others, outcome.base),
        final_errors=outcome.final_errors.with_joints(others, outcome.base_errors),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Confounded:
    """An effect of the final model and one that does as well."""

    chosen: type[Effect]
    rival: type[Effect]
    models: tuple[Fitted, Fitted]
    """With either, as they were fitted."""
    joints: list[int]


def confounded(outcome: Outcome) -> list[Confounded]:
    """Pairs of effects that the recordings cannot separate, with the joints where that is so."""
    model, result = outcome.final.model, []
    for this in outcome.rounds:
        found: dict[tuple[type[Effect], type[Effect]], list[int]] = {}
        for j, (chosen, rivals) in enumerate(zip(this.chosen, this.rivals, strict=True)):
            if chosen in model.effects and bool(model.has[model.effects.index(chosen), j]):
                for rival in rivals:
                    found.setdefault((chosen, rival), []).append(j)
        result += [
            Confounded(chosen=a, rival=b, models=(this.models[a], this.models[b]), joints=joints)
            for (a, b), joints in found.items()
        ]
    return result


def likes(outcome: Outcome) -> dict[str, list[str]]:
    """For each effect of the final model, those that the recordings cannot separate from it, if any."""
    found: dict[str, list[str]] = {}
    for pair in confounded(outcome):
        own = found.setdefault(pair.chosen.name, [])
        own += [pair.rival.name] if pair.rival.name not in own else []
    return found


def ranking(
    outcome: Outcome,
    joint_names: Sequence[str],
    decision: str = "effect",
    order: Sequence[type[Effect]] = (),
    *,
    joint_types: Sequence[JointType] = (),
) -> list[dict[str, Any]]:
    """Every effect that was refitted, those that the model has in the end first.

    The others round by round: those that are the best on some joint, then by what they explain.

    Args:
        outcome: Where the search ended.
        joint_names: The joints.
        decision: The verdict; unless it is ``effect``, nothing counts as added.
        order: Which of those added comes first; none goes round by round.
        joint_types: Whether each joint turns or slides; none: all turn.
    """
    types = joint_types or all_hinges(len(joint_names))
    places = {effect.name: place for place, effect in enumerate(order)}
    model = outcome.final.model
    entries: list[tuple[tuple, dict[str, Any]]] = []
    for depth, this in enumerate(outcome.rounds):
        for effect in dict.fromkeys(t.effect for own in this.trials for t in own):
            kept = model.has[model.effects.index(effect)].tolist() if effect in model.effects else []
            added = [j for j, yes in enumerate(kept) if yes and this.chosen[j] is effect]
            entry = {
                "effect": effect.name,
                "round": depth + 1,
                "added": bool(added) and decision == "effect",
                **_told(this, effect, added, joint_names, types, least_ratio(depth == 0, cfg=outcome.cfg.judging)),
            }
            entry["status"] = "added" if entry["added"] else _status(this, effect, outcome)
            is_best = any(own and own[0].effect is effect for own in this.trials)
            ratio = entry["validation_rmse_before"] / max(entry["validation_rmse_after"], 1e-12)
            place = places.get(effect.name, len(places)) if added else 0
            entries.append(((not added, place, depth, not is_best, -ratio), entry))
    return [entry for _, entry in sorted(entries, key=lambda each: each[0])]


def _status(this: Round, effect: type[Effect], outcome: Outcome) -> str:
    """What an effect that was not added is worth beside what its joints have in the end."""
    found = {"does not pay"}
    for j, trials in enumerate(this.trials):
        best = min([float(outcome.final_errors.mse[j]), *(t.mse_after for t in trials if t.effect is this.chosen[j])])
        for trial in (t for t in trials if t.effect is effect and t.significant):
            alike = outcome.cfg.judging.alike
            if not within(best, trial.mse_after, alike):
                found.add("would pay")
            else:
                found.add("as good" if within(trial.mse_after, best, alike) else "leaves more")
    return next(each for each in STATUS if each in found)


STATUS = ("would pay", "as good", "leaves more", "does not pay")
"""Of an effect that was not added, on the joint where it is worth most: with the model that the joint has in the end it
would lower the error further, leaves as much, leaves more, or does not lower the error enough."""


def _told(
    this: Round,
    effect: type[Effect],
    added: Sequence[int],
    joint_names: Sequence[str],
    types: Sequence[JointType],
    least: float,
) -> dict[str, Any]:
    """What a round shows of an effect: on the joints that have it in the end, else where it counts, else anywhere."""
    own = [t for trials in this.trials for t in trials if t.effect is effect]
    good = [t for t in own if t.significant]
    shown = [t for t in own if t.joint in added] or good or own
    confounded = {other.name for j in added for other in this.rivals[j]}
    for chosen, rivals in zip(this.chosen, this.rivals, strict=True):
        if chosen is not None and effect in rivals:
            confounded.add(chosen.name)
    return {
        "joints": [joint_names[t.joint] for t in shown],
        "validation_rmse_before": _rms(t.mse_before for t in shown),
        "validation_rmse_after": _rms(t.mse_after for t in shown),
        "significant": bool(good),
        "evidence": _evidence(shown, effect, least, units_for("mrad", [types[t.joint] for t in shown])),
        "confounded_with": sorted(confounded),
        "screen_score": max(t.screen_score for t in own),
        "values": {joint_names[t.joint]: t.values for t in shown},
        "tried": {
            joint_names[t.joint]: [t.mse_before**0.5, t.mse_after**0.5]
            for t in sorted(own, key=lambda t: -t.mse_before)
        },
    }


def _evidence(trials: Sequence[Trial], effect: type[Effect], least: float, unit: str) -> str:
    before, after = 1e3 * _rms(t.mse_before for t in trials), 1e3 * _rms(t.mse_after for t in trials)
    strongest = max(trials, key=lambda t: t.ratio)
    blocks = f"t = {strongest.t:.1f} over blocks of up to one second"
    verb, why = "falls", f" ({blocks})"
    if after >= before:
        verb, why = "does not fall:", ""
    elif not strongest.significant:
        little = f", less than the {least:g} times that count" if before < least * after else ""
        why = little or f", too unevenly to count ({blocks})"
    return (
        f"On recordings not used for fitting the error {verb} from {before:.3g} to {after:.3g} {unit} with it{why}. "
        f"Sign: {effect.looks}."
    )


def _rms(squares: Any) -> float:
    values = list(squares)
    return math.sqrt(sum(values) / len(values))
