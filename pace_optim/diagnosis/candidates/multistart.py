"""Where to start a refit when the base model is far off: its parameters are then proxies for what is missing."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_actuators.effects import Effect, probe_points
from pace_optim.diagnosis.diagnosis_cfg import CandidatesCfg
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import COLUMN, JointModel
from pace_optim.joints.fits.side_by_side import Slot
from pace_optim.joints.simulation.problem import TwinProblem


def multistart(
    fits: Fits, problem: TwinProblem, now: Fitted, effects: Sequence[type[Effect]], cfg: CandidatesCfg
) -> list[Fitted]:
    """For each effect the best of many points, joint by joint: its probes, with other base parameters too.

    Of a stiff effect, the best point of each probe is kept. There the error at a point says little about where a
    descent from it ends: another stiffness has another resonance, and no descent leads from one to the other. Each
    point is simulated once, on the beginning of each window of the training recordings.

    Args:
        fits: Fits models.
        problem: The joints simulated alone, coarsely.
        now: The present model.
        effects: What is tried.
        cfg: From which base parameters.
    """
    effects = [effect for effect in effects if effect.comb is None]  # a screening has scanned it
    starts = fits.shared_out(lambda own: _best_points(fits, problem, now, own, cfg), effects, effects)
    return [start for of_effect in starts for start in of_effect]


def _best_points(
    fits: Fits, problem: TwinProblem, now: Fitted, effects: Sequence[type[Effect]], cfg: CandidatesCfg
) -> list[list[Fitted]]:
    """:func:`multistart` in one process."""
    bases = _bases(now, cfg.frictions)
    slots, values = [], []
    for effect in effects:
        own = [now.model.at_point(effect, point) for point in probe_points(effect)]
        may = now.model.allowed_joints(effect)
        tried = [now.model.extended(base, effect, may, each) for base in bases for each in own]
        slots.append(Slot(model=tried[0][0], rows=len(tried)))
        values.append(torch.stack([physical for _, physical in tried]))
    batch = fits.batch(problem, slots, training=True)
    where = batch.dataset.train.clone()
    where[int(fits.cfg.part * len(where)) :] = False
    scores = batch.simulate(values, where, fits.cfg.stride).square().sum(dim=(1, 2)).cpu()
    result = []
    for effect, slot, points_of, score in zip(effects, slots, values, batch.split(scores), strict=True):
        every = torch.arange(len(score))
        # each probe with all of the bases, or all of them
        groups = every.unflatten(0, (len(bases), -1)).T if effect.is_stiff else every[None]
        result.append([_best(now, slot.model, effect, points_of[group], score[group]) for group in groups])
    return result


def _best(now: Fitted, model: JointModel, effect: type[Effect], points: torch.Tensor, score: torch.Tensor) -> Fitted:
    """A start at each joint's best of some points, (points, n, P), by their scores, (points, n)."""
    physical = points[score.argmin(dim=0), torch.arange(now.model.num_joints)]
    return Fitted.start(model.structure_held(effect, physical), physical, tried=effect)


def _bases(now: Fitted, levels: Sequence[float]) -> list[torch.Tensor]:
    """The present values, and with less friction of both kinds, the other parameters in the middle, (n, P) each."""
    result = [now.physical]
    for level in levels:
        x = now.x.clone()
        x[:, COLUMN["armature"]] = level
        x[:, COLUMN["viscous_friction"]] = level
        x[:, COLUMN["friction"]] = level
        x[:, COLUMN["delay"]] = -0.5
        result.append(now.model.to_physical(x))
    return result
