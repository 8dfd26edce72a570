"""One round of the search: what could be missing beside a model, screened, begun, refitted and judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from pace_actuators.effects import Effect
from pace_actuators.text import listed
from pace_optim.diagnosis.candidates.multistart import multistart
from pace_optim.diagnosis.candidates.screening import Probe, screen, starts_of
from pace_optim.diagnosis.diagnosis_cfg import CandidatesCfg
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.diagnosis.selection.candidate_results import Round, Trial
from pace_optim.diagnosis.selection.choice import choose
from pace_optim.diagnosis.selection.decisions import Decision
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fitted import Fitted

_EFFECTS = 3
"""Names that a line of progress shows."""
_LEAST = 1e-3
"""Each floor counts as at least this part of the largest: that of a simulated recording can be zero."""


def try_effects(search: Search, branch: Branch, rough: bool = False) -> Round | None:
    """Screen effects, refit the promising ones on top of a model, and judge them; ``None`` if none is promising.

    Args:
        search: What is looked for, on the joints of the branch.
        branch: The present model, and its errors.
        rough: Whether refits go on over wide steps.
    """
    begun, probes = _begin(search, branch)
    if not begun:
        return None
    fits, problem, now, errors = search.fits, branch.problem, branch.now, branch.errors
    cfg, first = search.cfg, search.own.issuperset(now.model.effects)
    search.say(f"fitting {_names(list(begun))} on whole recordings")
    fitted = fits.coarse_to_fine(problem, list(begun.values()), rough)
    if cfg.has("widen_bounds"):
        fitted = beyond_bounds(fitted, lambda starts: fits.coarse_to_fine(problem, starts, rough), search.say)
    models = dict(zip(begun, fitted, strict=True))
    after = dict(zip(begun, fits.validation_errors(problem, fitted), strict=True))
    trials: list[list[Trial]] = [[] for _ in range(now.model.num_joints)]
    for effect, fitted_with in models.items():
        implausible = fitted_with.model.implausible(fitted_with.physical)[fitted_with.model.effects.index(effect)]
        for j in now.model.allowed_joints(effect).nonzero()[:, 0].tolist():
            own = fitted_with.physical[j, fitted_with.model.columns(effect)].tolist()
            values = dict(zip([p.name for p in effect.parameters], own, strict=True))
            score = max(float(probe.score[j]) for probe in probes if probe.effect is effect)
            trials[j].append(
                Trial(effect=effect, joint=j, screen_score=score, values=values, implausible=bool(implausible[j]))
            )
    return replace(round_of(search, trials, errors, after, first), models=models)


def round_of(
    search: Search,
    trials: Sequence[Sequence[Trial]],
    before: BlockErrors,
    after: Mapping[type[Effect], BlockErrors],
    first: bool,
    **facts: Any,
) -> Round:
    """What each joint takes of what was tried on it, and the decision in the log.

    Args:
        search: What is looked for.
        trials: Of each joint.
        before: The present model's errors.
        after: The errors with each effect.
        first: Whether the present model has no effect yet.
        facts: What the log needs beside.
    """
    tried, cfg = search.tried_over_joints, search.cfg.judging
    found = choose([[t.judged(before, after[t.effect], tried, first, cfg=cfg) for t in own] for own in trials], cfg=cfg)
    joints = [j for j, own in enumerate(trials) if own]
    made = Decision.of(
        "add",
        joints,
        before,
        {effect.name: own for effect, own in after.items()},
        {effect.name: [t.joint for own in trials for t in own if t.effect is effect] for effect in after},
        candidates=tried,
        first=first,
        implausible={
            effect.name: own
            for effect in after
            if (own := [p for p, j in enumerate(joints) for t in trials[j] if t.effect is effect and t.implausible])
        },
        **facts,
    )
    chosen = (found.chosen[j] for j in joints)
    search.log(replace(made, taken=[None if effect is None else effect.name for effect in chosen]))
    return found


def _begin(search: Search, branch: Branch) -> tuple[dict[type[Effect], Fitted], list[Probe]]:
    """Where refits with the promising effects start, and how all were screened."""
    fits, problem, now, errors, effects = search.fits, branch.problem, branch.now, branch.errors, search.effects
    cfg = search.cfg.candidates
    seen = fits.looked_at(problem.in_windows(), [replace(now, tried=None)])[0]
    probes = screen(fits, problem.coarse(), seen, effects, search.effort, cfg)
    excess = (errors.mse - search.at_floor**2).clamp(min=0.0)
    promising = _promising(probes, excess, cfg.explains)
    listed = with_likes(_short_list(promising, excess, search.at_floor, cfg), effects)
    far = bool((errors.mse.sqrt() > cfg.beyond_screening * search.floor).any())
    wide = search.own.issuperset(now.model.effects) or far
    always = [effect for effect in search.begun if effect in effects]
    begin = list(dict.fromkeys([*listed, *always, *(effects if wide else ())]))
    if not begin:
        return {}, probes
    search.say(f"fitting {f'{len(begin)} effects' if wide else _names(begin)} on windows")
    begun = _begun(search, branch, probes, begin, far and search.cfg.has("multistart"))
    if wide:
        gained = _short_list(_gained(begun), excess, search.at_floor, cfg)
        listed = with_likes([*gained, *listed[: cfg.from_screening]], effects)
    listed = list(dict.fromkeys([*listed, *always]))
    # where nothing is listed no effect does better than the base parameters alone
    return {effect: begun[effect] for effect in listed}, probes


def with_likes(listed: Sequence[type[Effect]], effects: Sequence[type[Effect]]) -> list[type[Effect]]:
    """Effects that are refitted, each followed by those among the candidates that act alike by construction."""
    alike = {e: [other for other in effects if other.name in e.twins or e.name in other.twins] for e in effects}
    return list(dict.fromkeys(each for effect in listed for each in (effect, *alike[effect])))


def beyond_bounds(
    fitted: Sequence[Fitted],
    refit: Callable[[list[Fitted]], list[Fitted]],
    say: Callable[[str], None],
) -> list[Fitted]:
    """The fits, those again that an effect's bound holds back, with bounds as wide as physics allows.

    Args:
        fitted: The present model with each effect.
        refit: Fits models from where they start.
        say: Shows how far it is.
    """
    result, stuck, starts = list(fitted), [], []
    for k, each in enumerate(fitted):
        effect = each.tried
        if effect is None or effect not in each.model.effects:
            continue
        joints = each.model.has_at_bounds(each.x)[each.model.effects.index(effect)]
        model = each.model.widened(effect, joints)
        if torch.equal(model.lower, each.model.lower) and torch.equal(model.upper, each.model.upper):
            continue
        stuck.append(k)
        starts.append(Fitted.start(model, each.physical, tried=effect))
    if starts:
        say(f"widening the bounds of {_names([start.tried for start in starts if start.tried is not None])}")
        for k, each in zip(stuck, refit(starts), strict=True):
            result[k] = each
    return result


def _promising(probes: Sequence[Probe], excess: torch.Tensor, least: float) -> dict[type[Effect], torch.Tensor]:
    """What each effect would explain of each joint's error, (n,) [rad²], by its best probe."""
    best: dict[type[Effect], torch.Tensor] = {}
    for probe in probes:
        best[probe.effect] = torch.maximum(best.get(probe.effect, probe.score), probe.score)
    return {effect: torch.where(score > least, score, 0.0) * excess for effect, score in best.items()}


