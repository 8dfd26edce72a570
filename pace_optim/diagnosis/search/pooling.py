"""One value of an effect for several joints, where the recordings do not ask for more."""

from __future__ import annotations

from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.fitting.coarse_to_fine import fit_side_by_side
from pace_optim.diagnosis.judging.acceptance import BlockErrors
from pace_optim.diagnosis.judging.validation import validation_errors
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.search.search import Outcome

_COST = 1.05
"""Squared validation error, as a multiple of that with a value for each joint, that one value for all may cost."""
_ITERATIONS = 5
_RIDGE = 1e-12


def share(outcome: Outcome) -> None:
    """Give each effect found on several joints one value for all of them, where that explains as much.

    The value is the joints' mean, weighted by how well each is known beside its other parameters (the Schur
    complement of the Gauss–Newton matrix); the other parameters are fitted again with it held.
    """
    for effect, has in zip(outcome.final.model.effects, outcome.final.model.has, strict=True):
        if effect.shared or int(has.sum()) < 2:
            continue
        held = _held(outcome.final, effect, has)
        fitted = fit_side_by_side(outcome.problem, [held], _ITERATIONS, keep_jacobian=True)[0]
        errors = validation_errors(outcome.problem, [fitted])[0]
        if float(errors.mse[has].sum()) <= _COST * float(outcome.final_errors.mse[has].sum()):
            _take(outcome, fitted, errors, effect)


def _held(now: Fitted, effect: type[Effect], has: torch.Tensor) -> Fitted:
    """The model with the effect's values held at the joints' common one."""
    model, columns = now.model, now.model.columns(effect)
    common = _common(now, columns, has)
    physical = model.to_physical(now.x)
    at = model.to_normalised(physical)
    at[has, columns] = common
    physical[has, columns] = model.to_physical(at)[has, columns]
    lower, upper = model.lower.clone(), model.upper.clone()
    lower[has, columns] = upper[has, columns] = physical[has, columns]
    return Fitted.start(replace(model, lower=lower, upper=upper), physical)


def _common(now: Fitted, columns: slice, has: torch.Tensor) -> torch.Tensor:
    """Weighted mean of the normalised values, (parameters,)."""
    if now.jacobian is None:
        raise ValueError("Sharing needs a model that was fitted with keep_jacobian.")
    size = now.model.size
    own = torch.arange(size)[columns]
    others = torch.tensor([p for p in range(size) if p not in own.tolist()])
    weight = torch.zeros(len(own), len(own), dtype=torch.float64)
    moment = torch.zeros(len(own), dtype=torch.float64)
    for j in has.nonzero()[:, 0].tolist():
        rows = now.jacobian[..., j].flatten(1).double()
        gram = rows @ rows.T
        gram = gram + _RIDGE * gram.diagonal().max() * torch.eye(size, dtype=torch.float64)
        cross = gram[own[:, None], others]
        known = gram[own[:, None], own] - cross @ torch.linalg.solve(gram[others[:, None], others], cross.T)
        weight += known
        moment += known @ now.x[j, own]
    return torch.linalg.solve(weight, moment).clamp(-1.0, 1.0)


def _take(outcome: Outcome, fitted: Fitted, errors: BlockErrors, effect: type[Effect]) -> None:
    """Let the model with the common value be the final one, with the bounds that it had."""
    model = outcome.final.model
    shared = replace(model, shared=model.shared | {effect})
    x = model.to_normalised(fitted.model.to_physical(fitted.x))
    outcome.final = replace(fitted, model=shared, x=x)
    outcome.final_errors = errors
