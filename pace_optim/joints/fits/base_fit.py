"""The base model of each joint, fitted at the step of the diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from pace_actuators import resolve_joint_values
from pace_actuators.effects import Effect, EffectCfg
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.fitting_cfg import DEFAULT, FittingCfg
from pace_optim.joints.fits.model import BASE, COLUMN, JointModel, found_effects, whole_values
from pace_optim.joints.simulation import ReferencePath, measured_path, reference_path, twin_problem
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.problem.problem import Problem


def fit_base(
    fits: Fits,
    problem: Problem,
    physical: torch.Tensor,
    effects: Sequence[type[Effect]] = (),
    say: Callable[[str], None] = lambda _: None,
    own: Sequence[EffectCfg] = (),
) -> tuple[TwinProblem, Fitted, torch.Tensor]:
    """Fit the base model from a first guess; the reference that the joints move along follows.

    Args:
        problem: The whole robot, without effects.
        physical: First guess of its parameters, (size,).
        effects: Effects whose influence on the rigid bodies is wanted.
        own: Effects with values that the base model has too.

    Returns:
        The problem of single joints, the fitted model with its Jacobian, and the typical torque of each joint
        (n,) [N m].
    """
    fitted = _with_own_effects(problem, physical, own)
    every = dict.fromkeys([*effects, *(cfg.effect_class for cfg in own)])
    names = [effect.name for effect in every if effect.overrides("write_model")]
    along = measured_path if problem.joints_stand_alone else reference_path
    twins, fitted = _fit_along(fits, problem, fitted, along, names, say)
    if along is measured_path and float(fitted.score.max()) > fits.cfg.away**2:
        twins, fitted = _fit_along(fits, problem, fitted, reference_path, names, say)
    armature = fitted.physical[:, COLUMN["armature"]]
    return twins, fitted, twins.path.typical_effort(armature)


def _fit_along(
    fits: Fits,
    problem: Problem,
    fitted: Fitted,
    along: Callable[..., ReferencePath],
    model_effects: Sequence[str],
    say: Callable[[str], None],
) -> tuple[TwinProblem, Fitted]:
    """The joints along a reference that follows the model, and the model fitted there.

    Args:
        along: Makes the reference: ``measured_path`` or ``reference_path``.
        model_effects: Effects whose influence on the rigid bodies is wanted.
    """

    def path(of: Problem, model_effects: Sequence[str] = ()) -> ReferencePath:
        late = later_than_most(fitted.physical[:, COLUMN["delay"]], cfg=fits.cfg)
        if along is measured_path:
            return measured_path(of, whole_vector(of, fitted.physical), model_effects)
        return reference_path(*whole_robot(of, fitted), model_effects, late=late, away=fits.cfg.away)

    cfg = fits.cfg
    at_control_step = problem.with_physics_dt(problem.coarsest_dt)
    for i in range(cfg.rounds):
        say(f"fitting the base model of each joint, round {i + 1}")
        coarse = twin_problem(at_control_step, path(at_control_step)).in_windows()
        before, fitted = fitted, fits.side_by_side(coarse, [fitted], cfg.again)[0]
        if float((fitted.x - before.x).abs().max()) < fits.cfg.moved:
            break
    twins = twin_problem(problem, path(problem, model_effects))
    return twins, fits.to_whole(twins, fits.side_by_side(twins.in_windows(), [fitted], cfg.again))[0]


def later_than_most(delay: torch.Tensor, *, cfg: FittingCfg = DEFAULT) -> torch.Tensor:
    """Joints that are later than the delay that most joints have, (n,) bool; of one or two joints none is.

    Args:
        delay: Of each joint, (n,) [control steps].
        cfg: From when on a joint is late.
    """
    behind = delay - delay.median()
    scatter = behind.abs().median()
    return (behind > max(cfg.late, cfg.scatters * float(scatter))) & (len(delay) > 2)


def _with_own_effects(problem: Problem, physical: torch.Tensor, own: Sequence[EffectCfg]) -> Fitted:
    """A model of each joint with the base parameters and effects of the whole robot."""
    model, values, names = JointModel.base(problem), joint_vectors(problem, physical), problem.joint_names
    for cfg in own:
        effect, joints = cfg.effect_class, cfg.joints(names)
        null = [p.start if p.null is None else p.null for p in effect.parameters]
        known = {p.name: resolve_joint_values(cfg.values[p.name], joints, field=p.name) for p in effect.parameters}
        rows = torch.tensor([null] * len(names), dtype=torch.float64)
        has = torch.tensor([name in joints for name in names])
        rows[has] = torch.stack([known[p.name].double() for p in effect.parameters], dim=1)
        model, values = model.extended(values, effect, has, rows)
        if cfg.shared:
            model = replace(model, shared=model.shared | {effect})
    return Fitted.start(model, values)


def joint_vectors(problem: Problem, physical: torch.Tensor) -> torch.Tensor:
    """The base parameters of each joint, (n, 5), of a vector of the whole robot."""
    n, space = len(problem.joint_names), problem.space
    return torch.stack([physical[space[name]].expand(n) for name in BASE], dim=1)


def whole_robot(problem: Problem, fitted: Fitted) -> tuple[Problem, torch.Tensor]:
    """The whole robot with the effects of a model of its joints, and its parameters, (size,)."""
    problem = problem.with_effects(found_effects(fitted.model, problem.joint_names))
    return problem, problem.space.from_dict(whole_values(fitted.model, fitted.x, problem.joint_names))


def whole_vector(problem: Problem, joints: torch.Tensor) -> torch.Tensor:
    """A vector of the whole robot of each joint's base parameters (n, 5); the delay is the joints' median."""
    space = problem.space
    result = space.to_physical(space.start)
    for k, name in enumerate(BASE):
        result[space[name]] = joints[:, k].median() if name == "delay" else joints[:, k]
    return result
