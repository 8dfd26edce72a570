"""Adding effects one after another, each joint by itself, as long as they pay on validation recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.acceptance import BlockErrors, block_errors, judge
from pace_optim.diagnosis.descent import Fitted, fit_coarse_to_fine, fit_side_by_side
from pace_optim.diagnosis.model import start_values
from pace_optim.diagnosis.screening import Probe, screen, starts_of
from pace_optim.diagnosis.side_by_side import SideBySide, Slot
from pace_optim.joint_twins.problem import TwinProblem

SCREEN_THRESHOLD = 0.03
"""An effect that would explain less than this of what is left is not refitted."""
SHORT_LIST = 6
"""Effects refitted because they would explain most of the whole robot's error."""
WORST_JOINTS = 4
"""Joints whose own best candidates are refitted too."""
PER_JOINT = 4
"""How many of them."""
FAR_FROM_FLOOR = 50.0
"""An error that is this many times the floor is beyond what screening can judge: all effects are refitted."""
RIVAL = 1.10
"""Effects whose validation RMSE is within this factor of the best one's cannot be told apart from it."""
NEXT_FLOOR = 1.3
"""Nearer to the floor than this a further effect could not lower the error by as much as it must."""


@dataclass(kw_only=True, eq=False)
class Trial:
    """One effect, refitted on top of the present model, on one joint."""

    effect: type[Effect]
    joint: int
    screen_score: float
    mse_before: float
    """On validation [rad²]."""
    mse_after: float
    ratio: float
    """RMSE before / after."""
    t: float
    significant: bool
    values: dict[str, float]


@dataclass(kw_only=True, eq=False)
class Round:
    """What was tried on top of a model, joint by joint; each joint's list begins with its best."""

    trials: list[list[Trial]]
    chosen: list[type[Effect] | None]
    rivals: list[list[type[Effect]]]
    """For each joint, effects that do as well as the chosen one."""


@dataclass(kw_only=True, eq=False)
class Outcome:
    """Where the search ended."""

    base: Fitted
    base_errors: BlockErrors
    final: Fitted
    final_errors: BlockErrors
    rounds: list[Round] = field(default_factory=list)


def add_effects(
    problem: TwinProblem,
    base: Fitted,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    floor: torch.Tensor,
    max_effects: int,
    say: Callable[[str], None] = lambda _: None,
    renewed: Callable[[TwinProblem, Fitted], TwinProblem] = lambda problem, _: problem,
) -> Outcome:
    """Look for the effects that are missing.

    Args:
        problem: The joints simulated alone.
        base: The base model, fitted, with its Jacobian.
        effects: Candidates.
        effort: Typical torque of each joint, (n,) [N m].
        floor: Below this RMSE of each joint there is nothing to find, (n,) [rad].
        max_effects: Most effects of a joint.
        say: Shows how far it is.
        renewed: Gives the problem along the motion of the robot with the present model: a joint feels its neighbours.
    """
    now, errors = base, validation_errors(problem, [base])[0]
    outcome = Outcome(base=base, base_errors=errors, final=base, final_errors=errors)
    open_joints = torch.ones(base.model.num_joints, dtype=torch.bool)
    for depth in range(max_effects):
        open_joints &= errors.mse.sqrt() > (1.0 if depth == 0 else NEXT_FLOOR) * floor
        parted = any(e.parts_motor_and_link for e in now.model.effects)
        untried = [e for e in effects if e not in now.model.effects and not (parted and e.parts_motor_and_link)]
        if not bool(open_joints.any()) or not untried:
            break
        say(f"looking for effect {depth + 1}: screening {len(untried)} candidates")
        this = _try(problem, now, errors, untried, effort, floor, open_joints, say)
        if this is None:
            break
        found, fitted = this
        outcome.rounds.append(found)
        open_joints &= torch.tensor([effect is not None for effect in found.chosen])
        if not bool(open_joints.any()):
            break
        now = _combined(problem, now, found, fitted)
        along = renewed(problem, now)
        if along is not problem:
            problem = along
            now = fit_side_by_side(problem, [now], max_iteration=4, keep_jacobian=True)[0]
        errors = validation_errors(problem, [now])[0]
        outcome.final, outcome.final_errors = now, errors
    return outcome


