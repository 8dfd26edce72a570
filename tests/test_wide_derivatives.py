"""Where links rattle, small steps tell of the rattling: derivatives are taken over steps as wide as the error."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pace_optim.optimizers.jacobian import Colouring
from pace_optim.optimizers.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.optimizers.wide_derivatives import jacobian_over, moved_along, principal_directions
from pace_optim.problem.evaluator import Residuals
from pace_optim.run.folder import RunFolder
from pace_optim.run.history import History

SAMPLES, NOISE, RATTLE = 400, 0.1, 0.02
TARGET = torch.tensor([-0.5, 0.3, 0.1], dtype=torch.float64)
DENSE = Colouring(colours=((0,), (1,), (2,)), joints=((0,),) * 3)


class Rattling:
    """Residuals that are linear, with noise, and with a rattle of a fifth of it that a millionth changes.

    A rotor's inertia, a delay that is nearly the same, and something else: one combination hardly moves anything.
    """

    def __init__(self, seed=0, rattle=RATTLE):
        generator = torch.Generator().manual_seed(seed)

        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        self.slope = draw(SAMPLES, 3)
        self.slope[:, 1] = 10 * self.slope[:, 0] + 3 * self.slope[:, 1]
        self.noise, self.phase, self.wave = NOISE * draw(SAMPLES), 6 * draw(SAMPLES), 1e6 * draw(SAMPLES, 3)
        self.rattle, self.space, self.rows = rattle, SimpleNamespace(to_physical=lambda x: x), 0

    def residuals(self, x, where=None):
        self.rows += len(x)
        error = (x - TARGET) @ self.slope.T + self.noise + self.rattle * torch.sin(x @ self.wave.T + self.phase)
        where = torch.ones(SAMPLES, 1, dtype=torch.bool)
        return Residuals(error=error[..., None, None], where=where, step=torch.arange(SAMPLES))

    def again(self):
        return io.StringIO()  # any context


def start():
    return torch.tensor([0.5, 0.0, -0.5], dtype=torch.float64)


def test_a_motion_that_does_not_rattle_is_not_rough():
    best = least_squares(Rattling(rattle=0.0), DENSE, [start()])[0]
    assert best.directions is None and best.stop_reason == "converged"
    assert (best.x - TARGET).abs().max() < 0.1


@pytest.mark.parametrize("seed", range(6))
def test_a_weak_combination_is_found_and_its_error_bars_are_those_without_the_rattle(seed):
    """Over steps of a hundredth its derivative was the rattle's: it hardly moved, with error bars near zero."""
    rattling, calm = Rattling(seed), Rattling(seed, rattle=0.0)
    best, right = (least_squares(each, DENSE, [start()])[0] for each in (rattling, calm))
    bars = []
    for end, on in ((best, rattling), (right, calm)):
        vectors, steps = end.around(end.x, DENSE)
        end.look(end.x, on.residuals(torch.cat([end.x[None], vectors])), steps, DENSE)
        assert end.jacobian is not None and end.jacobian.is_wide == (end is best)
        hessian, _ = end.jacobian.normal_equations()
        bars.append((torch.linalg.inv(hessian) * end.score / SAMPLES).diagonal().sqrt())
    assert torch.allclose(bars[0], bars[1], rtol=0.15)
    assert ((best.x - TARGET).abs() < 3 * bars[0]).all()
    assert best.score < 1.1 * (right.score + RATTLE**2 / 2)


def linear(joints, colours, slope):
    """A colouring, and the residuals of rows of x by a slope (T, n, size)."""

    def residuals(x):
        error = torch.einsum("tns,ms->mtn", slope, x)[:, :, None] + 0.1
        where = torch.ones(len(slope), 1, dtype=torch.bool)
        return Residuals(error=error, where=where, step=torch.arange(len(slope)))

    return Colouring(colours=colours, joints=joints), residuals


