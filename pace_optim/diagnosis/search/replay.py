"""A decision made again from its numbers, with today's comparison or another one: nothing is simulated."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch

from pace_actuators.effects import Effect, get_effect
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.fitting.validation import BlockErrors
from pace_optim.diagnosis.judging.candidate_results import Trial
from pace_optim.diagnosis.judging.choice import choose
from pace_optim.diagnosis.judging.comparison import judge, within
from pace_optim.diagnosis.judging.decisions import Decision
from pace_optim.diagnosis.search.look_ahead import End

Taken = list[str | None]


def replayed(decision: Decision, cfg: DiagnosisCfg = DEFAULT) -> Taken:
    """What each joint of a decision takes by a configuration; as it was taken where the rule cannot be made again.

    What joints took in place of another effect also hangs on what the others have, which the numbers do not say.
    """
    again = _RULES.get(decision.rule)
    return decision.taken if again is None else again(decision, cfg)


def _add(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    facts, before = decision.facts, _errors(decision, decision.before)
    trials: list[list[Trial]] = [[] for _ in decision.joints]
    for name in decision.after:
        for place, after in _where(decision, name).items():
            trial = Trial(effect=get_effect(name), joint=place, screen_score=0.0, values={})
            trials[place].append(trial.judged(before, after, facts["candidates"], facts["first"], cfg=cfg.judging))
    evidence: list[dict[type[Effect], float]] = [
        {get_effect(name): value for name, value in own.items()} for own in facts["evidence"]
    ]
    return [None if effect is None else effect.name for effect in choose(trials, evidence, cfg=cfg.judging).chosen]


def _drop(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """What each joint does best without, where it is as good without it."""
    result: Taken = []
    for place, least in enumerate(_least(decision)):
        now = float(_errors(decision, decision.before).mse[place])
        left = float(_where(decision, least)[place].mse[place])
        result.append(least if within(left, now, cfg.judging.as_good) else None)
    return result


def _drop_last(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """What each joint does best without, where it does not pay."""
    return [None if _pays(decision, name, place, cfg) else name for place, name in enumerate(_least(decision))]


def _merge(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    enough = {n: [p for p in _where(decision, n) if not _pays(decision, n, p, cfg)] for n in decision.after}
    result: Taken = []
    for place in range(len(decision.joints)):
        fitting = [name for name, places in enough.items() if place in places]
        mse = {name: float(_where(decision, name)[place].mse[place]) for name in fitting}
        result.append(min(fitting, key=lambda name: (-len(enough[name]), mse[name]), default=None))
    return result


def _pool(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    (name,) = decision.after
    after, before = (_errors(decision, own) for own in (decision.after[name], decision.before))
    taken = within(float(after.mse.sum()), float(before.mse.sum()), cfg.judging.as_good)
    return [name if taken else None for _ in decision.joints]


def _trim(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    (name,) = decision.after
    after, before = (_errors(decision, own).mse for own in (decision.after[name], decision.before))
    return [name if better else None for better in (after < before).tolist()]


def _look_ahead(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    pairs = zip(decision.facts["first"], decision.facts["next"], strict=True)
    better = [_end(two).beats(_end(one), cfg=cfg.judging) for one, two in pairs]
    return [name or "" if yes else None for name, yes in zip(decision.taken, better, strict=True)]


def _together(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    """An effect on several joints, held against them without it."""
    (name,) = decision.after
    before, after = _errors(decision, decision.before), _errors(decision, decision.after[name])
    tried = decision.facts["candidates"]
    every = range(len(decision.joints))
    pays = [judge(before, after, place, tried, first=False, cfg=cfg.judging).significant for place in every]
    return [name if yes else None for yes in pays]


def _curves(decision: Decision, cfg: DiagnosisCfg) -> Taken:
    (name,), facts = decision.after, decision.facts
    before, after = _errors(decision, decision.before), _errors(decision, decision.after[name])
    pays = judge(before, after, 0, facts["candidates"], facts["first"], cfg=cfg.judging).significant
    left, base = (max(0.0, mse - facts["floor"][0] ** 2) for mse in (float(after.mse), facts["base"][0]))
    says_more = facts["first"] or left < cfg.verdict.most * facts["left"][0]
    explains = 1 - left / max(base, 1e-30) >= cfg.verdict.most
    return [name if pays and says_more and explains else None]


def _errors(decision: Decision, square: list[list[float]] | list[list[float] | None]) -> BlockErrors:
    return BlockErrors(
        square=torch.tensor(square, dtype=torch.float64).T, weight=torch.tensor(decision.weight, dtype=torch.float64)
    )


def _where(decision: Decision, name: str) -> Mapping[int, BlockErrors]:
    """Errors with what was tried on each joint that it was tried on, by place; the others' are the present ones."""
    tried = decision.after[name]
    every = [before if own is None else own for own, before in zip(tried, decision.before, strict=True)]
    errors = _errors(decision, every)
    return {place: errors for place, own in enumerate(tried) if own is not None}


def _least(decision: Decision) -> list[str]:
    """For each joint, that of what was tried which leaves the least error."""
    mse = [
        {name: float(_where(decision, name)[place].mse[place]) for name, own in decision.after.items() if own[place]}
        for place in range(len(decision.joints))
    ]
    return [min(own, key=own.__getitem__) for own in mse]


def _pays(decision: Decision, without: str, place: int, cfg: DiagnosisCfg) -> bool:
    """Whether what the present model has pays beside what was tried in place of it, or without it."""
    now, tried = _errors(decision, decision.before), decision.facts["candidates"]
    return judge(_where(decision, without)[place], now, place, tried, first=False, cfg=cfg.judging).significant


def _end(told: Mapping) -> End:
    return End(effects=frozenset(get_effect(name) for name in told["effects"]), mse=told["mse"])


_RULES: Mapping[str, Callable[[Decision, DiagnosisCfg], Taken]] = {
    "add": _add,
    "drop": _drop,
    "drop_last": _drop_last,
    "merge": _merge,
    "pool": _pool,
    "trim": _trim,
    "look_ahead": _look_ahead,
    "add_to_group": _together,
    "add_pair": _together,
    "curves": _curves,
}