def validation_errors(problem: TwinProblem, models: Sequence[Fitted]) -> list[BlockErrors]:
    """Errors of fitted models on the recordings that were not trained on."""
    slots = [Slot(model=m.model, own=m.own, rows=1) for m in models]
    batch = SideBySide(problem, slots, training=False)
    where = batch.dataset.validation
    every = torch.zeros_like(where)
    every[: batch.dataset.last_step(where)] = True
    errors = batch.simulate([m.model.to_physical(m.x)[None] for m in models], every)
    return [block_errors(error, where[: errors.shape[1]], problem.control_dt) for error in errors]


def _try(
    problem: TwinProblem,
    now: Fitted,
    errors: BlockErrors,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    floor: torch.Tensor,
    open_joints: torch.Tensor,
    say: Callable[[str], None],
) -> tuple[Round, dict[type[Effect], Fitted]] | None:
    probes = screen(problem.with_physics_dt(problem.control_dt), now, effects, effort)
    excess = torch.where(open_joints, (errors.mse - floor**2).clamp(min=0.0), 0.0)
    best = _best_probes(probes, excess, bool((errors.mse.sqrt() > FAR_FROM_FLOOR * floor).any()))
    if not best:
        return None
    say(f"refitting with {', '.join(effect.name for effect in best)}")
    starts = [_start(now, effect, chosen) for effect, lists in best.items() for chosen in lists]
    fitted = fit_coarse_to_fine(problem, _better_starts(problem, starts))
    blocks = validation_errors(problem, fitted)
    n = now.model.num_joints
    first = not now.model.effects
    tried = len(effects) * int(open_joints.sum())
    trials: list[list[Trial]] = [[] for _ in range(n)]
    keep: dict[type[Effect], Fitted] = {}
    for effect in best:
        own = [(f, b) for f, b in zip(fitted, blocks, strict=True) if f.own is effect]
        chosen, after = own[0]
        for j in range(n):
            if not bool(open_joints[j]):
                continue
            verdict = judge(errors, after, j, tried, first)
            values = chosen.model.to_physical(chosen.x)[j, chosen.model.columns(effect)].tolist()
            trials[j].append(
                Trial(
                    effect=effect,
                    joint=j,
                    screen_score=max(float(p.score[j]) for p in probes if p.effect is effect),
                    mse_before=float(errors.mse[j]),
                    mse_after=float(after.mse[j]),
                    ratio=verdict.ratio,
                    t=verdict.t,
                    significant=verdict.significant,
                    values=dict(zip([p.name for p in effect.parameters], values, strict=True)),
                )
            )
        keep[effect] = chosen
    chosen_effects, rivals = _choose(trials)
    return Round(trials=trials, chosen=chosen_effects, rivals=rivals), keep


def _best_probes(
    probes: Sequence[Probe], excess: torch.Tensor, everything: bool
) -> dict[type[Effect], list[list[Probe]]]:
    """Effects worth a refit, each with one or two starts: for every joint its best probe, and its second best.

    Args:
        probes: What was screened.
        excess: Squared error of each joint that could be explained, (n,) [rad²]; zero where there is nothing to find.
        everything: Whether all effects are refitted: what small changes do says little of a large error.
    """
    n = len(excess)
    by_effect: dict[type[Effect], list[Probe]] = {}
    for probe in probes:
        by_effect.setdefault(probe.effect, []).append(probe)
    scores = {effect: torch.stack([p.score for p in own]).max(dim=0).values for effect, own in by_effect.items()}
    promising = {e: torch.where(s > SCREEN_THRESHOLD, s, 0.0) * excess for e, s in scores.items()}
    wanted: dict[type[Effect], None] = {}
    # what explains most of the whole robot's error, then what explains most of the worst joints'
    total = sorted((e for e in promising if promising[e].sum() > 0), key=lambda e: -float(promising[e].sum()))
    wanted.update(dict.fromkeys(total[:SHORT_LIST]))
    for j in excess.argsort(descending=True)[:WORST_JOINTS].tolist():
        own = sorted((e for e in promising if promising[e][j] > 0), key=lambda e: -float(promising[e][j]))
        wanted.update(dict.fromkeys(own[:PER_JOINT]))
    if everything:
        wanted.update(dict.fromkeys(by_effect))
    result = {}
    for effect in wanted:
        ranked = [sorted(by_effect[effect], key=lambda p: -float(p.score[j])) for j in range(n)]
        count = min(2, len(by_effect[effect]))
        result[effect] = [[ranked[j][k] for j in range(n)] for k in range(count)]
    return result


