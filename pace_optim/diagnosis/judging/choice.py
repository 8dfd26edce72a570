"""Which of the effects that were tried each joint takes, from their errors alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, JudgingCfg
from pace_optim.diagnosis.judging.candidate_results import Trial
from pace_optim.diagnosis.judging.comparison import within


def contenders(
    trials: Sequence[Sequence[Trial]], floor: torch.Tensor, *, cfg: JudgingCfg = DEFAULT.judging
) -> list[list[type[Effect]]]:
    """Of each joint, effects between which the error alone does not decide: near to each other, and far from the floor.

    Args:
        trials: Of each joint.
        floor: Of each joint, (n,) [rad].
        cfg: What is near, and what is far.
    """
    found: list[list[type[Effect]]] = []
    for own, least in zip(trials, floor.tolist(), strict=True):
        # where none is significant, what is weighed is not chosen, but told first
        pool = [trial for trial in own if trial.significant] or [trial for trial in own if trial.ratio >= cfg.alike]
        near = _near(pool, cfg.weighed)
        alike = len(near) > 1 and not within(near[0].mse_after, least**2, cfg.far)
        found.append([trial.effect for trial in near] if alike else [])
    return found


def _near(trials: Sequence[Trial], ratio: float) -> list[Trial]:
    """A joint's best trials, up to a ratio of the best one's RMSE, best first."""
    ordered = sorted(trials, key=lambda trial: trial.mse_after)
    return [trial for trial in ordered if within(trial.mse_after, ordered[0].mse_after, ratio)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """What each joint takes."""

    trials: list[list[Trial]]
    """Of each joint: those that were weighed by their evidence, then the others by their error."""
    chosen: list[type[Effect] | None]
    rivals: list[list[type[Effect]]]
    """Of each joint, effects that do as well as the chosen one."""


def choose(
    trials: Sequence[Sequence[Trial]],
    evidence: Sequence[Mapping[type[Effect], float]],
    *,
    cfg: JudgingCfg = DEFAULT.judging,
) -> Choice:
    """Each joint's best significant effect; among rivals, the one that most joints want, and the simplest.

    Where rivals were weighed, the one with the most evidence in place of the simplest.

    Args:
        trials: Of each joint.
        evidence: Of each joint, the log evidence of effects that were weighed.
        cfg: What is alike.
    """
    wanted: dict[type[Effect], int] = {}
    near: list[list[Trial]] = []
    ordered: list[list[Trial]] = []
    refused = _worse_for_the_robot(trials)
    for every, known in zip(trials, evidence, strict=True):
        own = sorted(every, key=lambda t: (-known.get(t.effect, -math.inf), t.mse_after))
        ordered.append(own)
        good = [t for t in own if t.significant and t.effect not in refused]
        weighed = [t for t in good if t.effect in known]
        close = weighed if len(weighed) > 1 else _near(good, cfg.alike)
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
        best = max(left, key=lambda t: known[t.effect]) if are_weighed else _simplest(left, cfg.as_good)
        chosen.append(best.effect)
        alike = [t.effect for t in close if within(t.mse_after, best.mse_after, cfg.alike)]
        rivals.append([effect for effect in alike if effect is not best.effect])
    return Choice(trials=ordered, chosen=chosen, rivals=rivals)


def _simplest(trials: Sequence[Trial], ratio: float) -> Trial:
    """The best trial of a joint, or one with fewer parameters that is as good."""
    least = min(t.mse_after for t in trials)
    alike = [t for t in trials if within(t.mse_after, least, ratio)]
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
