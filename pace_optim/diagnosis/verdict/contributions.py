"""How much of what the effects found explain together is due to each."""

from __future__ import annotations

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.single_joint_fits.block_errors import BlockErrors
from pace_optim.single_joint_fits.fits import Fits
from pace_optim.single_joint_fits.fitted import Fitted


def contributions(fits: Fits, outcome: Outcome) -> dict[type[Effect], float]:
    """The share of each effect found, the largest first; shares add up to 1.

    Each is left out in turn and the rest is fitted again, on the joints that have it. What the squared validation error
    rises by then is due to it; effects that can take each other's place share little.
    """
    now = outcome.final
    found = [(effect, has) for effect, has in zip(now.model.effects, now.model.has, strict=True) if bool(has.any())]
    if len(found) < 2:
        return {effect: 1.0 for effect, _ in found}

    def left_out(some: list[tuple[type[Effect], torch.Tensor]]) -> list[BlockErrors]:
        result = []
        for effect, has in some:
            without = Fitted.start(now.model.without_effect(effect, has), now.physical, tried=effect)
            result += fits.on_joints(outcome.problem, [without], has, outcome.final_errors)[1]
        return result

    after = fits.shared_out(left_out, found, [effect for effect, _ in found])
    rise = {
        effect: float((errors.mse - outcome.final_errors.mse)[has].clamp(min=0.0).sum())
        for (effect, has), errors in zip(found, after, strict=True)
    }
    whole = max(sum(rise.values()), 1e-30)
    return {effect: rise[effect] / whole for effect in sorted(rise, key=rise.__getitem__, reverse=True)}