def _better_starts(problem: TwinProblem, starts: Sequence[Fitted]) -> list[Fitted]:
    """Of the starts of each effect, the one that is better after a few coarse steps, joint by joint."""
    fitted = fit_side_by_side(problem.with_physics_dt(problem.control_dt), starts, max_iteration=4, part=0.4)
    result: dict[type[Effect], Fitted] = {}
    for each in fitted:
        if each.own is None:
            continue
        best = result.setdefault(each.own, each)
        better = each.score < best.score
        best.x[better], best.score[better] = each.x[better], each.score[better]
    return list(result.values())


def _start(now: Fitted, effect: type[Effect], probes: Sequence[Probe]) -> Fitted:
    """The present model with an effect at each joint's probe."""
    n = now.model.num_joints
    model = now.model.with_effect(effect, torch.ones(n, dtype=torch.bool))
    own = torch.stack([starts_of(probe)[j] for j, probe in enumerate(probes)])
    x = model.to_normalised(torch.cat([now.model.to_physical(now.x), own], dim=1))
    return Fitted(model=model, own=effect, x=x, score=torch.full((n,), torch.inf, dtype=torch.float64))


def _choose(trials: list[list[Trial]]) -> tuple[list[type[Effect] | None], list[list[type[Effect]]]]:
    """Each joint's best significant effect; among rivals, the one that most joints want."""
    wanted: dict[type[Effect], int] = {}
    near: list[list[Trial]] = []
    for own in trials:
        own.sort(key=lambda t: t.mse_after)
        good = [t for t in own if t.significant]
        close = [t for t in good if t.mse_after <= good[0].mse_after * RIVAL**2] if good else []
        near.append(close)
        for trial in close:
            wanted[trial.effect] = wanted.get(trial.effect, 0) + 1
    chosen: list[type[Effect] | None] = []
    rivals: list[list[type[Effect]]] = []
    for close in near:
        if not close:
            chosen.append(None)
            rivals.append([])
            continue
        best = min(close, key=lambda t: (-wanted[t.effect], t.mse_after))
        chosen.append(best.effect)
        rivals.append([t.effect for t in close if t.effect is not best.effect])
    return chosen, rivals


def _combined(problem: TwinProblem, now: Fitted, found: Round, fitted: dict[type[Effect], Fitted]) -> Fitted:
    """The present model with each joint's chosen effect, refitted unless all joints chose the same."""
    if len(set(found.chosen)) == 1 and found.chosen[0] is not None:
        return replace(fitted[found.chosen[0]], own=None)
    model, n = now.model, now.model.num_joints
    physical = model.to_physical(now.x)
    for effect in dict.fromkeys(e for e in found.chosen if e is not None):
        has = torch.tensor([e is effect for e in found.chosen])
        source = fitted[effect]
        values = source.model.to_physical(source.x)
        model = model.with_effect(effect, has)
        physical = torch.cat([physical, start_values(effect, {}).repeat(n, 1)], dim=1)
        physical[has, model.columns(effect)] = values[has][:, source.model.columns(effect)]
        physical[has, : now.model.size] = values[has, : now.model.size]
    start = Fitted(
        model=model, own=None, x=model.to_normalised(physical), score=torch.full((n,), torch.inf, dtype=torch.float64)
    )
    return fit_side_by_side(problem, [start], max_iteration=6, keep_jacobian=True)[0]
