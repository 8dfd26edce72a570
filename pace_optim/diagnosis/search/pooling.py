"""One value of an effect for several joints, where the recordings do not ask for more."""

from __future__ import annotations

from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.selection.decisions import Log, unlogged
from pace_optim.diagnosis.selection.rules import decide
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted

_RIDGE = 1e-12


def pool(fits: Fits, outcome: Outcome, floor: torch.Tensor, log: Log = unlogged) -> Outcome:
    """Give each effect found on several joints of one type one value for all of them, where that explains as much.

    The value is the joints' mean, weighted by how well each is known beside its other parameters (the Schur
    complement of the Gauss–Newton matrix, over the squared error); the other parameters are fitted again with it held.
    Far from the floor (n,) [rad] what is missing hides whether the values differ, and each joint keeps its own.
    """
    if outcome.final.jacobian is None and outcome.cfg.has("pool"):
        outcome = replace(outcome, final=fits.looked_at(outcome.problem, [outcome.final])[0])
    for effect, has in zip(outcome.final.model.effects, outcome.final.model.has, strict=True):
        types = {outcome.final.model.joint_type(j) for j in has.nonzero()[:, 0].tolist()}
        if not outcome.cfg.has("pool") or effect.shared or effect in outcome.base.model.effects or int(has.sum()) < 2:
            continue
        if len(types) > 1 or bool((outcome.far(floor) & has).any()):
            continue
        held = _held(outcome, effect, has)
        fitted = fits.side_by_side(outcome.problem, [held], fits.cfg.again, keep_jacobian=True)[0]
        errors = fits.validation_errors(outcome.problem, [fitted])[0]
        joints = has.nonzero()[:, 0].tolist()
        after, least = {effect.name: errors}, floor[joints].tolist()
        if decide("pool", joints, outcome.final_errors, after, cfg=outcome.cfg, log=log, floor=least):
            outcome = replace(_pooled(outcome, fitted, effect), final_errors=errors)
    return outcome


def _held(outcome: Outcome, effect: type[Effect], has: torch.Tensor) -> Fitted:
    """The model with the effect's values held at the joints' common one."""
    now, model, columns = outcome.final, outcome.final.model, outcome.final.model.columns(effect)
    common = _common(now, columns, has, outcome.final_errors.mse)
    physical = now.physical
    at = model.to_normalised(physical)
    at[has, columns] = common
    physical[has, columns] = model.to_physical(at)[has, columns]
    lower, upper = model.lower.clone(), model.upper.clone()
    lower[has, columns] = upper[has, columns] = physical[has, columns]
    return Fitted.start(replace(model, lower=lower, upper=upper), physical)


def _common(now: Fitted, columns: slice, has: torch.Tensor, mse: torch.Tensor) -> torch.Tensor:
    """Mean of the normalised values, (parameters,), weighted by what is known of them beside squared errors (n,)."""
    if now.jacobian is None:
        raise ValueError("Pooling needs a model that was fitted with keep_jacobian.")
    size = now.model.size
    own = torch.arange(size)[columns]
    others = torch.tensor([p for p in range(size) if p not in own.tolist()])
    weight = torch.zeros(len(own), len(own), dtype=torch.float64)
    moment = torch.zeros(len(own), dtype=torch.float64)
    for j in has.nonzero()[:, 0].tolist():
        rows = now.jacobian[..., j].flatten(1).double()
        gram = rows @ rows.T / mse[j].clamp(min=1e-300)
        gram = gram + _RIDGE * gram.diagonal().max() * torch.eye(size, dtype=torch.float64)
        cross = gram[own[:, None], others]
        known = gram[own[:, None], own] - cross @ torch.linalg.solve(gram[others[:, None], others], cross.T)
        weight += known
        moment += known @ now.x[j, own]
    return torch.linalg.solve(weight, moment).clamp(-1.0, 1.0)


def _pooled(outcome: Outcome, fitted: Fitted, effect: type[Effect]) -> Outcome:
    """The outcome with the common value in its final model, and the bounds that that had."""
    model = outcome.final.model
    pooled = replace(model, shared=model.shared | {effect})
    return replace(outcome, final=replace(fitted, model=pooled, x=model.to_normalised(fitted.physical)))
