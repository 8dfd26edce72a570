"""What each joint takes by a rule, from a decision's numbers alone.

A diagnosis decides by these functions, and so does who reads its log: with the same numbers or others, in milliseconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from pace_actuators.effects import get_effect
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg, JudgingCfg
from pace_optim.diagnosis.selection.candidate_results import Trial
from pace_optim.diagnosis.selection.choice import choose
from pace_optim.diagnosis.selection.comparison import judge, within
from pace_optim.diagnosis.selection.decisions import Decision, Log, Taken
from pace_optim.diagnosis.selection.naming import Evidence, doubts
from pace_optim.joints.fits.block_errors import BlockErrors


def decide(
    rule: str,
    joints: Sequence[int],
    before: BlockErrors,
    after: Mapping[str, BlockErrors],
    on: Mapping[str, Sequence[int]] | None = None,
    *,
    cfg: DiagnosisCfg,
    log: Log,
    **facts: Any,
) -> dict[int, str]:
    """Decide and log; returns what joints take, by index. The other arguments are those of :meth:`Decision.of`."""
    made = Decision.of(rule, joints, before, after, on, **facts)
    made = replace(made, taken=decided(made, cfg))
    log(made)
    return made.taken_by


def decided(decision: Decision, cfg: DiagnosisCfg = DEFAULT) -> Taken:
    """What each joint of a decision takes by a configuration."""
    return _RULES[decision.rule](decision, cfg)


def _add(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """Each joint's best effect that pays."""
    facts, before = decision.facts, decision.before
    trials: list[list[Trial]] = [[] for _ in decision.joints]
    for name, after in decision.after.items():
        for place in decision.places(name):
            implausible = place in facts.get("implausible", {}).get(name, ())
            trial = Trial(effect=get_effect(name), joint=place, screen_score=0.0, values={}, implausible=implausible)
            trials[place].append(trial.judged(before, after, facts["candidates"], facts["first"], cfg=cfg.judging))
    return [None if effect is None else effect.name for effect in choose(trials, cfg=cfg.judging).chosen]


def _replace(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """The best of what a joint has and could have instead; among rivals the one that most joints want."""
    has, olds, joints = decision.facts["has"], decision.facts["olds"], decision.joints
    near: list[dict[str, float]] = []
    for place, j in enumerate(joints):
        here = [name for name in decision.after if place in decision.places(name)]
        options = {name: float(decision.after[name].mse[place]) for name in here}
        options |= {olds[name][str(j)]: float(decision.before.mse[place]) for name in here}
        least = min(options.values())
        alike = {name: mse for name, mse in options.items() if within(mse, least, cfg.judging.alike)}
        near.append({name: mse / max(least, 1e-300) for name, mse in alike.items()})
    wanted = Counter(name for options in near for name in options)
    wanted.update(name for j, own in enumerate(has) if j not in joints for name in own)
    used = Counter(name for own in has for name in own)
    total = {name: sum(options.get(name, 0.0) for options in near) for name in wanted}
    best = [min(options, key=lambda name: (-wanted[name], -used[name], total[name])) for options in near]
    return [name if str(j) in olds.get(name, {}) else None for j, name in zip(joints, best, strict=True)]


def _pool(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """One value for all joints, if their squared errors rise by no more than what is alike, in their mean.

    An error below its joint's floor counts as that floor.
    """
    ((name, after),) = decision.after.items()
    least = torch.tensor(decision.facts.get("floor", 0.0), dtype=torch.float64).square()
    rises = torch.maximum(after.mse, least) / torch.maximum(decision.before.mse, least)
    taken = within(float(rises.nan_to_num(nan=1.0).mean()), 1.0, cfg.judging.alike)
    return [name if taken else None for _ in decision.joints]


def _trim(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """The fit without some windows, where it is better."""
    ((name, after),) = decision.after.items()
    return [name if better else None for better in (after.mse < decision.before.mse).tolist()]


def _look_ahead(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """The next best effect, where it leads further than the best one."""
    facts = decision.facts
    ways = zip(facts["names"], facts["first"], facts["next"], strict=True)
    return [name if beats(other, first, cfg=cfg.judging) else None for name, first, other in ways]


def beats(way: Mapping[str, Any], other: Mapping[str, Any], *, cfg: JudgingCfg = DEFAULT.judging) -> bool:
    """Whether to go one way in place of another: for less error, or for as little with fewer parameters.

    Args:
        way: The names of the ``effects`` that a joint then has, and its ``mse`` on validation [rad²].
        other: The same.
        cfg: What is alike.
    """
    own, others = (sum(len(get_effect(name).parameters) for name in each["effects"]) for each in (way, other))
    if set(way["effects"]) == set(other["effects"]) or own > others:
        return not within(other["mse"], way["mse"], cfg.alike)
    return within(way["mse"], other["mse"], cfg.alike) if own < others else way["mse"] < other["mse"]


def _name(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """An effect whose name is earned."""
    (name,) = decision.after
    return [None if doubts(Evidence(**own), cfg=cfg) else name for own in decision.facts["evidence"]]


def _curves(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """A curve in place of a joint's effects, where it explains enough and leaves less: much less than named ones."""
    ((name, after),), facts = decision.after.items(), decision.facts
    pays = judge(decision.before, after, 0, facts["candidates"], facts["first"], cfg=cfg.judging).significant
    left, base = (max(0.0, mse - facts["floor"] ** 2) for mse in (float(after.mse), facts["base"]))
    says_more = left < (1.0 if facts["first"] else 1 - cfg.verdict.most) * facts["left"]
    return [name if pays and says_more and 1 - left / max(base, 1e-30) >= cfg.verdict.most else None]


_RULES: Mapping[str, Callable[[Decision, DiagnosisCfg], Taken]] = {
    "add": _add,
    "replace": _replace,
    "look_ahead": _look_ahead,
    "pool": _pool,
    "trim": _trim,
    "name": _name,
    "curves": _curves,
}
