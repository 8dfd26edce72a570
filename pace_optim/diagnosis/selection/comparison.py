"""Whether one model of a joint is better than another, on recordings that neither was fitted to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy import stats

from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, JudgingCfg
from pace_optim.joints.fits.block_errors import BlockErrors


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """A candidate against the present model on one joint."""

    ratio: float
    """RMSE before / after."""
    t: float
    """t statistic of the blocks' log ratio."""
    significant: bool


def within(mse: float, best: float, ratio: float) -> bool:
    """Whether an RMSE is at most so many times another; both are given squared [rad²]."""
    return mse <= ratio**2 * best


def least_ratio(first: bool, *, cfg: JudgingCfg = DEFAULT.judging) -> float:
    """By how many times an effect must lower the validation RMSE, the first one or one beside others."""
    return cfg.alike if first else cfg.next_effect


def judge(
    before: BlockErrors,
    after: BlockErrors,
    joint: int,
    tried: int,
    first: bool,
    *,
    cfg: JudgingCfg = DEFAULT.judging,
) -> Judgement:
    """Compare two models block by block.

    Neighbouring samples are alike, blocks hardly: the mean of the blocks' log(MSE before / MSE after),
    and that of MSE before - MSE after, are held against their scatter. The threshold is Student's for the chance that
    the best of ``tried`` candidates looks this good by luck in either of them. For a clear fall it is that of a single
    test.

    Args:
        before: The present model's errors.
        after: The candidate's.
        joint: Which joint.
        tried: How many candidates were tried, over all joints.
        first: Whether the present model has no effect yet.
        cfg: What is asked.
    """
    ratio = math.sqrt(float(before.mse[joint]) / max(float(after.mse[joint]), 1e-300))
    known = ~before.square[:, joint].isnan()
    old, new = before.square[known, joint], after.square[known, joint]
    logs = (old.clamp(min=1e-30) / new.clamp(min=1e-30)).log()
    falls = (old - new) / before.mse[joint]
    # the first sees a small fall everywhere, the second a large one somewhere
    t = max(_t(logs), _t(falls))
    tests = 1 if ratio >= cfg.clear else 2 * max(1, tried)
    threshold = float(stats.t.isf(cfg.level / tests, max(1, len(logs) - 1)))
    return Judgement(ratio=ratio, t=t, significant=ratio >= least_ratio(first, cfg=cfg) and t > threshold)


def _t(values: torch.Tensor) -> float:
    """Mean over its standard error; 0 of a single value."""
    return 0.0 if len(values) < 2 else float(values.mean() / (values.std() / math.sqrt(len(values))).clamp(min=1e-12))
