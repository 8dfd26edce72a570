"""Finite differences: coloured as uncoloured, as central differences have them, and as wide as the noise asks."""

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

from pace_optim.estimate.derivatives import NARROW, Jacobian, stencil
from pace_optim.estimate.levenberg_marquardt import LinearModel
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import Colouring

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
    around = stencil(x, colouring, first=NARROW)
    vectors = torch.cat([x[None], around.vectors])
    return around.jacobian(problem.evaluator().residuals(problem.space.to_physical(vectors)))


def coloured(problem):
    return problem.colouring


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
        around = stencil(corner, coloured(pendulums))
        assert around.vectors.abs().max() <= 1.0
        assert torch.equal(around.steps.diagonal().sign(), -corner)
    at_lower = normalised(pendulums, PENDULUMS_TRUTH)
    at_lower[pendulums.space["friction"]] = -1.0
    column = differentiate(pendulums, at_lower, coloured(pendulums)).column(pendulums.space["friction"].start)
    assert float(column.abs().max()) > 1e-4


def test_an_entry_whose_bounds_are_equal_has_no_derivative():
    cfg = env_cfg()
    cfg.sim2real.set_bounds("friction", 0.3, 0.3)
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


# ---------------------------------------------------------------- along principal directions, as wide as the noise asks


def linear(joints, colours, slope):
    """A colouring, and the residuals of rows of x by a slope (T, n, size)."""

    def residuals(x):
        error = torch.einsum("tns,ms->mtn", slope, x)[:, :, None] + 0.1
        where = torch.ones(len(slope), 1, dtype=torch.bool)
        return Residuals(error=error, where=where, step=torch.arange(len(slope)))

    return Colouring(colours=colours, joints=joints), residuals


