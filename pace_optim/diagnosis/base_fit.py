"""The base model of each joint, fitted at the step of the diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.descent import fit_side_by_side, fit_to_whole
from pace_optim.diagnosis.fitted import Fitted
from pace_optim.diagnosis.model import BASE, JointModel
from pace_optim.joint_twins import measured_path, reference_path, twin_problem
from pace_optim.joint_twins.problem import TwinProblem
from pace_optim.problem import Problem

_FAR = 0.02
"""Where a normalised parameter has moved further than this the reference is simulated again."""
_ROUNDS = 3


def fit_base(
    problem: Problem,
    physical: torch.Tensor,
    effects: Sequence[type[Effect]] = (),
    say: Callable[[str], None] = lambda _: None,
) -> tuple[TwinProblem, Fitted, torch.Tensor]:
    """Fit the base model from a first guess; the reference that the joints move along follows.

    Args:
        problem: The whole robot, without effects.
        physical: First guess of its parameters, (size,).
        effects: Effects whose influence on the rigid bodies is wanted.
        say: Shows how far it is.

    Returns:
        The problem of single joints, the fitted model with its Jacobian, and the typical torque of each joint
        (n,) [N m].
    """
    model = JointModel.base(problem)
    names = [effect.name for effect in effects if effect.overrides("write_model")]
    fitted = Fitted.start(model, joint_vectors(problem, physical))
    at_control_step = problem.with_physics_dt(problem.control_dt)
    along = measured_path if problem.joints_stand_alone else reference_path
    for i in range(_ROUNDS):
        say(f"base model, round {i + 1}")
        path = along(at_control_step, whole_vector(problem, model.to_physical(fitted.x)))
        coarse = twin_problem(at_control_step, path).in_windows()
        before, fitted = fitted, fit_side_by_side(coarse, [fitted], max_iteration=6)[0]
        if float((fitted.x - before.x).abs().max()) < _FAR:
            break
    path = along(problem, whole_vector(problem, model.to_physical(fitted.x)), names)
    twins = twin_problem(problem, path)
    fitted = fit_to_whole(twins, [fit_side_by_side(twins.in_windows(), [fitted], max_iteration=5)[0]])[0]
    x = fitted.x
    return twins, fitted, path.typical_effort(model.to_physical(x)[:, BASE.index("armature")])


def joint_vectors(problem: Problem, physical: torch.Tensor) -> torch.Tensor:
    """The base parameters of each joint, (n, 5), of a vector of the whole robot."""
    n, space = len(problem.joint_names), problem.space
    return torch.stack([physical[space[name]].expand(n) for name in BASE], dim=1)


def whole_vector(problem: Problem, joints: torch.Tensor) -> torch.Tensor:
    """A vector of the whole robot of each joint's base parameters (n, 5); the delay is the joints' median."""
    space = problem.space
    result = space.to_physical(space.start)
    for k, name in enumerate(BASE):
        result[space[name]] = joints[:, k].median() if name == "delay" else joints[:, k]
    return result
