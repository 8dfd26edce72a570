"""Which of the effects that a search ended with have earned their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.selection.decisions import Log, unlogged
from pace_optim.diagnosis.selection.naming import CURVE_LEAVES_LESS, Evidence, doubts
from pace_optim.diagnosis.selection.rules import decide
from pace_optim.diagnosis.selection.size_consistency import sizes_apart, unevenness
from pace_optim.diagnosis.verdict.sizes import error_bars_from_none, size_of, standard_deviations
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import JointModel


@dataclass(frozen=True, kw_only=True)
class Hint:
    """An effect that lowers a joint's error and has not earned its name."""

    effect: str
    joint: int
    explained: float
    """Part that it explains of what lies above the floor without it."""
    doubts: list[str]
    """What speaks against it."""
    sizes: list[dict[str, Any]] = field(default_factory=list)
    """Each of its parameters as in a diagnosis' ``sizes``, and ``apart``: the smallest and the largest value if each
    recording had its own, if they are known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Names:
    """What is named, and what is not."""

    outcome: Outcome
    """With the effects that are named; on joints without, those that lower an error which is far from the floor."""
    named: torch.Tensor
    """Joints with effects that are named, (n,) bool."""
    hints: list[Hint]
    """Effects of the others."""
    evidence: Mapping[tuple[type[Effect], int], Evidence]
    """What is known of each effect on each joint by itself, also of those that were dropped."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _LeftOut:
    """A model without an effect, fitted again, and what that says of the effect on each joint."""

    fitted: Fitted
    errors: BlockErrors
    evidence: Mapping[int, Evidence]


def earned_names(fits: Fits, outcome: Outcome, floor: torch.Tensor, log: Log = unlogged) -> Names:
    """Separate effects whose names are earned from those that only lower the error.

    Each effect is left out in turn and the rest fitted again; what is lost is the evidence (:func:`doubts`). On a joint
    the weakest one that has not earned its name goes, until all that are left have. A joint on which none has keeps its
    effects as hints where it is far from the floor without them, and loses them otherwise.

    Args:
        fits: Fits models.
        outcome: Where the search ended.
        floor: Of each joint, (n,) [rad].
        log: Gets every decision.
    """
    now, errors = outcome.final, outcome.final_errors
    open_, failed = new_effects(outcome, now.model).any(dim=0), torch.zeros(len(floor), dtype=torch.bool)
    hints: dict[int, Hint] = {}
    known: dict[tuple[type[Effect], int], Evidence] = {}
    while bool(open_.any()):
        if now.jacobian is None or now.error is None:
            now = fits.looked_at(outcome.problem, [now])[0]
        every = _left_out(fits, outcome, now, errors, open_, floor, known)
        count = new_effects(outcome, now.model).sum(dim=0)
        earned = {effect: _earned(effect, own, outcome, errors, log) for effect, own in every.items()}
        for j in open_.nonzero()[:, 0].tolist():
            here = torch.arange(len(floor)) == j
            evidence = {effect: own.evidence[j] for effect, own in every.items() if j in own.evidence}
            known |= {(effect, j): each for effect, each in evidence.items()}
            weak = [effect for effect in evidence if j not in earned[effect]]
            weakest = min(weak, key=lambda effect: evidence[effect].without, default=None)
            if weakest is None or int(count[j]) == 1:
                open_ = open_ & ~here
            if weakest is None:
                continue
            model, own = every[weakest].fitted, every[weakest].errors
            if int(count[j]) == 1:
                if own.mse[j] > outcome.base_errors.mse[j]:
                    model, own = outcome.base, outcome.base_errors
                if float(own.mse[j]) > (outcome.cfg.judging.far * float(floor[j])) ** 2:
                    failed = failed | here
                    hints[j] = hint(weakest, j, every[weakest].evidence, outcome, now)
                    model, own = outcome.final, outcome.final_errors
            now, errors = now.with_joints(here, model), errors.with_joints(here, own)
    return Names(
        outcome=replace(outcome, final=now, final_errors=errors),
        named=new_effects(outcome, now.model).any(dim=0) & ~failed,
        hints=list(hints.values()),
        evidence=known,
    )


def new_effects(outcome: Outcome, model: JointModel) -> torch.Tensor:
    """Effects of a model that were found, (effects, n) bool: no curves, and none that the run had."""
    result = model.has & ~curves_in(model)
    base = outcome.base.model
    for effect, has in zip(base.effects, base.has, strict=True):
        if effect in model.effects:
            result[model.effects.index(effect)] &= ~has
    return result


