"""One round of the search: what could be missing beside a model, screened, begun, refitted and judged."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.candidates.evidence import log_evidence
from pace_optim.diagnosis.candidates.multistart import far_starts
from pace_optim.diagnosis.candidates.screening import Probe, screen, starts_of
from pace_optim.diagnosis.fitting.coarse_to_fine import fit_coarse_to_fine, fit_side_by_side
from pace_optim.diagnosis.judging.acceptance import FIRST_RATIO, BlockErrors
from pace_optim.diagnosis.judging.candidate_results import ALIKE, FAR, RIVAL, Round, Trial
from pace_optim.diagnosis.judging.validation import validation_errors
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.single_joint_model.problem import TwinProblem

SCREEN_THRESHOLD = 0.03
"""An effect that would explain less than this of what is left is not refitted."""
SHORT_LIST = 6
"""Effects refitted because they would explain most of the whole robot's error."""
WORST_JOINTS = 4
"""Joints whose own best candidates are refitted too."""
PER_JOINT = 4
"""How many of them."""
FROM_SCREENING = 2
"""How many of the best screened go on in any case, where refits began with all effects."""
_PART, _ITERATIONS = 0.7, 6
"""Of each window, and how far, where refits begin: after four, what needs another derivative gain too is far behind."""
CONTENDERS = 1.15
"""Where more than one effect is missing, the main one may be any whose validation RMSE is within this factor of the
best."""
FAR_FROM_FLOOR = 50.0
"""An error that is this many times the floor is beyond what screening can judge: refits begin with all effects, as they
do for the first one."""


def try_effects(
    problem: TwinProblem,
    now: Fitted,
    errors: BlockErrors,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    floor: torch.Tensor,
    say: Callable[[str], None],
    rough: bool = False,
) -> Round | None:
    """Screen effects, refit the promising ones on top of a model, and judge them; ``None`` if none is promising.

    Args:
        problem: The joints simulated alone.
        now: The present model.
        errors: Its errors.
        effects: Candidates.
        effort: Typical torque of each joint, (n,) [N m].
        floor: Below this RMSE of each joint there is nothing to find, (n,) [rad].
        say: Shows how far it is.
        rough: Whether refits go on over wide steps.
    """
    start = Fitted.start(now.model, now.model.to_physical(now.x))
    # one iteration stays where it is, and sees the errors and their derivatives in windows
    seen = fit_side_by_side(problem.in_windows(), [start], max_iteration=1, keep_jacobian=True)[0]
    probes = screen(problem.coarse(), seen, effects, effort)
    excess = (errors.mse - floor**2).clamp(min=0.0)
    listed = with_likes(_short_list(_promising(probes, excess), excess), effects)
    first = not now.model.effects
    far = bool((errors.mse.sqrt() > FAR_FROM_FLOOR * floor).any())
    wide = first or far
    begin = list(dict.fromkeys([*listed, *(effects if wide else ())]))
    if not begin:
        return None
    say(f"beginning with {len(begin)} of them" if wide else f"beginning with {_names(begin)}")
    begun = _begun(problem, now, probes, begin, far)
    if wide:
        listed = with_likes([*_short_list(_gained(begun), excess), *listed[:FROM_SCREENING]], effects)
    if not listed:  # no effect does better than the base parameters alone
        return None
    say(f"refitting with {_names(listed)}")
    fitted = fit_coarse_to_fine(problem, [begun[effect] for effect in listed], rough)
    fitted = beyond_bounds(fitted, lambda starts: fit_coarse_to_fine(problem, starts, rough), say)
    blocks = validation_errors(problem, fitted)
    n = now.model.num_joints
    tried = len(effects) * n
    trials: list[list[Trial]] = [[] for _ in range(n)]
    keep: dict[type[Effect], Fitted] = {}
    for effect, chosen, after in zip(listed, fitted, blocks, strict=True):
        for j in now.model.may_get(effect).nonzero()[:, 0].tolist():
            values = chosen.model.to_physical(chosen.x)[j, chosen.model.columns(effect)].tolist()
            trial = Trial(
                effect=effect,
                joint=j,
                screen_score=max(float(p.score[j]) for p in probes if p.effect is effect),
                values=dict(zip([p.name for p in effect.parameters], values, strict=True)),
            )
            trials[j].append(trial.judged(errors, after, tried, first))
        keep[effect] = chosen
    contenders, evidence = _contenders(trials, floor), {}
    if weighed := list(dict.fromkeys(effect for own in contenders for effect in own)):
        say(f"weighing {_names(weighed)}")
        evidence = log_evidence(problem, {effect: keep[effect] for effect in weighed}, effects, effort)
    chosen_effects, rivals = _choose(
        trials, [{effect: float(evidence[effect][j]) for effect in own} for j, own in enumerate(contenders)]
    )
    return Round(trials=trials, chosen=chosen_effects, rivals=rivals, models=keep)


