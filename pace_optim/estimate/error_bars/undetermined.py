"""Parameters that the recordings do not determine, and what they are held at: the configuration's value, else 0."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from pace_actuators import match_names, resolve_joint_values
from pace_actuators.base_parameters import CARRIED, PER_JOINT
from pace_actuators.effects import effect_cfgs
from pace_actuators.text import plural
from pace_envs.tasks.pace import GLOBAL
from pace_optim.estimate.error_bars.far_from_noise import noise_score
from pace_optim.estimate.error_bars.uncertainty import (
    HARDLY_KNOWN,
    SURE,
    Uncertainty,
)
from pace_optim.estimate.least_squares import LeastSquaresCfg, least_squares
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem
from pace_optim.terminal.choices import UNKNOWN_FACTS

_NEAR = 0.05
"""A delay this near to a whole number of control steps counts as whole."""
_SURE = 3.0
"""Standard deviations."""


def whole_delay(problem: Problem, delay: float, std: float | None) -> list[str]:
    """Which other delays would look the same, in a sentence; nothing if the recordings separate them.

    Commands that come on their own clock, at instants at which the loop runs too, are taken over late by a whole number
    of its steps, whatever their delay.

    Args:
        delay: As found [control steps].
        std: Its standard deviation [control steps].
    """
    drives = problem.env_cfg.scene.robot.actuators.values()
    held = all(not drive.implicit and drive.drive_dt in (None, problem.control_dt) for drive in drives)
    own_clock = any(problem.dataset.recordings[r].des_time is not None for r in problem.dataset.trained())
    near = max(_NEAR, _SURE * (std or 0.0))
    if not (held and own_clock and problem.delay_mode == "command" and round(delay) >= 1):
        return []
    if abs(delay - round(delay)) > near or near > 0.5:
        return []
    step = 1e3 * problem.control_dt
    return [
        f"The delay of {round(delay) * step:g} ms is exactly {plural(round(delay), 'control step')}. A drive that "
        f"samples commands every {step:g} ms shows the same motion for any delay above "
        f"{(round(delay) - 1) * step:g} and up to {round(delay) * step:g} ms. [W16]"
    ]


DELAY = f"delay/{GLOBAL}"
"""Label of the delay."""
AS_GOOD = 1e-3
"""A score within this part of another is as good."""
BIAS = "encoder_bias"
"""Name of the biases."""


def undetermined(problem: Problem, x: torch.Tensor, uncertainty: Uncertainty, far: bool = False) -> list[str]:
    """Labels of parameters without influence, and of those whose error bar is as wide as their bounds or value.

    As wide as the value: an inertia or a friction that differs significantly neither from zero nor from its prior. A
    fact that the user declares unknown is open too if other parameters compensate for it; the stated value then holds.
    An encoder bias is open if others compensate for it exactly, such as the phase of a ripple on an unloaded joint.

    Args:
        far: Whether the fit ended so far above the noise that error bars mean nothing: then they leave nothing open.
    """
    silent = set(uncertainty.no_influence)
    if far:
        return [label for label in problem.space.labels if label in silent]
    silent |= _of_unknown(problem) & {label for group in uncertainty.indistinguishable for label in group}
    silent |= _origins(uncertainty) | _wide(problem.space, uncertainty) | _none_or_prior(problem, x, uncertainty)
    return [label for label in problem.space.labels if label in silent]


def _wide(space: ParameterSpace, uncertainty: Uncertainty) -> set[str]:
    """Labels of what has an error bar as wide as its bounds or prior, or would have one but for being at a bound."""
    prior = space.prior
    width = torch.where(prior.isinf(), space.upper - space.lower, 2.0 * prior * space.slope(torch.zeros(space.size)))
    wide = np.nan_to_num(uncertainty.std) > HARDLY_KNOWN * width.numpy()
    return {label for label, yes in zip(space.labels, wide, strict=True) if yes} | set(uncertainty.by_chance)


def _origins(uncertainty: Uncertainty) -> set[str]:
    """Labels of encoder biases that can be anywhere, as others make up for them exactly."""
    return {label for group in uncertainty.combinations for label in group if label.startswith(f"{BIAS}/")}


def _none_or_prior(problem: Problem, x: torch.Tensor, uncertainty: Uncertainty) -> set[str]:
    """Labels of what may be none, or as its prior is, by its error bar."""
    space, value = problem.space, problem.space.to_physical(x).numpy()
    apart = np.maximum(value, np.abs(value - _within_bounds(problem).numpy()))
    unsure = apart < SURE * uncertainty.std  # false without an error bar
    return {label for label, yes in zip(space.labels, unsure, strict=True) if yes and label.split("/")[0] in CARRIED}


def _of_unknown(problem: Problem) -> set[str]:
    """Labels of what stands for facts that are declared unknown."""
    effects = {UNKNOWN_FACTS[fact] for fact in problem.unknown}
    return {label for label in problem.space.labels if label.split(".")[0] in effects}


def held_at_prior(
    problem: Problem, x: torch.Tensor, uncertainty: Uncertainty, labels: list[str], cfg: LeastSquaresCfg | None
) -> tuple[torch.Tensor, list[str]]:
    """A vector with what the recordings leave open at its prior, the rest fitted again beside it; and what that is.

    Several parameters that are open each may not be so together: where their prior costs more than another solution
    may, those are not held whose error bar is only as wide as their value; then only facts that are declared unknown
    are, and where that costs too much, only what has no influence.

    Args:
        cfg: How the rest is fitted; ``None`` holds only what has no influence.
    """
    silent = [label for label in labels if label in uncertainty.no_influence]
    unknown = _of_unknown(problem)
    fewer = [label for label in labels if label in silent or label in unknown]
    wide = _wide(problem.space, uncertainty) | _origins(uncertainty)
    wide_or_fewer = [label for label in labels if label in wide or label in fewer]
    for chosen in dict.fromkeys((tuple(labels), tuple(wide_or_fewer), tuple(fewer))):
        if cfg is not None and len(silent) < len(chosen):
            found = _fitted_beside(problem, x, list(chosen), cfg)
            if found is not None:
                return found, list(chosen)
    held = at_prior(problem, x, silent)
    if silent:  # which a simulation that oscillates does not show
        evaluator = problem.training_evaluator()
        before, after = evaluator.residuals(problem.space.to_physical(torch.stack([x, held]))).score.tolist()
        if after > (1 + AS_GOOD) * before:
            return x, []
    return held, silent


def without_delay(
    problem: Problem, x: torch.Tensor, uncertainty: Uncertainty, held: Sequence[str], cfg: LeastSquaresCfg
) -> torch.Tensor | None:
    """A vector without a delay, the rest fitted again, if zero delay is as good; else ``None``.

    A delay cannot be below 0. An insignificant one biases damping and inertia where a drive's gains are large: kd times
    the delay is inertia, kp times it viscous friction.

    Args:
        held: Labels of what is held at its prior already.
    """
    space = problem.space
    at = space.labels.index(DELAY)
    delay, std = float(space.to_physical(x)[at]), float(uncertainty.std[at])
    if DELAY in held or float(space.lower[at]) != 0 or not 0 < delay <= SURE * std:
        return None
    return _fitted_beside(problem, x, [*held, DELAY], cfg)


def _fitted_beside(problem: Problem, x: torch.Tensor, labels: list[str], cfg: LeastSquaresCfg) -> torch.Tensor | None:
    """The vector with some entries at their prior and the rest fitted again; ``None`` where it is not as good."""
    physical = problem.space.to_physical(at_prior(problem, x, labels))
    held = replace(problem, space=problem.space.holding(labels, physical))
    evaluator = held.training_evaluator()
    tolerance = min(cfg.score_tolerance, AS_GOOD)  # as finely as it is judged
    cfg = replace(cfg, score_tolerance=tolerance, noise_score=noise_score(problem))
    before = float(evaluator.residuals(problem.space.to_physical(x)[None]).score[0])
    best = least_squares(evaluator, [held.space.to_normalised(physical)], cfg)[0]
    if best.score > (1 + AS_GOOD) * before:
        return None
    return problem.space.to_normalised(held.space.to_physical(best.x))


def at_prior(problem: Problem, x: torch.Tensor, labels: list[str]) -> torch.Tensor:
    """A normalised vector (size,) with some entries at their prior."""
    space = problem.space
    at = [space.labels.index(label) for label in labels]
    result = x.clone()
    result[at] = space.to_normalised(_within_bounds(problem))[at]
    return result


def _within_bounds(problem: Problem) -> torch.Tensor:
    """The prior, or the bound that is nearest to it, physical (size,)."""
    return prior(problem).clamp(problem.space.lower, problem.space.upper)


def prior(problem: Problem) -> torch.Tensor:
    """Every parameter as the configuration has it, physical (size,); else 0, and an effect at its null."""
    space, joints = problem.space, list(problem.joint_names)
    result = torch.zeros(space.size, dtype=torch.float64)
    for drive in problem.env_cfg.scene.robot.actuators.values():
        own = [joints[i] for group in match_names(drive.joint_names_expr, joints) for i in group]
        for name in PER_JOINT:
            if (value := getattr(drive, name)) is not None and name in space.slices:
                values = resolve_joint_values(value, own, field=name).to(torch.float64)
                result[space[name]][[joints.index(joint) for joint in own]] = values
    result = torch.where(space.prior.isfinite(), space.to_physical(torch.zeros(space.size)).double(), result)
    for cfg in effect_cfgs(problem.env_cfg.sim2real.effects):
        kind = cfg.effect_class
        for parameter in kind.parameters:
            here = space.slices.get(f"{kind.name}.{parameter.name}")
            if here is not None:
                null = parameter.start if parameter.null is None else parameter.null
                result[here] = null if math.isfinite(null) else parameter.upper
    return result
