"""Finite differences: coloured as uncoloured, in agreement with central differences, never out of the bounds."""

import pytest
import torch
from problems import (
    PENDULUMS_TRUTH,
    TRUTH,
    env_cfg,
    legs_chirp,
    make_problem,
    normalised,
    pendulums_cfg,
    pendulums_target,
    record,
)

from pace_optim.optimizers.jacobian import Colouring, Jacobian, colour, jacobian, perturbed
from pace_optim.problem.evaluator import Residuals

ANYMAL_TRUTH = {"armature": 0.1, "viscous_friction": 4.5, "friction": 0.05, "encoder_bias": 0.05, "delay": 4.6}


@pytest.fixture(scope="module")
def pendulums(tmp_path_factory):
    cfg = pendulums_cfg(tmp_path_factory.mktemp("model"))
    return make_problem(record(pendulums_target(), PENDULUMS_TRUTH, cfg=cfg), cfg=cfg)


@pytest.fixture(scope="module")
def anymal():
    cfg = env_cfg("Pace-AnymalD-v0")
    return make_problem(record(legs_chirp(cfg, 0.5), ANYMAL_TRUTH, cfg=cfg), cfg=cfg)


def differentiate(problem, x, colouring):
    neighbours, step = perturbed(x, colouring)
    residuals = problem.evaluator().residuals(problem.space.to_physical(torch.cat([x[None], neighbours])))
    return jacobian(residuals, step, colouring)


def coloured(problem):
    return colour(problem.space, problem.trees, problem.joint_names)


def uncoloured(problem):
    every = tuple(range(len(problem.joint_names)))
    return Colouring(
        colours=tuple((i,) for i in range(problem.space.size)), joints=tuple(every for _ in range(problem.space.size))
    )


def somewhere(problem, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 0.8 * (2 * torch.rand(problem.space.size, generator=generator, dtype=torch.float64) - 1)


def test_legs_share_colours_and_the_delay_has_its_own(anymal):
    colours = coloured(anymal).colours
    assert len(colours) == 4 * 3 + 1
    assert sorted(entry for entries in colours for entry in entries) == list(range(49))
    assert colours[-1] == (48,)
    legs = [{anymal.space.labels[i].split("/")[1].split("_")[0] for i in entries} for entries in colours[:-1]]
    assert legs == [{"LF", "RF", "LH", "RH"}] * 12


@pytest.mark.parametrize("problem", ["pendulums", "anymal"])
def test_coloured_equals_uncoloured(problem, request):
    problem = request.getfixturevalue(problem)
    x = somewhere(problem)
    together, alone = differentiate(problem, x, coloured(problem)), differentiate(problem, x, uncoloured(problem))
    for entry in range(problem.space.size):
        difference = (together.column(entry) - alone.column(entry)).abs().max()
        assert float(difference) <= 1e-6 * max(1.0, float(alone.column(entry).abs().max()))
    for one, other in zip(together.normal_equations(), alone.normal_equations(), strict=True):
        assert torch.allclose(one, other, rtol=1e-6, atol=1e-9 * float(other.abs().max()))


def test_the_bench_agrees_with_central_differences():
    problem = make_problem(record())
    x = somewhere(problem, seed=3)
    columns = differentiate(problem, x, coloured(problem))
    evaluator, step = problem.evaluator(), 1e-4
    for entry in range(problem.space.size):
        shift = torch.zeros_like(x)
        shift[entry] = step
        pair = evaluator.residuals(problem.space.to_physical(torch.stack([x + shift, x - shift]))).error
        central = (pair[0] - pair[1]) / (2 * step)
        error = (columns.column(entry) - central).abs().max() / central.abs().max()
        assert float(central.abs().max()) > 1e-6 and float(error) < 2e-2, problem.space.labels[entry]


def test_the_delays_column_holds_all_joints_and_each_others_only_its_own(pendulums):
    columns = differentiate(pendulums, somewhere(pendulums), coloured(pendulums))
    for entry, label in enumerate(pendulums.space.labels):
        moved = columns.column(entry).abs().amax(dim=(0, 1)) > 0
        key = label.split("/")[1]
        assert moved.tolist() == [key in ("left", "all"), key in ("right", "all")], label


def test_normal_equations_are_those_of_the_dense_jacobian(pendulums):
    columns = differentiate(pendulums, somewhere(pendulums), coloured(pendulums))
    dense = torch.stack([columns.column(i).reshape(-1) for i in range(pendulums.space.size)])
    error, samples = columns.residuals.error.reshape(-1), int(columns.residuals.where.sum())
    hessian, gradient = columns.normal_equations()
    assert torch.allclose(hessian, dense @ dense.T / samples, rtol=1e-10, atol=1e-18)
    assert torch.allclose(gradient, dense @ error / samples, rtol=1e-10, atol=1e-18)


def test_steps_at_the_bounds_point_inwards(pendulums):
    x = torch.ones(pendulums.space.size, dtype=torch.float64)
    for corner in (x, -x):
        neighbours, step = perturbed(corner, coloured(pendulums))
        assert neighbours.abs().max() <= 1.0
        assert torch.equal(step.sign(), -corner)
    at_lower = normalised(pendulums, PENDULUMS_TRUTH)
    at_lower[pendulums.space["friction"]] = -1.0
    column = differentiate(pendulums, at_lower, coloured(pendulums)).column(pendulums.space["friction"].start)
    assert float(column.abs().max()) > 1e-4


def test_an_entry_whose_bounds_are_equal_has_no_derivative():
    bounds = env_cfg().sim2real.bounds_params.clone()
    bounds[2] = 0.3
    cfg = env_cfg(bounds_params=bounds)
    problem = make_problem(record(truth=TRUTH, cfg=cfg), cfg=cfg)
    columns = differentiate(problem, somewhere(problem), coloured(problem))
    assert not columns.column(2).any() and columns.column(1).any()


@pytest.mark.parametrize("samples", [1120, 1403])
def test_the_normal_equations_are_the_same_however_the_residuals_lie_in_memory(samples):
    """A resumed fit computes them in a batch of another size: rounded otherwise, it ended 1e-9 elsewhere."""
    generator = torch.Generator().manual_seed(0)
    batch = torch.rand(samples, 8, 1, 1, generator=generator, dtype=torch.float64)
    columns = torch.rand(4, samples, 1, 1, generator=generator, dtype=torch.float64)
    colouring = Colouring(colours=tuple((entry,) for entry in range(4)), joints=((0,),) * 4)
    every = batch.permute(1, 0, 2, 3)
    where, step = torch.ones(samples, 1, dtype=torch.bool), torch.arange(samples)
    found = [
        Jacobian(residuals=Residuals(error=error, where=where, step=step), columns=columns, colouring=colouring)
        for error in (every[5:6], every[5:6].clone(memory_format=torch.contiguous_format), every.contiguous()[5:6])
    ]
    (hessian, gradient), *others = [each.normal_equations() for each in found]
    assert all(torch.equal(hessian, h) and torch.equal(gradient, g) for h, g in others)