def _short_list(
    explained: Mapping[type[Effect], torch.Tensor], excess: torch.Tensor, floor: torch.Tensor, cfg: CandidatesCfg
) -> list[type[Effect]]:
    """Effects that explain most of the robot's error, in floors, then those that explain most of the worst joints'.

    Args:
        explained: Squared error that each effect explains of each joint, (n,).
        excess: Squared error of each joint that could be explained, (n,); zero where there is nothing to find.
        floor: RMSE of each joint below which there is nothing to find, (n,).
        cfg: How many are wanted.
    """
    weight = (floor / floor.max()).nan_to_num(nan=1.0).clamp(min=_LEAST).square().reciprocal()
    total = {effect: float((values * weight)[excess > 0].sum()) for effect, values in explained.items()}
    wanted = sorted((e for e in total if total[e] > 0), key=lambda e: -total[e])[: cfg.of_robot]
    for j in (excess * weight).argsort(descending=True)[: cfg.of_joint].tolist():
        own = sorted((e for e in explained if explained[e][j] > 0), key=lambda e: -float(explained[e][j]))
        wanted += own[: cfg.of_joint]
    return list(dict.fromkeys(wanted))


def _begun(
    search: Search, branch: Branch, probes: Sequence[Probe], effects: Sequence[type[Effect]], far: bool
) -> dict[type[Effect] | None, Fitted]:
    """The present model with each effect after a few coarse steps, and without any (None).

    Each effect starts at every joint's best two probes, or the best of each structure that it can have; the better one
    goes on, joint by joint. Far from the floor the best of many points is another start.
    """
    fits, now, coarse, cfg = search.fits, branch.now, branch.problem.coarse(), search.cfg.candidates
    starts = [Fitted.start(now.model, now.physical)]
    for effect in effects:
        own = [probe for probe in probes if probe.effect is effect]
        ranked = [_ranked(own, j) for j in range(now.model.num_joints)]
        starts += [_start(now, effect, [best[k] for best in ranked], cfg) for k in range(len(ranked[0]))]
    if far:
        starts = _neighbours_together([*starts, *multistart(fits, coarse, now, effects, cfg)])
    result: dict[type[Effect] | None, Fitted] = {}
    for each in fits.side_by_side(coarse, starts, fits.cfg.again, part=fits.cfg.part):
        best = result.setdefault(each.tried, each)
        result[each.tried] = best.with_joints(each.score < best.score, each)
    return result