def slope_of(joints, seed):
    n, size = 1 + max(max(moved) for moved in joints if moved), len(joints)
    slope = torch.randn(50, n, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    for entry, moved in enumerate(joints):
        slope[:, sorted(set(range(n)) - set(moved)), entry] = 0.0
    return slope


@pytest.mark.parametrize(
    ("joints", "colours", "at"),
    [
        # entries 0 and 2 move the first tree, 1 and 3 the second, 4 is fixed, 5 moves both
        (((0,), (1, 2), (0,), (1, 2), (), (0, 1, 2)), ((0, 1), (2, 3), (5,)), (0.2, -0.9999, 0.3, 0.4, 0.0, -0.1)),
        (((0, 1), (2, 3), (0, 1), (2, 3)), ((0, 1), (2, 3)), (-0.4, 0.0, 0.2, 0.4)),  # nothing moves all: a Go2
        (
            ((0,), (1,), (2,), (0, 1), (0, 1, 2)),
            ((0, 1, 2), (3,), (4,)),
            (-0.4, 0.0, 0.2, 0.4, 0.1),
        ),
        (((0,), (0,), (0,)), ((0,), (1,), (2,)), (1.0, -1.0, 0.3)),  # one at its upper and one at its lower bound
        (((0,), (0,)), ((0,), (1,)), (1.0, -1.0)),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01, 1.0])
def test_derivatives_along_principal_directions_are_those_of_each_entry(joints, colours, at, noise):
    slope, x = slope_of(joints, 0), torch.tensor(at, dtype=torch.float64)
    colouring, residuals = linear(joints, colours, slope)
    hessian, score = None, 0.0
    for _ in range(3):
        around = stencil(x, colouring, hessian, noise, score)
        assert around.vectors.abs().max() <= 1.0
        every = residuals(torch.cat([x[None], around.vectors]))
        there = around.jacobian(every)
        for entry, moved in enumerate(joints):
            for joint in moved:
                torch.testing.assert_close(
                    there.column(entry)[:, 0, joint], slope[:, joint, entry], rtol=1e-4, atol=1e-6
                )
        (hessian, _), score = there.normal_equations(), float(every.score[0])
        assert around.noise(every) < 1e-12


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_an_entry_whose_influence_is_rounding_spoils_no_other_derivative(noise):
    """The bias of an upright axis, on a robot of 17 joints: all principal directions pointed along it."""
    joints, colours = ((0,),) * 6, tuple((entry,) for entry in range(6))
    slope = slope_of(joints, 3)
    slope[..., 4] *= 1e-15
    hessian = torch.einsum("tni,tnj->ij", slope, slope) / len(slope)
    hessian[4], hessian[:, 4] = 1e-15 * hessian[3], 1e-15 * hessian[:, 3]
    hessian[4, 4] = 1e-30
    colouring, residuals = linear(joints, colours, slope)
    x = torch.full((6,), 0.2, dtype=torch.float64)
    around = stencil(x, colouring, hessian, noise, 1.0)
    there = around.jacobian(residuals(torch.cat([x[None], around.vectors])))
    for entry in (0, 1, 2, 3, 5):
        torch.testing.assert_close(there.column(entry)[:, 0, 0], slope[:, 0, entry], rtol=1e-4, atol=1e-6)
    model = LinearModel(*there.normal_equations())
    assert model.step(x, 1e-9)[4] == x[4]


def test_a_step_changes_the_motion_by_ten_times_the_noise_and_at_most_by_the_error():
    joints, colours = ((0,),) * 3, ((0,), (1,), (2,))
    slope = 20 * slope_of(joints, 1)
    slope[..., 1] = 10 * slope[..., 0] + 0.3 * slope[..., 1]  # one combination hardly moves anything
    hessian = torch.einsum("tni,tnj->ij", slope, slope) / len(slope)
    x, colouring = torch.zeros(3, dtype=torch.float64), Colouring(colours=colours, joints=joints)
    for noise, error, expected in ((0.03, 1.0, 0.3), (1.0, 0.02, 0.02)):
        steps = stencil(x, colouring, hessian, noise, error**2).steps
        changes = ((steps @ hessian) * steps).sum(dim=1).sqrt()
        furthest = steps.abs().amax(dim=1) > 0.499 * min(1.0, 4 * noise / error)  # as far as a step may go
        assert furthest.sum() <= 1 and bool((changes <= expected * (1 + 1e-9)).all())
        assert changes[~furthest].tolist() == pytest.approx([expected] * int((~furthest).sum()))


def test_the_noise_of_a_rattle_is_measured():
    wave = 1e7 * torch.randn(2000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def residuals(x):
        error = (x.sum(dim=1)[:, None] + 0.02 * torch.sin(x @ wave.T))[..., None, None]
        return Residuals(error=error, where=torch.ones(2000, 1, dtype=torch.bool), step=torch.arange(2000))

    x, colouring = torch.tensor([0.3, -0.2], dtype=torch.float64), Colouring(colours=((0,), (1,)), joints=((0,),) * 2)
    around = stencil(x, colouring)
    assert around.noise(residuals(torch.cat([x[None], around.vectors]))) == pytest.approx(0.02 / 2**0.5, rel=0.1)


def test_bounds_that_are_far_too_wide_are_no_roughness():
    """A URDF with limits of 1000 N m: a hundred-thousandth of the bounds was a hundred times the armature."""

    def residuals(x):
        error = torch.stack([torch.sin(1e4 * x[:, 0]), x[:, 1]], dim=1)[:, :, None, None]
        return Residuals(error=error, where=torch.ones(2, 1, dtype=torch.bool), step=torch.arange(2))

    x, colouring = torch.tensor([2e-9, 1e-4], dtype=torch.float64), Colouring(colours=((0,), (1,)), joints=((0,),) * 2)
    hessian, score = torch.diag(torch.tensor([5e7, 0.5], dtype=torch.float64)), 5e-9
    around = stencil(x, colouring, hessian, 0.0, score)
    every = residuals(torch.cat([x[None], around.vectors]))
    assert around.noise(every) < 0.01 * score**0.5
    there = around.jacobian(every)
    assert there.column(0)[0].item() == pytest.approx(1e4, rel=1e-3) and there.column(1)[1].item() == pytest.approx(1.0)
