"""How much of what the effects found explain together is due to each."""

from __future__ import annotations

from pace_actuators.effects import Effect
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.single_joint_fits.fits import Fits
from pace_optim.single_joint_fits.fitted import Fitted


def contributions(fits: Fits, outcome: Outcome) -> dict[type[Effect], float]:
    """The share of each effect found, the largest first; shares add up to 1.

    Each is left out in turn and the rest is fitted again. What the squared validation error rises by then is due to it;
    effects that can take each other's place share little.
    """
    now = outcome.final
    found = [(effect, has) for effect, has in zip(now.model.effects, now.model.has, strict=True) if bool(has.any())]
    if len(found) < 2:
        return {effect: 1.0 for effect, _ in found}
    without = [Fitted.start(now.model.without_effect(effect, has), now.physical, tried=effect) for effect, has in found]
    _, after = fits.on_joints(outcome.problem, without, now.model.has.any(dim=0), outcome.final_errors)
    rise = {
        effect: float((errors.mse - outcome.final_errors.mse)[has].clamp(min=0.0).sum())
        for (effect, has), errors in zip(found, after, strict=True)
    }
    whole = max(sum(rise.values()), 1e-30)
    return {effect: rise[effect] / whole for effect in sorted(rise, key=rise.__getitem__, reverse=True)}
