"""Curves of any form in place of effects: which variable carries what is missing, and where that says more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from pace_actuators.effects import available_effects, get_effect
from pace_actuators.effects.free_form import FreeForm
from pace_optim.diagnosis.acceptance import BlockErrors, judge
from pace_optim.diagnosis.fitted import Fitted
from pace_optim.diagnosis.model import BASE, JointModel
from pace_optim.diagnosis.search import Outcome
from pace_optim.diagnosis.some_joints import SomeJoints
from pace_optim.diagnosis.stand_ins import EXPLAINED, above_floor, near_floor
from pace_optim.joint_twins.problem import TwinProblem

_BETTER = 0.5
"""A curve says more than the effects found where it leaves less than this part of the squared error that they leave."""
_REACHED = 0.998
"""Quantile of a variable up to which the knots of a curve reach."""
_WORTH_A_WORD = 0.1


@dataclass(kw_only=True, eq=False)
class Curves:
    """Each curve by itself on top of the base model, on the joints that effects leave far from the floor."""

    joints: torch.Tensor
    """On which joints they were fitted, (n,) bool."""
    effects: list[type[FreeForm]]
    """The curves."""
    models: list[Fitted]
    """The base model with each, of all joints."""
    errors: list[BlockErrors]
    """Of all joints."""
    explained: torch.Tensor
    """Part of a joint's squared error above the floor that each explains, (curves, n)."""
    instead: torch.Tensor
    """Joints on which the best one says more than the effects found, (n,) bool."""

    def best(self, joint: int) -> int:
        """The curve that explains most of a joint's error."""
        return int(self.explained[:, joint].argmax())


def fit_curves(outcome: Outcome, floor: torch.Tensor, say: Callable[[str], None] = lambda _: None) -> Curves | None:
    """Fit every curve on the joints that are far from the floor in the end; ``None`` if there are none.

    A wrong effect can explain much of an error, and the right one leaves something where more is missing. A curve over
    one variable that leaves less than half of what all effects found leave says that those are not it.

    Args:
        outcome: Where the search ended.
        floor: Of each joint, (n,) [rad].
        say: Shows how far it is.
    """
    joints = ~near_floor(outcome, floor)
    if not bool(joints.any()):
        return None
    say("fitting curves of any form in place of effects")
    effects = [effect for name in available_effects() if issubclass(effect := get_effect(name), FreeForm)]
    ranges = _ranges(outcome.problem, outcome.base)
    starts = [_start(outcome.base, effect, joints, ranges) for effect in effects]
    models, errors = SomeJoints(joints).refitted(outcome.problem, starts, outcome.base_errors)
    before, with_effects = above_floor(outcome, floor)
    left = torch.stack([(each.mse - floor**2).clamp(min=0.0) for each in errors])
    explained = torch.where(joints, 1 - left / before.clamp(min=1e-30), 0.0)
    found = Curves(
        joints=joints, effects=effects, models=models, errors=errors, explained=explained, instead=joints.clone()
    )
    for j in joints.nonzero()[:, 0].tolist():
        k = found.best(j)
        pays = judge(outcome.base_errors, errors[k], j, len(effects) * len(joints), first=True).significant
        says_more = float(left[k, j]) < _BETTER * float(with_effects[j])
        found.instead[j] = pays and says_more and float(explained[k, j]) >= EXPLAINED
    return found


def take_curves(outcome: Outcome, curves: Curves) -> None:
    """Let the final model have a joint's best curve in place of its effects, where that says more."""
    model, errors = outcome.final.model, outcome.final_errors
    for effect in model.effects:
        model = model.without_effect(effect, curves.instead)
    physical = model.to_physical(outcome.final.x)
    square, score = errors.square.clone(), outcome.final.score.clone()
    for j in curves.instead.nonzero()[:, 0].tolist():
        k = curves.best(j)
        own, values = curves.models[k], curves.models[k].model.to_physical(curves.models[k].x)[j]
        here = torch.arange(len(physical)) == j
        column = own.model.columns(curves.effects[k])
        values_of_all = values[column].expand(len(physical), -1)
        model, physical = model.extended(physical, curves.effects[k], here, values_of_all)
        model = _held(model, curves.effects[k], here, physical)
        physical[j, : len(BASE)] = values[: len(BASE)]
        square[:, j], score[j] = curves.errors[k].square[:, j], own.score[j]
    more = torch.zeros(len(model.effects) - len(outcome.unevenness), len(physical), dtype=outcome.unevenness.dtype)
    outcome.unevenness = torch.cat([outcome.unevenness, more])
    outcome.final = Fitted(model=model, x=model.to_normalised(physical), score=score)
    outcome.final_errors = replace(errors, square=square)