def _neighbours_together(starts: Sequence[Fitted]) -> list[Fitted]:
    """Starts of the same effect one after another: one effect then acts for all of them."""
    order = list(dict.fromkeys(start.tried for start in starts))
    return sorted(starts, key=lambda start: order.index(start.tried))


def _ranked(probes: Sequence[Probe], joint: int) -> list[Probe]:
    """A joint's best two probes of an effect, all of a comb, or the best of each structure."""
    ranked = sorted(probes, key=lambda probe: -float(probe.score[joint]))
    structural = probes[0].effect.structural
    if not structural:
        return ranked if probes[0].effect.comb else ranked[:2]
    place = [parameter.name for parameter in probes[0].effect.parameters].index(structural)
    best: dict[float, Probe] = {}
    for probe in ranked:
        best.setdefault(float(probe.values[joint, place]), probe)
    return list(best.values())


def _names(effects: Sequence[type[Effect]]) -> str:
    return listed([effect.name for effect in effects], _EFFECTS)


def _gained(begun: Mapping[type[Effect] | None, Fitted]) -> dict[type[Effect], torch.Tensor]:
    """By how much each effect has lowered each joint's squared error, (n,) [rad²]."""
    without = begun[None].score
    return {effect: (without - each.score).clamp(min=0.0) for effect, each in begun.items() if effect is not None}


def _start(now: Fitted, effect: type[Effect], probes: Sequence[Probe], cfg: CandidatesCfg) -> Fitted:
    """The present model with an effect at each joint's probe."""
    own = torch.stack([starts_of(probe, cfg)[j] for j, probe in enumerate(probes)])
    model, physical = now.model.extended(now.physical, effect, now.model.allowed_joints(effect), own)
    return Fitted.start(model.structure_held(effect, physical), physical, tried=effect)