def curves_in(model: JointModel) -> torch.Tensor:
    """Curves of any form that stand where an effect is not known, (effects, n) bool."""
    return model.has & torch.tensor([effect.free_form for effect in model.effects], dtype=torch.bool)[:, None]


def above_floor(outcome: Outcome, floor: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Squared error above the floor before and after, (n,) each [rad²].

    Args:
        outcome: Where the search ended.
        floor: Of each joint, (n,) [rad].
    """
    before, after = ((errors.mse - floor**2).clamp(min=0.0) for errors in (outcome.base_errors, outcome.final_errors))
    return before, after


def shares_of(names: Names, outcome: Outcome) -> dict[type[Effect], float]:
    """How much of what was found explains together is due to each effect and curve, the largest first; in all 1.

    Of an effect it is what the squared error rises by without it; effects that can take each other's place share
    little.

    Args:
        names: What is named.
        outcome: The same, with curves on the joints where these say more.
    """
    model, rise = outcome.final.model, {}
    fall = (outcome.base_errors.mse - outcome.final_errors.mse).tolist()
    for effect, has in zip(model.effects, new_effects(outcome, model) | curves_in(model), strict=True):
        joints = has.nonzero()[:, 0].tolist()
        own = [fall[j] if effect.free_form else names.evidence[effect, j].rise for j in joints]
        if joints:
            rise[effect] = sum(max(0.0, each) for each in own)
    whole = max(sum(rise.values()), 1e-30)
    return {effect: rise[effect] / whole for effect in sorted(rise, key=rise.__getitem__, reverse=True)}


def _left_out(
    fits: Fits,
    outcome: Outcome,
    now: Fitted,
    errors: BlockErrors,
    joints: torch.Tensor,
    floor: torch.Tensor,
    known: Mapping[tuple[type[Effect], int], Evidence],
) -> dict[type[Effect], _LeftOut]:
    """Each effect left out of a model on some joints, (n,) bool, and the rest fitted again; others are ``known``."""
    model = now.model
    found = [(e, has & joints) for e, has in zip(model.effects, new_effects(outcome, model), strict=True)]
    found = [(effect, has) for effect, has in found if bool(has.any())]

    def fitted(some: Sequence[tuple[type[Effect], torch.Tensor]]) -> list[tuple[Fitted, BlockErrors]]:
        result = []
        for effect, has in some:
            start = Fitted.start(model.without_effect(effect, has), now.physical, tried=effect)
            models, after = fits.on_joints(outcome.problem, [start], has, errors)
            result.append((models[0], after[0]))
        return result

    after = fits.shared_out(fitted, found, [effect for effect, _ in found])
    count, bars, uneven = new_effects(outcome, model).sum(dim=0), error_bars_from_none(now), unevenness(now)
    left_without = {
        (effect, j): float(own.mse[j] if count[j] > 1 else min(own.mse[j], outcome.base_errors.mse[j]))
        for (effect, has), (_, own) in zip(found, after, strict=True)
        for j in has.nonzero()[:, 0].tolist()
    }
    rises = {key: each.rise for key, each in known.items()}
    rises |= {(effect, j): mse - float(errors.mse[j]) for (effect, j), mse in left_without.items()}
    stuck, implausible = model.has_at_bounds(now.x, now.moves), model.implausible(now.physical)
    harm, hardly_shows = (
        harm_of(replace(outcome, final_errors=errors)),
        outcome.base_errors.mse.sqrt() <= outcome.cfg.judging.far * floor,
    )
    result = {}
    for (effect, has), (without, own) in zip(found, after, strict=True):
        row, places = model.effects.index(effect), has.nonzero()[:, 0].tolist()
        evidence = {
            j: Evidence(
                without=left_without[effect, j],
                left=float(errors.mse[j]),
                floor=float(floor[j] ** 2),
                harm=float(harm[j]),
                larger=_larger(effect, j, model, rises, outcome.trees),
                slight=bool(effect.smooths_friction and hardly_shows[j]),
                bars=float(bars[row, j]),
                uneven=float(uneven[row, j]),
                at_bound=bool(stuck[row, j]),
                implausible=bool(implausible[row, j]),
            )
            for j in places
        }
        result[effect] = _LeftOut(fitted=without, errors=own, evidence=evidence)
    return result


def _larger(
    effect: type[Effect],
    joint: int,
    model: JointModel,
    rises: Mapping[tuple[type[Effect], int], float],
    trees: Sequence[Sequence[int]],
) -> float:
    """What the largest effect of a joint's tree explains [rad²]; 0 if that is the effect on the joint itself."""
    tree = next((own for own in trees if joint in own), [joint])
    names = model.names_of_joints
    others = (rise for (each, j), rise in rises.items() if j in tree and each.name in names[j])
    largest = max(others)
    return largest if largest > rises[effect, joint] else 0.0


def as_judged(effect: type[Effect], evidence: Mapping[int, Evidence]) -> dict[int, Evidence]:
    """The evidence that joints are judged by: where an effect is one for all, that of all together."""
    if not effect.shared or not evidence:
        return dict(evidence)
    own = list(evidence.values())
    together = Evidence(
        without=sum(each.without for each in own),
        left=sum(each.left for each in own),
        floor=sum(each.floor for each in own),
        harm=0.0,
        larger=max(each.larger for each in own),
        slight=all(each.slight for each in own),
        bars=max(each.bars for each in own),
        uneven=max(each.uneven for each in own),
        at_bound=any(each.at_bound for each in own),
        implausible=any(each.implausible for each in own),
    )
    return dict.fromkeys(evidence, together)


def harm_of(outcome: Outcome) -> torch.Tensor:
    """By how much the other joints of each joint's tree are worse than with the base model, (n,) [rad²]."""
    worse = (outcome.final_errors.mse - outcome.base_errors.mse).clamp(min=0.0)
    result = torch.zeros_like(worse)
    for tree in map(list, outcome.trees):
        result[tree] = worse[tree].sum() - worse[tree]
    return result


def _earned(effect: type[Effect], own: _LeftOut, outcome: Outcome, errors: BlockErrors, log: Log) -> dict[int, str]:
    """Joints on which an effect has earned its name."""
    evidence = [asdict(each) for each in as_judged(effect, own.evidence).values()]
    without = {effect.name: own.errors}
    return decide("name", list(own.evidence), errors, without, cfg=outcome.cfg, log=log, evidence=evidence)


def hint(
    effect: type[Effect],
    joint: int,
    evidence: Mapping[int, Evidence],
    outcome: Outcome,
    now: Fitted,
    std: torch.Tensor | None = None,
    doubted: Sequence[str] = (),
) -> Hint:
    """An effect of a joint with its size and what speaks against its name.

    Args:
        effect: The effect.
        joint: The joint.
        evidence: Of the effect, on all its joints.
        outcome: Where the search ended.
        now: The model that has it.
        std: Physical standard deviations, (n, P), zero without error bar; ``None``: from its Jacobian.
        doubted: What speaks against it beside its evidence.
    """
    own, columns = as_judged(effect, evidence)[joint], now.model.columns(effect)
    if std is None:
        std = torch.zeros_like(now.x) if now.jacobian is None else standard_deviations(now)
    apart = None if now.jacobian is None else sizes_apart(now, effect, joint)
    sizes = [
        size_of(effect, parameter, value, error, now.model.joint_type(joint))
        | {"apart": None if apart is None else [float(apart[:, p].min()), float(apart[:, p].max())]}
        for p, (parameter, value, error) in enumerate(
            zip(effect.parameters, now.physical[joint, columns].tolist(), std[joint, columns].tolist(), strict=True)
        )
    ]
    against = [*doubts(own, cfg=outcome.cfg), *doubted]
    return Hint(effect=effect.name, joint=joint, explained=own.explained, doubts=against, sizes=sizes)


def beside_curves(outcome: Outcome, names: Names, covered: torch.Tensor) -> list[Hint]:
    """On each joint where a curve takes the place of named effects, the one that explains most, as a hint.

    Args:
        outcome: With the effects that are named.
        names: What is named.
        covered: Joints where a curve takes their place, (n,) bool.
    """
    result = []
    for j in (covered & names.named).nonzero()[:, 0].tolist():
        here = {effect: own for (effect, joint), own in names.evidence.items() if joint == j}
        has = [e for e, own in zip(outcome.final.model.effects, outcome.final.model.has, strict=True) if bool(own[j])]
        if nearest := max((e for e in has if e in here), key=lambda e: here[e].explained, default=None):
            evidence = {joint: own for (effect, joint), own in names.evidence.items() if effect is nearest}
            result.append(hint(nearest, j, evidence, outcome, outcome.final, doubted=[CURVE_LEAVES_LESS]))
    return result