def error_map(curves: Curves | None, outcome: Outcome, joint_names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Which variable carries what is missing, joint by joint, for ``diagnosis.json``; empty without curves.

    Args:
        curves: What was fitted.
        outcome: Where the search ended.
        joint_names: The joints.
    """
    if curves is None:
        return {}
    joints = {}
    for j in curves.joints.nonzero()[:, 0].tolist():
        k = curves.best(j)
        effect, part = curves.effects[k], float(curves.explained[k, j])
        before, after = (1e3 * float(e.mse[j].sqrt()) for e in (outcome.base_errors, curves.errors[k]))
        joints[joint_names[j]] = {
            "explained": {e.name: float(curves.explained[i, j]) for i, e in enumerate(curves.effects)},
            "best": effect.name,
            "best_label": f"{effect.variable} [{effect.parameters[-1].unit}]",
            "kind": "friction" if effect.resists else "torque",
            "sentence": _sentence(effect, part, before, after),
            "curve": _curve(curves.models[k], effect, j),
        }
    return joints


def _sentence(effect: type[FreeForm], part: float, before: float, after: float) -> str:
    if part < _WORTH_A_WORD:
        return "no curve over a single variable carries the error."
    kind = "friction" if effect.resists else "torque"
    return (
        f"a curve of {kind} over {effect.variable} explains {100 * part:.0f} % of the squared error above the floor "
        f"({before:.3g} to {after:.3g} mrad)."
    )


def _curve(fitted: Fitted, effect: type[FreeForm], joint: int) -> dict[str, list[float]]:
    """Where the knots are, and the torque or friction there beyond the base model [N m]."""
    values = fitted.model.to_physical(fitted.x)[joint, fitted.model.columns(effect)].tolist()
    return effect.curve(dict(zip((p.name for p in effect.parameters), values, strict=True)))


def _start(base: Fitted, effect: type[FreeForm], joints: torch.Tensor, ranges: dict[str, torch.Tensor]) -> Fitted:
    """The base model with a curve of nothing, its knots where the joints' variable is."""
    first, last = ranges[effect.variable]
    values = torch.zeros(len(joints), len(effect.parameters), dtype=torch.float64)
    for column, p in enumerate(effect.parameters):
        if p.name == "reach":
            values[:, column] = 0.5 * (last - first) if _has_center(effect) else torch.maximum(last, -first)
        elif p.name == "center":
            values[:, column] = 0.5 * (first + last)
        values[:, column] = values[:, column].clamp(p.lower, p.upper)
    model, physical = base.model.extended(base.model.to_physical(base.x), effect, joints, values)
    return Fitted.start(_held(model, effect, joints, physical), physical, tried=effect)


def _has_center(effect: type[FreeForm]) -> bool:
    return any(p.name == "center" for p in effect.parameters)


def _held(model: JointModel, effect: type[FreeForm], joints: torch.Tensor, physical: torch.Tensor) -> JointModel:
    """The model with a curve's knots held where they are."""
    lower, upper = model.lower.clone(), model.upper.clone()
    for column, p in enumerate(effect.parameters, start=model.columns(effect).start):
        if p.null is None:
            lower[joints, column] = upper[joints, column] = physical[joints, column]
    return replace(model, lower=lower, upper=upper)


def _ranges(problem: TwinProblem, base: Fitted) -> dict[str, torch.Tensor]:
    """From where to where each variable goes, (2, n) by its name."""
    path = problem.path
    effort, load = path.effort(base.model.to_physical(base.x)[:, BASE.index("armature")]), path.load()
    # what holds a load has its size, and pulls the other way
    seen = {"position": path.position, "torque": effort, "speed": path.speed(), "load on the gear": effort - load}
    steps = len(path.position) * problem.control_dt
    end = float(problem.dataset.session_start.max()) + steps
    result = {name: _quantiles(values) for name, values in seen.items()}
    n = path.position.shape[-1]
    result["time"] = torch.stack([torch.zeros(n), torch.full((n,), end)]).double()
    return result


def _quantiles(values: torch.Tensor) -> torch.Tensor:
    flat = values.flatten(0, 1).double().sort(dim=0).values
    last = len(flat) - 1
    return torch.stack([flat[round((1 - _REACHED) * last)], flat[round(_REACHED * last)]])
