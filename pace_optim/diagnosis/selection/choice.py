"""Which of the effects that were tried each joint takes, from their errors alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, JudgingCfg
from pace_optim.diagnosis.selection.candidate_results import Round, Trial
from pace_optim.diagnosis.selection.comparison import within


def _near(trials: Sequence[Trial], ratio: float) -> list[Trial]:
    """Of a joint's trials, best first, those up to a ratio of the best one's RMSE."""
    return [trial for trial in trials if within(trial.mse_after, trials[0].mse_after, ratio)]


def choose(trials: Sequence[Sequence[Trial]], *, cfg: JudgingCfg = DEFAULT.judging) -> Round:
    """Each joint's best significant effect; among rivals, the one that most joints want, and the simplest.

    Effects that leave as little error are alike as far as a drive can have their sizes: one of a size that no drive has
    is no rival of those.

    Args:
        trials: Of each joint.
        cfg: What is alike.
    """
    refused = _worse_for_the_robot(trials)
    ordered = [sorted(own, key=lambda trial: trial.mse_after) for own in trials]
    near = [_near([t for t in own if t.significant and t.effect not in refused], cfg.alike) for own in ordered]
    near = [[trial for trial in close if not trial.implausible] or close for close in near]
    wanted = Counter(trial.effect for close in near for trial in close)
    chosen: list[type[Effect] | None] = [None] * len(near)
    rivals: list[list[type[Effect]]] = [[] for _ in near]
    for j, close in enumerate(near):
        if close:
            most = max(wanted[trial.effect] for trial in close)
            best = min((t for t in close if wanted[t.effect] == most), key=_parameters_and_error)
            alike = [trial.effect for trial in close if within(trial.mse_after, best.mse_after, cfg.alike)]
            chosen[j], rivals[j] = best.effect, [effect for effect in alike if effect is not best.effect]
    return Round(trials=ordered, chosen=chosen, rivals=rivals)


def _parameters_and_error(trial: Trial) -> tuple[int, float]:
    return len(trial.effect.parameters), trial.mse_after


def _worse_for_the_robot(trials: Sequence[Sequence[Trial]]) -> set[type[Effect]]:
    """Effects that all joints share by nature, and that leave more error than separate effects."""
    good = [[trial for trial in own if trial.significant] for own in trials if own]
    before = [own[0].mse_before for own in trials if own]

    def left(effects: set[type[Effect]]) -> float:
        """Part of its squared error that the best of some effects leaves on each joint, summed."""
        return sum(
            min([1.0, *(t.mse_after / without for t in own if t.effect in effects)])
            for own, without in zip(good, before, strict=True)
        )

    found = {trial.effect for own in good for trial in own}
    shared = {effect for effect in found if effect.shared}
    return {effect for effect in shared if left({effect}) > left(found - shared)}
