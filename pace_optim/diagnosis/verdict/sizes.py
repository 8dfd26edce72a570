"""How large the effects found are, with error bars, and which of their sizes are at a bound."""

from __future__ import annotations

import math
from typing import Any

import torch

from pace_actuators.effects import Effect, EffectParameter
from pace_actuators.joint_units import JointType, units_for
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.estimate.error_bars.physics_step import FINER, TO_NO_STEP, has_no_step
from pace_optim.estimate.error_bars.uncertainty import ANYWHERE, sandwich
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.simulation.problem import TwinProblem


def sizes(fits: Fits, outcome: Outcome, floor: torch.Tensor, joint_names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Every parameter of every effect found, joint by joint, for ``diagnosis.json``; curves are left out.

    Args:
        fits: Fits models.
        outcome: Where the search ended.
        floor: Of each joint, (n,) [rad].
        joint_names: The joints.

    Returns:
        ``{"effect", "parameter", "joint", "value", "std", "unit", "factor", "at_bound"}`` each. ``std`` is ``None``
        where a value is held or at a bound, or the joint ends far from the floor, or above it with a stiff effect. It
        is that of all joints together where they share one; ``factor`` says what was stated is multiplied by, if it is
        that.
    """
    now = outcome.final
    found = now.model.has & torch.tensor([not effect.free_form for effect in now.model.effects]).bool()[:, None]
    if not bool(found.any()):
        return []
    if now.model.shared:  # a common value was held while it was fitted
        now = fits.looked_at(outcome.problem, [now])[0]
    now = fits.looked_closely(outcome.problem, now)
    std, stuck = standard_deviations(now), now.model.at_bounds(now.x, now.moves)
    std = torch.where(std > 0, torch.hypot(std, _step_shares(fits, outcome.problem, now)), std)
    unsure = without_error_bars(outcome, floor).tolist()
    result = []
    for effect, has in zip(now.model.effects, found, strict=True):
        columns = now.model.columns(effect)
        if effect in now.model.shared:
            std[has, columns] = std[has, columns].pow(-2).sum(dim=0).pow(-0.5)
        for j in has.nonzero()[:, 0].tolist():
            values = (each[j, columns].tolist() for each in (now.physical, std, stuck))
            kind = now.model.joint_type(j)
            result += [
                {"effect": effect.name, "parameter": parameter.name, "joint": joint_names[j]}
                | size_of(effect, parameter, value, None if unsure[j] else error, kind, held_back)
                for parameter, value, error, held_back in zip(effect.parameters, *values, strict=True)
            ]
    return result


def size_of(
    effect: type[Effect],
    parameter: EffectParameter,
    value: float,
    std: float | None,
    joint_type: JointType,
    at_bound: bool = False,
) -> dict[str, Any]:
    """The size of an effect's parameter on a joint, with an error bar if that is not zero."""
    return {
        "parameter": parameter.name,
        "value": value,
        "std": std if std is not None and std > 0 else None,
        "unit": units_for(parameter.unit, [joint_type]),
        "factor": factor_of(effect, parameter, value),
        "at_bound": at_bound,
    }


def without_error_bars(outcome: Outcome, floor: torch.Tensor) -> torch.Tensor:
    """Joints whose sizes have no error bar, (n,) bool: far from the floor (n,) [rad], or stiff and above it."""
    model = outcome.final.model
    stiff = model.has & torch.tensor([effect.is_stiff for effect in model.effects]).bool()[:, None]
    # contacts make the error rough: above the floor its derivatives say little of how sure a size is
    above = outcome.final_errors.mse.sqrt() > outcome.cfg.judging.alike * floor
    return outcome.far(floor) | (stiff.any(dim=0) & above)


def factor_of(effect: type[Effect], parameter: EffectParameter, value: float) -> float | None:
    """What multiplies the stated value; ``None`` for a parameter that is no such factor."""
    if not effect.scales:
        return None
    return value if parameter.null == 1.0 else 1.0 + value


def standard_deviations(now: Fitted) -> torch.Tensor:
    """Physical standard deviations of a fitted model's parameters, (n, P); zero where one is held or at a bound.

    Args:
        now: Fitted, with its Jacobian: of every second control step of what is trained on.
    """
    columns, error = now.free_jacobian, now.error
    if error is None:
        raise ValueError("Error bars need a model that was fitted with keep_jacobian.")
    result = torch.zeros_like(now.x)
    slope = now.model.box.slope(now.x)
    for j in range(now.model.num_joints):
        own = columns[..., j].double()
        free = own.flatten(1).norm(dim=1).nonzero()[:, 0]
        if len(free):
            covariance = sandwich(own[free].numpy(), error[..., j].double().numpy(), ANYWHERE)
            result[j, free] = torch.as_tensor(covariance.diagonal().copy()).clamp(min=0.0).sqrt() * slope[j, free]
    return result


def _step_shares(fits: Fits, problem: TwinProblem, now: Fitted) -> torch.Tensor:
    """The part of each value that makes up for the physics step, physical (n, P), as in a fit's ``step_share``.

    The errors change by c without a step, and a fit would then move by - (JᵀJ)⁻¹ Jᵀ c, if the recording has no step.
    """
    columns, error, result = now.free_jacobian, now.error, torch.zeros_like(now.x)
    if error is None:
        raise ValueError("Error bars need a model that was fitted with keep_jacobian.")
    finer = fits.trained_errors(problem.with_physics_dt(problem.physics_dt / FINER), now)
    change = (TO_NO_STEP * (finer - error)).double()
    for j in range(now.model.num_joints):
        own = columns[..., j].double().flatten(1)
        free = own.norm(dim=1).nonzero()[:, 0]
        move = torch.linalg.lstsq(own[free].T, change[..., j].flatten()[:, None], driver="gelsd").solution[:, 0]
        left = change[..., j] - (move @ own[free]).view_as(change[..., j])
        if has_no_step(error[..., j, None].double(), left[..., None], torch.ones_like(left, dtype=torch.bool)):
            result[j, free] = move
    return result * now.model.box.slope(now.x)


def error_bars_from_none(now: Fitted, std: torch.Tensor | None = None) -> torch.Tensor:
    """How many of its error bars each effect's size is away from none, (effects, n); zero without the effect.

    Of a parameter p with the null p₀ it is |p - p₀| / σ, on a logarithmic scale |ln p - ln p₀| p / σ, and p / σ where
    the null is infinite; of several the largest. One at a bound has no error bar and does not count.

    Args:
        now: A model, fitted.
        std: Physical standard deviations, (n, P), zero without error bar; ``None``: from its Jacobian.
    """
    std, physical = standard_deviations(now) if std is None else std, now.physical
    result = torch.zeros(now.model.has.shape, dtype=torch.float64)
    for row, (effect, has) in enumerate(zip(now.model.effects, now.model.has, strict=True)):
        for column, p in enumerate(effect.parameters, start=now.model.columns(effect).start):
            value, error = physical[:, column], std[:, column]
            if p.null is None:
                continue
            away = (value - p.null).abs()
            if math.isinf(p.null):
                away = value
            elif p.scale == "log":
                away = (value / p.null).log().abs() * value
            known = has & (error > 0)
            result[row] = torch.maximum(result[row], torch.where(known, away / error.clamp(min=1e-300), 0.0))
    return result