def test_derivatives_over_directions_are_those_of_each_entry_for_trees_side_by_side():
    """Entries 0 and 2 move the first tree, 1 and 3 the second, 4 is fixed, 5 moves both."""
    joints, colours = ((0,), (1, 2), (0,), (1, 2), (), (0, 1, 2)), ((0, 1), (2, 3), (5,))
    slope = torch.randn(50, 3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for entry, moved in enumerate(joints):
        for joint in set(range(3)) - set(moved):
            slope[:, joint, entry] = 0.0
    colouring, residuals = linear(joints, colours, slope)
    x = torch.tensor([0.2, -0.9999, 0.3, 0.4, 0.0, -0.1], dtype=torch.float64)
    directions = 1e-2 * torch.eye(6, dtype=torch.float64)
    for _ in range(2):
        vectors, steps = moved_along(x, directions, colouring)
        assert vectors.abs().max() <= 1.0
        there = jacobian_over(residuals(torch.cat([x[None], vectors])), steps, colouring)
        for entry, moved in enumerate(joints):
            for joint in moved:
                torch.testing.assert_close(there.column(entry)[:, 0, joint], slope[:, joint, entry])
        directions = principal_directions(there, x)
    hessian, _ = there.normal_equations()
    changes = (directions @ hessian @ directions.T).diagonal()
    at_most = directions.abs().amax(dim=1) > 0.499
    score = float(there.residuals.score[0])
    assert all(abs(changes[i] - score) < 1e-6 * score or at_most[i] for i in (0, 1, 2, 3, 5))
    assert not directions[4].any() and directions[1].count_nonzero() == 1  # fixed; at its bound: alone


@pytest.mark.parametrize(
    ("joints", "colours"),
    [
        (((0, 1), (2, 3), (0, 1), (2, 3)), ((0, 1), (2, 3))),  # legs alike, and nothing moves all: a fault on a Go2
        (((0,), (1,), (2,), (0, 1), (0, 1, 2)), ((0, 1, 2), (3,), (4,))),  # one moves some of the trees
    ],
)
def test_derivatives_over_directions_are_right_whatever_moves_what(joints, colours):
    n, size = 1 + max(max(moved) for moved in joints), len(joints)
    slope = torch.randn(50, n, size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for entry, moved in enumerate(joints):
        slope[:, sorted(set(range(n)) - set(moved)), entry] = 0.0
    colouring, residuals = linear(joints, colours, slope)
    x, directions = torch.linspace(-0.4, 0.4, size).double(), 1e-2 * torch.eye(size, dtype=torch.float64)
    for _ in range(2):
        vectors, steps = moved_along(x, directions, colouring)
        there = jacobian_over(residuals(torch.cat([x[None], vectors])), steps, colouring)
        directions = principal_directions(there, x)
        for entry, moved in enumerate(joints):
            torch.testing.assert_close(there.column(entry)[:, 0, list(moved)], slope[:, list(moved), entry])


def test_a_rough_descent_that_was_interrupted_goes_on_as_if_it_had_not_been(tmp_path):
    whole = least_squares(Rattling(), DENSE, [start()])[0]
    for stop in range(1, whole.iteration):

        def interrupt(descents, stop=stop):
            if descents[0].iteration == stop:
                raise KeyboardInterrupt

        descents = [Descent(x=start())]
        with pytest.raises(KeyboardInterrupt):
            least_squares(Rattling(), DENSE, descents, on_iteration=interrupt)
        folder = RunFolder(tmp_path)
        folder.write_checkpoint(None, descents, [], 0, History())
        on = least_squares(Rattling(), DENSE, Descent.restore(folder.read_checkpoint()))[0]
        assert torch.equal(on.x, whole.x) and on.scores == whole.scores and on.iteration == whole.iteration


def test_a_checkpoint_of_a_run_that_knew_of_no_wide_steps_is_read(tmp_path):
    folder = RunFolder(tmp_path)
    folder.write_checkpoint(None, [Descent(x=start())], [], 0, History())
    with np.load(tmp_path / "checkpoint.npz") as file:
        arrays = {name: file[name] for name in file.files if name != "descent_directions"}
    np.savez(tmp_path / "checkpoint.npz", **arrays)
    restored = Descent.restore(folder.read_checkpoint())[0]
    assert restored.directions is None and torch.equal(restored.x, start())


def test_what_it_takes_is_no_more_than_a_few_looks():
    rattling = Rattling()
    best = least_squares(rattling, DENSE, [start()], LeastSquaresCfg())[0]
    assert best.iteration < 20 and rattling.rows < 120
