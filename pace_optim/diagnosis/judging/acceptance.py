"""Whether a richer model pays, on recordings that it was not fitted to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy import stats

_LONGEST = 1.0
"""A block [s]; shorter where that gives fewer than ``_WANTED``, but never below ``_SHORTEST``: in less time neighbours
are alike."""
_SHORTEST = 0.25
_WANTED = 6
_FEWEST = 4
"""Blocks, below which nothing is shown."""
FIRST_RATIO = 1.10
"""By how much the first effect must lower the validation RMSE."""
NEXT_RATIO = 1.25
"""And each further one."""
LEVEL = 0.02
"""Chance of a false alarm over all that was tried."""
CLEAR_RATIO = 1.5
"""A fall that is this large needs no more than ``CLEAR_T``."""
CLEAR_T = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockErrors:
    """Mean square errors of n joints in B blocks of validation, of one second where there are enough."""

    square: torch.Tensor
    """(B, n) [rad²]."""
    weight: torch.Tensor
    """Samples of each block, (B,)."""

    @property
    def mse(self) -> torch.Tensor:
        """Of each joint, (n,) [rad²]."""
        return (self.square * self.weight[:, None]).sum(dim=0) / self.weight.sum()


def block_errors(error: torch.Tensor, where: torch.Tensor, control_dt: float) -> BlockErrors:
    """Cut errors into blocks.

    Args:
        error: (T, R, n) at every control step.
        where: Which samples count, (T, R) bool.
        control_dt: [s].
    """
    blocks = _blocks(where, control_dt)
    return BlockErrors(
        square=torch.stack([error[own, r].double().square().mean(dim=0) for r, own in blocks]),
        weight=torch.tensor([len(own) for _, own in blocks], dtype=torch.float64),
    )


def check_long_enough(where: torch.Tensor, control_dt: float) -> None:
    """See that recordings are long enough to judge by.

    Args:
        where: Which samples count, (T, R) bool.
        control_dt: [s].

    Raises:
        ValueError: If they are not.
    """
    if len(_blocks(where, control_dt)) < _FEWEST:
        raise ValueError(
            f"What was kept for validation lasts {sum(_spans(where)) * control_dt:.2g} s, too short to judge a model "
            f"by; expected {_FEWEST * _SHORTEST:g} s or more. Record for longer, or fit again with further recordings "
            "as --validation."
        )


def _blocks(where: torch.Tensor, control_dt: float) -> list[tuple[int, torch.Tensor]]:
    """Recordings and samples of blocks: of time, so that coarse sampling has the same ones."""
    length = min(_LONGEST, max(_SHORTEST, sum(_spans(where)) * control_dt / _WANTED))
    steps = max(1, round(length / control_dt))
    blocks = []
    for r in range(where.shape[1]):
        at = where[:, r].nonzero()[:, 0]
        if not len(at):
            continue
        block = (at - at[0]) // steps
        for b in range(int(block[-1]) + 1):
            own = at[block == b]
            if len(own) * 2 >= (block == 0).sum():
                blocks.append((r, own))
    return blocks


def _spans(where: torch.Tensor) -> list[int]:
    """Control steps from the first to the last sample of recordings that have any."""
    found = (column.nonzero()[:, 0] for column in where.T)
    return [int(at[-1] - at[0]) + 1 for at in found if len(at)]


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """A candidate against the present model on one joint."""

    ratio: float
    """RMSE before / after."""
    t: float
    """t statistic of the blocks' log ratio."""
    significant: bool
    likely: bool
    """Whether it may be there, though this does not show it: a fall that would count were it as even as a clear one."""


def judge(before: BlockErrors, after: BlockErrors, joint: int, tried: int, first: bool) -> Judgement:
    """Compare two models block by block.

    Neighbouring samples are alike, blocks hardly: the mean of the blocks' log(MSE before / MSE after),
    and that of MSE before - MSE after, are held against their scatter. The threshold is Student's for the chance that
    the best of ``tried`` candidates looks this good by luck in either of them.

    Args:
        before: The present model's errors.
        after: The candidate's.
        joint: Which joint.
        tried: How many candidates were tried, over all joints.
        first: Whether the present model has no effect yet.
    """
    ratio = math.sqrt(float(before.mse[joint]) / max(float(after.mse[joint]), 1e-300))
    logs = (before.square[:, joint].clamp(min=1e-30) / after.square[:, joint].clamp(min=1e-30)).log()
    count = len(logs)
    if count < _FEWEST:
        return Judgement(ratio=ratio, t=0.0, significant=False, likely=False)
    falls = (before.square[:, joint] - after.square[:, joint]) / before.mse[joint]
    # the first sees a small fall everywhere, the second a large one somewhere
    t = max(_t(logs), _t(falls))
    threshold = float(stats.t.isf(LEVEL / (2 * max(1, tried)), count - 1))
    least = FIRST_RATIO if first else NEXT_RATIO
    enough = t > threshold or (ratio >= CLEAR_RATIO and t > CLEAR_T)
    return Judgement(ratio=ratio, t=t, significant=ratio >= least and enough, likely=ratio >= least and t > CLEAR_T)


def _t(values: torch.Tensor) -> float:
    """Mean over its standard error."""
    return float(values.mean() / (values.std() / math.sqrt(len(values))).clamp(min=1e-12))