def with_likes(listed: Sequence[type[Effect]], effects: Sequence[type[Effect]]) -> list[type[Effect]]:
    """Effects that are refitted, each followed by those among the candidates that act alike by construction."""
    alike = {e: [other for other in effects if other.name in e.twins or e.name in other.twins] for e in effects}
    return list(dict.fromkeys(each for effect in listed for each in (effect, *alike[effect])))


def beyond_bounds(
    fitted: Sequence[Fitted], refit: Callable[[list[Fitted]], list[Fitted]], say: Callable[[str], None]
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
        joints = each.model.at_bounds(each.x)[each.model.effects.index(effect)]
        model = each.model.widened(effect, joints)
        if torch.equal(model.lower, each.model.lower) and torch.equal(model.upper, each.model.upper):
            continue
        stuck.append(k)
        starts.append(Fitted.start(model, each.model.to_physical(each.x), tried=effect))
    if starts:
        say(f"widening the bounds of {_names([start.tried for start in starts if start.tried is not None])}")
        for k, each in zip(stuck, refit(starts), strict=True):
            result[k] = each
    return result


def _promising(probes: Sequence[Probe], excess: torch.Tensor) -> dict[type[Effect], torch.Tensor]:
    """What each effect would explain of each joint's error, (n,) [rad²], by its best probe."""
    best: dict[type[Effect], torch.Tensor] = {}
    for probe in probes:
        best[probe.effect] = torch.maximum(best.get(probe.effect, probe.score), probe.score)
    return {effect: torch.where(score > SCREEN_THRESHOLD, score, 0.0) * excess for effect, score in best.items()}


def _short_list(explained: Mapping[type[Effect], torch.Tensor], excess: torch.Tensor) -> list[type[Effect]]:
    """Effects that explain most of the whole robot's error, then those that explain most of the worst joints'.

    Args:
        explained: Squared error that each effect explains of each joint, (n,).
        excess: Squared error of each joint that could be explained, (n,); zero where there is nothing to find.
    """
    total = {effect: float(values[excess > 0].sum()) for effect, values in explained.items()}
    wanted = sorted((e for e in total if total[e] > 0), key=lambda e: -total[e])[:SHORT_LIST]
    for j in excess.argsort(descending=True)[:WORST_JOINTS].tolist():
        own = sorted((e for e in explained if explained[e][j] > 0), key=lambda e: -float(explained[e][j]))
        wanted += own[:PER_JOINT]
    return list(dict.fromkeys(wanted))


def _begun(
    problem: TwinProblem, now: Fitted, probes: Sequence[Probe], effects: Sequence[type[Effect]], far: bool
) -> dict[type[Effect] | None, Fitted]:
    """The present model with each effect after a few coarse steps, and without any (None).

    Each effect starts at every joint's best two probes, or the best of each structure that it can have; the better one
    goes on, joint by joint. Far from the floor the best of many points is another start.
    """
    coarse = problem.coarse()
    starts = [Fitted.start(now.model, now.model.to_physical(now.x))]
    for effect in effects:
        own = [probe for probe in probes if probe.effect is effect]
        ranked = [_ranked(own, j) for j in range(now.model.num_joints)]
        starts += [_start(now, effect, [best[k] for best in ranked]) for k in range(len(ranked[0]))]
    if far:
        starts = _neighbours_together([*starts, *far_starts(coarse, now, effects)])
    result: dict[type[Effect] | None, Fitted] = {}
    for each in fit_side_by_side(coarse, starts, max_iteration=_ITERATIONS, part=_PART):
        best = result.setdefault(each.tried, each)
        best.take(each, each.score < best.score)
    return result


def _neighbours_together(starts: Sequence[Fitted]) -> list[Fitted]:
    """Starts of the same effect one after another: one effect then acts for all of them."""
    order = list(dict.fromkeys(start.tried for start in starts))
    return sorted(starts, key=lambda start: order.index(start.tried))


def _ranked(probes: Sequence[Probe], joint: int) -> list[Probe]:
    """A joint's best two probes of an effect, or the best of each structure."""
    ranked = sorted(probes, key=lambda probe: -float(probe.score[joint]))
    structural = probes[0].effect.structural
    if not structural:
        return ranked[:2]
    place = [parameter.name for parameter in probes[0].effect.parameters].index(structural)
    best: dict[float, Probe] = {}
    for probe in ranked:
        best.setdefault(float(probe.values[joint, place]), probe)
    return list(best.values())


def _names(effects: Sequence[type[Effect]]) -> str:
    return ", ".join(effect.name for effect in effects)


def _gained(begun: Mapping[type[Effect] | None, Fitted]) -> dict[type[Effect], torch.Tensor]:
    """By how much each effect has lowered each joint's squared error, (n,) [rad²]."""
    without = begun[None].score
    return {effect: (without - each.score).clamp(min=0.0) for effect, each in begun.items() if effect is not None}


def _start(now: Fitted, effect: type[Effect], probes: Sequence[Probe]) -> Fitted:
    """The present model with an effect at each joint's probe."""
    own = torch.stack([starts_of(probe)[j] for j, probe in enumerate(probes)])
    physical = now.model.to_physical(now.x)
    model, physical = now.model.extended(physical, effect, now.model.may_get(effect), own)
    return Fitted.start(model.structure_held(effect, physical), physical, tried=effect)


def _contenders(trials: Sequence[Sequence[Trial]], floor: torch.Tensor) -> list[list[type[Effect]]]:
    """Of each joint, effects between which the error alone does not decide: near to each other, and far from the floor.

    Args:
        trials: Of each joint.
        floor: Of each joint, (n,) [rad].
    """
    found: list[list[type[Effect]]] = []
    for own, least in zip(trials, floor.tolist(), strict=True):
        # where none is significant, what is weighed is not chosen, but told first
        pool = [trial for trial in own if trial.significant] or [trial for trial in own if trial.ratio >= FIRST_RATIO]
        near = _near(pool, CONTENDERS)
        alike = len(near) > 1 and near[0].mse_after > (FAR * least) ** 2
        found.append([trial.effect for trial in near] if alike else [])
    return found


def _near(trials: Sequence[Trial], factor: float) -> list[Trial]:
    """A joint's best trials, up to a factor of the best one's RMSE, best first."""
    ordered = sorted(trials, key=lambda trial: trial.mse_after)
    return [trial for trial in ordered if trial.mse_after <= ordered[0].mse_after * factor**2]


def _choose(
    trials: list[list[Trial]], evidence: Sequence[Mapping[type[Effect], float]]
) -> tuple[list[type[Effect] | None], list[list[type[Effect]]]]:
    """Each joint's best significant effect; among rivals, the one that most joints want, and the simplest.

    Where rivals were weighed, the one with the most evidence in place of the simplest.

    Args:
        trials: Of each joint; ordered here: those that were weighed by their evidence, then the others by their error.
        evidence: Of each joint, the log evidence of effects that were weighed.
    """
    wanted: dict[type[Effect], int] = {}
    near: list[list[Trial]] = []
    refused = _worse_for_the_robot(trials)
    for own, known in zip(trials, evidence, strict=True):
        own.sort(key=lambda t: (-known.get(t.effect, -math.inf), t.mse_after))
        good = [t for t in own if t.significant and t.effect not in refused]
        weighed = [t for t in good if t.effect in known]
        close = weighed if len(weighed) > 1 else _near(good, RIVAL)
        near.append(close)
        for trial in close:
            wanted[trial.effect] = wanted.get(trial.effect, 0) + 1
    chosen: list[type[Effect] | None] = []
    rivals: list[list[type[Effect]]] = []
    for close, known in zip(near, evidence, strict=True):
        if not close:
            chosen.append(None)
            rivals.append([])
            continue
        most = max(wanted[t.effect] for t in close)
        left = [t for t in close if wanted[t.effect] == most]
        are_weighed = all(trial.effect in known for trial in left)
        best = max(left, key=lambda t: known[t.effect]) if are_weighed else _simplest(left)
        chosen.append(best.effect)
        most_alike = RIVAL**2 * best.mse_after
        rivals.append([t.effect for t in close if t.effect is not best.effect and t.mse_after <= most_alike])
    return chosen, rivals


def _simplest(trials: Sequence[Trial]) -> Trial:
    """The best trial of a joint, or one with fewer numbers that is as good."""
    least = min(t.mse_after for t in trials)
    alike = [t for t in trials if t.mse_after <= ALIKE**2 * least]
    return min(alike, key=lambda t: (len(t.effect.parameters), t.mse_after))


def _worse_for_the_robot(trials: Sequence[Sequence[Trial]]) -> set[type[Effect]]:
    """Effects that all joints share by their nature, and that leave more over all joints than effects of their own."""
    good = [[trial for trial in own if trial.significant] for own in trials if own]
    before = [own[0].mse_before for own in trials if own]

    def left(effects: set[type[Effect]]) -> float:
        """Squared error over all joints with the best of some effects."""
        return sum(
            min([without, *(t.mse_after for t in own if t.effect in effects)])
            for own, without in zip(good, before, strict=True)
        )

    found = {trial.effect for own in good for trial in own}
    shared = {effect for effect in found if effect.shared}
    return {effect for effect in shared if left({effect}) > left(found - shared)}
