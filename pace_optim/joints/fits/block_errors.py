"""Errors on the recordings that were not trained on, in blocks of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from pace_optim.joints.fits.fitting_cfg import DEFAULT, FittingCfg


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockErrors:
    """Mean square errors of n joints in B blocks of validation, of one second where there are enough."""

    square: torch.Tensor
    """(B, n) [rad²]; not a number where a joint has fewer blocks."""
    weight: torch.Tensor
    """Samples of each block, (B,)."""

    @property
    def mse(self) -> torch.Tensor:
        """Of each joint, (n,) [rad²]."""
        known = ~self.square.isnan()
        return (self.square.nan_to_num() * self.weight[:, None]).sum(dim=0) / (known * self.weight[:, None]).sum(dim=0)

    def on_joints(self, joints: torch.Tensor) -> BlockErrors:
        """Those of some joints, (n,) bool."""
        return replace(self, square=self.square[:, joints])

    def with_joints(self, joints: torch.Tensor, own: BlockErrors) -> BlockErrors:
        """The same with other errors of some joints, (n,) bool: of these alone, or of all."""
        square = self.square.clone()
        square[:, joints] = own.square[:, joints] if own.square.shape[1] == len(joints) else own.square
        return replace(self, square=square)


def block_errors(
    error: torch.Tensor,
    where: torch.Tensor,
    control_dt: float,
    *,
    weight: torch.Tensor | None = None,
    cfg: FittingCfg = DEFAULT,
) -> BlockErrors:
    """Cut errors into blocks.

    Args:
        error: (T, R, n) at every control step.
        weight: What errors were multiplied by, (T, R, n), 0 where a joint is held; ``None``: 1.
    """
    if weight is not None:
        return _free_errors(error, where, weight, control_dt, cfg)
    blocks = _blocks(where, control_dt, cfg)
    return BlockErrors(
        square=torch.stack([error[own, r].double().square().mean(dim=0) for r, own in blocks]),
        weight=torch.tensor([len(own) for _, own in blocks], dtype=torch.float64),
    )


def _free_errors(
    error: torch.Tensor, where: torch.Tensor, weight: torch.Tensor, control_dt: float, cfg: FittingCfg
) -> BlockErrors:
    """Errors of joints that are free at times: the free time of each, in so many blocks.

    A joint that is never free is not judged: it has 0. A leg that hardly swings has one block,
    which compares nothing: samples of one swing are alike.
    """
    own = [(where & (weight[..., j] > 0)).T.nonzero() for j in range(weight.shape[2])]
    count = cfg.blocks  # for all joints: models are compared block by block
    square = torch.zeros(count, len(own), dtype=torch.float64)
    for j, places in enumerate(own):
        if len(places):
            r, k = places.T
            errors = (error[k, r, j] / weight[k, r, j]).double().square()
            own_count = count if len(places) * control_dt >= count * cfg.swing_s else 1
            square[:own_count, j] = torch.stack([part.mean() for part in errors.tensor_split(own_count)])
            square[own_count:, j] = torch.nan
    return BlockErrors(square=square, weight=torch.ones(count, dtype=torch.float64))


def check_long_enough(
    where: torch.Tensor, control_dt: float, *, free: torch.Tensor | None = None, cfg: FittingCfg = DEFAULT
) -> None:
    """See that recordings are long enough to judge by.

    Args:
        free: Where joints are free, (T, R, n) bool; ``None``: everywhere.

    Raises:
        ValueError: If they are not.
    """
    if free is not None:
        samples = (free & where[..., None]).sum(dim=(0, 1)).tolist()
        usual = float(np.median([count for count in samples if count] or [0])) * control_dt
        if usual < (least := cfg.blocks * cfg.swing_s):
            raise ValueError(
                f"In the held-out data, the median joint swings for {usual:.2g} s, too short to judge a model by. "
                f"Expected {least:g} s or more. Walk for longer, or fit again with further recordings as --validation."
            )
        return
    length = sum(_spans(where)) * control_dt
    if length < cfg.block_s:
        raise ValueError(
            f"What was kept for validation lasts {length:.2g} s, too short to judge a model by; expected "
            f"{cfg.block_s:g} s or more. Record for longer, or fit again with further recordings as --validation."
        )


def _blocks(where: torch.Tensor, control_dt: float, cfg: FittingCfg) -> list[tuple[int, torch.Tensor]]:
    """Recordings and samples of blocks: of time, so that coarse sampling has the same ones."""
    length = min(cfg.block_s, max(cfg.shortest_s, sum(_spans(where)) * control_dt / cfg.blocks))
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
