"""Curves of any form in place of effects: which variable carries what is missing, and where that says more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from pace_actuators.effects import available_effects, get_effect
from pace_actuators.effects.free_form import FreeForm
from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import percent
from pace_optim.diagnosis.checks.stated_facts import unlogged_effects
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, JudgingCfg
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.selection.comparison import within
from pace_optim.diagnosis.selection.decisions import Log, unlogged
from pace_optim.diagnosis.selection.rules import decide
from pace_optim.diagnosis.verdict.names import above_floor
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import COLUMN
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.recording.keys import CONDITIONS


@dataclass(frozen=True, kw_only=True, eq=False)
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


def fit_curves(
    fits: Fits,
    outcome: Outcome,
    floor: torch.Tensor,
    named: torch.Tensor,
    say: Callable[[str], None] = lambda _: None,
    log: Log = unlogged,
) -> Curves | None:
    """Fit every curve on the joints that are far from the floor in the end; ``None`` without such joints.

    A wrong effect can explain much of an error, and the right one leaves something where more is missing. A curve over
    one variable that halves the error that named effects leave says that those are not it. Where no effect is
    named a curve is held against the base model. Joints with an effect that the whole robot shares are left out.

    Args:
        fits: Fits models.
        outcome: Where the search ended.
        floor: Of each joint, (n,) [rad].
        named: Joints with effects that are named, (n,) bool.
        say: Shows how far it is.
        log: Gets the decision.
    """
    model = outcome.final.model
    joints = outcome.far(floor)
    for effect, has in zip(model.effects, model.has, strict=True):
        joints &= ~(has & effect.shared)
    if not bool(joints.any()) or not outcome.cfg.has("curves"):
        return None
    say("fitting curves of any form instead of effects")
    ranges = _ranges(outcome.problem, outcome.base, outcome.cfg.verdict.reached)
    every = (get_effect(name) for name in available_effects())
    curves = [each for each in every if issubclass(each, FreeForm) and each.variable in ranges]
    unlogged = unlogged_effects(outcome.problem.dataset, curves)
    varies = {effect: joints & ~unlogged.get(effect, torch.zeros_like(joints)) for effect in curves}
    effects = [effect for effect in curves if bool(varies[effect].any())]
    without = Fitted.start(outcome.base.model, outcome.base.physical)
    starts = [without, *(_start(outcome.base, each, varies[each], ranges[each.variable]) for each in effects)]
    models, errors = fits.on_joints(outcome.problem, starts, joints, outcome.base_errors)
    above = torch.stack([(each.mse - floor**2).clamp(min=0.0) for each in errors])
    explained = torch.where(joints, 1 - above[1:] / above[0].clamp(min=1e-30), 0.0)
    best = explained.argmax(dim=0)
    _, left = above_floor(outcome, floor)
    tried, cfg, instead = len(effects) * int(joints.sum()), outcome.cfg, torch.zeros_like(joints)
    for j in joints.nonzero()[:, 0].tolist():
        k, now = int(best[j]), outcome.final_errors if bool(named[j]) else errors[0]
        facts: dict[str, Any] = {"candidates": tried, "first": not named[j], "base": float(errors[0].mse[j])}
        facts |= {"floor": float(floor[j]), "left": float(left[j])}
        instead[j] = bool(decide("curves", [j], now, {effects[k].name: errors[1 + k]}, cfg=cfg, log=log, **facts))
    return Curves(
        joints=joints,
        effects=effects,
        models=models[1:],
        errors=errors[1:],
        explained=explained,
        instead=instead,
    )


def take_curves(outcome: Outcome, curves: Curves | None) -> Outcome:
    """The outcome with a joint's best curve in place of its effects, where that says more."""
    if curves is None:
        return outcome
    final, errors = outcome.final, outcome.final_errors
    for j in curves.instead.nonzero()[:, 0].tolist():
        here, k = torch.arange(len(curves.instead)) == j, curves.best(j)
        final, errors = final.with_joints(here, curves.models[k]), errors.with_joints(here, curves.errors[k])
    return replace(outcome, final=final, final_errors=errors)


def error_map(
    curves: Curves | None,
    joint_names: Sequence[str],
    base_errors: BlockErrors,
    *,
    joint_types: Sequence[JointType] = (),
    cfg: JudgingCfg = DEFAULT.judging,
) -> dict[str, dict[str, Any]]:
    """Which variable carries what is missing, joint by joint, for ``diagnosis.json``; empty without curves.

    Args:
        curves: What was fitted.
        joint_names: The joints.
        base_errors: Of the base model, as in the rest of the diagnosis.
        joint_types: Whether each joint turns or slides; none: all turn.
        cfg: What fall of the error is worth a word.
    """
    if curves is None:
        return {}
    joints = {}
    for j in curves.joints.nonzero()[:, 0].tolist():
        k = curves.best(j)
        effect, part = curves.effects[k], float(curves.explained[k, j])
        before, after = (float(each.mse[j].sqrt()) for each in (base_errors, curves.errors[k]))
        told = bool(curves.instead[j]) or not within(before**2, after**2, cfg.alike)
        types = joint_types[j : j + 1]
        formula = _formula(curves.models[k], effect, j, cfg.alike - 1) if told else ""
        joints[joint_names[j]] = {
            "explained": {e.name: float(curves.explained[i, j]) for i, e in enumerate(curves.effects)},
            "best": effect.name,
            "best_label": units_for(f"{effect.variable} [{effect.parameters[-1].unit}]", types),
            "kind": {"torque": "missing torque"}.get(effect.kind, effect.kind),
            "validation_rmse_before": before,
            "validation_rmse_after": after,
            "sentence": units_for(_sentence(effect, part, 1e3 * before, 1e3 * after, formula), types)
            if told
            else _NONE,
            "curve": _curve(curves.models[k], effect, j) if told else None,
            "formula": units_for(formula, types),
        }
    return joints


_NONE = "no curve over a single variable carries the error."


def _sentence(effect: type[FreeForm], part: float, before: float, after: float, formula: str) -> str:
    return (
        f"a curve of {effect.kind} over {effect.variable} explains {percent(part)} of the squared error above the "
        f"floor ({before:.3g} to {after:.3g} mrad)." + (f" It is smooth: {formula}." if formula else "")
    )


def _formula(fitted: Fitted, effect: type[FreeForm], joint: int, near: float) -> str:
    """The polynomial of fewest powers that stands for a curve, with units; empty where none does.

    Args:
        fitted: A model with the curve. Knots count by what they move, where it has derivatives.
        effect: The curve.
        joint: Of which joint.
        near: What it may leave (RMS), as a part of how the curve varies.
    """
    columns = fitted.model.columns(effect)
    values = fitted.physical[joint, columns]
    named = dict(zip([p.name for p in effect.parameters], values.tolist(), strict=True))
    curve, own = effect.curve(named), torch.tensor([p.null is not None for p in effect.parameters])
    moves = torch.ones(int(own.sum()), dtype=torch.float64)
    if fitted.jacobian is not None:
        moves = fitted.jacobian[columns, ..., joint].double().flatten(1).norm(dim=1)[own]
    each = iter(moves.tolist())
    weights = np.array([float(moves.max()) if knot == effect.zero else next(each) for knot in effect.knots])
    middle = named.get("center", 0.0)
    x, y = np.array(curve["at"]) - middle, np.array(curve["torque"])
    reach = float(np.abs(x).max())
    level = 0.0 if effect.zero is not None else np.average(y, weights=weights**2)
    for power in range(1, len(x) // 2 + 1):
        powers = np.arange(1 if effect.zero is not None else 0, power + 1)
        columns_of = (x[:, None] / reach) ** powers
        size = np.linalg.lstsq(weights[:, None] * columns_of, weights * y, rcond=None)[0]
        left, whole = (weights * each for each in (y - columns_of @ size, y - level))
        if left @ left <= near**2 * (whole @ whole):
            return _written(effect, size, powers, reach, middle)
    return ""


def _written(effect: type[FreeForm], sizes: np.ndarray, powers: np.ndarray, reach: float, middle: float) -> str:
    """A polynomial in parts of the reach as text, with the unit of each coefficient."""
    unit, over = effect.parameters[0].unit, effect.parameters[-1].unit
    x = f"({effect.variable} - {middle:.3g} {over})" if middle else effect.variable
    terms = []
    for size, power in zip(sizes.tolist(), powers.tolist(), strict=True):
        if abs(size) < np.finfo(np.float32).eps:
            continue
        raised = f"^{power}" if power > 1 else ""
        of = f"{unit}/({over}){raised}" if power else "" if unit == "1" else unit
        terms.append(" ".join(filter(None, [f"{size / reach**power:.3g}", of, f"{x}{raised}" if power else ""])))
    return f"{effect.equation.split(',')[0]} with f = {' + '.join(terms)}".replace("+ -", "- ")


def _curve(fitted: Fitted, effect: type[FreeForm], joint: int) -> dict[str, list[float]]:
    """Where the knots are, and the torque that is missing there, or all friction that there is [N m].

    Of what multiplies: the part by which it changes.
    """
    physical = fitted.physical[joint]
    names = [p.name for p in effect.parameters]
    values = dict(zip(names, physical[fitted.model.columns(effect)].tolist(), strict=True))
    return effect.law(values, *(float(physical[COLUMN[name]]) for name in ("friction", "viscous_friction")))


def _start(base: Fitted, effect: type[FreeForm], joints: torch.Tensor, seen: torch.Tensor) -> Fitted:
    """The base model with a curve of nothing, its knots where the joints' variable was seen, (2, n)."""
    first, last = seen
    has_center = "center" in _shape(effect)
    shape = {
        "reach": 0.5 * (last - first) if has_center else torch.maximum(last, -first),
        "center": 0.5 * (first + last),
    }
    values = torch.zeros(len(joints), len(effect.parameters), dtype=torch.float64)
    for column, p in enumerate(effect.parameters):
        if p.name in shape:
            values[:, column] = shape[p.name].clamp(p.lower, p.upper)
    model, physical = base.model.extended(base.physical, effect, joints, values)
    return Fitted.start(model.held(effect, _shape(effect), physical), physical, tried=effect)


def _shape(effect: type[FreeForm]) -> list[str]:
    """Parameters that say where the knots are."""
    return [p.name for p in effect.parameters if p.null is None]


def _ranges(problem: TwinProblem, base: Fitted, reached: float) -> dict[str, torch.Tensor]:
    """From where to where each variable goes in what is trained on, (2, n) by its name."""
    path, data = problem.path, problem.dataset
    effort, load = path.effort(base.physical[:, COLUMN["armature"]]), path.load()
    # what holds a load has its size, and pulls the other way
    seen = {"position": path.position, "torque": effort, "speed": path.speed(), "load on the gear": effort - load}
    time = data.session_start + problem.control_dt * torch.arange(len(path.position))[:, None]
    seen["time"] = time[..., None].expand(path.position.shape)
    ranges = {name: _quantiles(values, data.train, reached) for name, values in seen.items()}
    for name in CONDITIONS:
        if (logged := data.condition(name)) is not None:
            values = logged.values[data.trained()].transpose(1, 2).flatten(0, 1)
            ranges[name] = torch.stack([values.amin(dim=0), values.amax(dim=0)])
    return ranges


def _quantiles(values: torch.Tensor, where: torch.Tensor, reached: float) -> torch.Tensor:
    """Almost the smallest and the largest, (2, n), of (T', R, n) that leave out as many steps at the end as before.

    Args:
        values: The values.
        where: Which steps count, (T, R) bool.
        reached: The upper quantile.
    """
    left_out = (len(where) - len(values)) // 2
    flat = values[where[left_out : left_out + len(values)]].double().sort(dim=0).values
    last = len(flat) - 1
    return flat[[round((1 - reached) * last), round(reached * last)]]
