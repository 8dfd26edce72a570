"""The way down: on pieces, elsewhere where these end above the noise, on the whole; and resumed."""

import pytest
import torch
from problems import make_problem, normalised

from pace_optim.optimizers.derivatives import colour
from pace_optim.optimizers.least_squares import Descent, LeastSquaresCfg, checkpoint_of, least_squares
from pace_optim.optimizers.way_down import PIECES, WHOLE, WayDown, WayDownCfg
from pace_optim.recording.dataset import make_dataset


@pytest.fixture(scope="module")
def problem():
    return make_problem()


@pytest.fixture
def colouring(problem):
    return colour(problem.space, problem.trees, problem.joint_names)


def centre(problem):
    return torch.zeros(problem.space.size, dtype=torch.float64)


def test_the_beginning_is_the_first_quarter_of_the_training_samples(problem):
    dataset = make_dataset(problem.dataset.recordings, train_fraction=0.7)
    chosen, count = dataset.beginning(WayDownCfg().part), int(dataset.train.sum())
    assert not bool((chosen & ~dataset.train).any())
    assert int(chosen.sum()) == -(-count // 4)
    assert bool(chosen[: int(chosen.sum())].all())


def test_the_beginning_of_a_long_recording_is_no_longer_than_is_enough(problem, monkeypatch):
    dataset = make_dataset(problem.dataset.recordings, train_fraction=0.7)
    monkeypatch.setattr("pace_optim.recording.dataset._ENOUGH", 50)
    chosen = dataset.beginning(WayDownCfg().part)
    assert int(chosen.sum()) == 50 and bool((chosen[:50] & dataset.train[:50]).all())


def way(problem, colouring, **options):
    return WayDown(problem.training_evaluator(), colouring, **options)


def test_it_ends_at_the_truth_with_fewer_steps_than_least_squares_alone(problem, colouring):
    plain, staged = problem.training_evaluator(), way(problem, colouring)
    least_squares(plain, colouring, [centre(problem)])
    best = staged.run([centre(problem)])
    assert best.score < 1e-14 and best.stage == WHOLE
    torch.testing.assert_close(best.x, normalised(problem), atol=1e-4, rtol=0)
    assert staged.evaluator.simulated_steps < plain.simulated_steps


def test_a_start_that_is_better_than_its_end_on_pieces_is_kept(problem, colouring):
    staged = way(problem, colouring)
    astray = torch.full_like(centre(problem), 0.9)
    staged.descents = [Descent(x=astray, stage=PIECES, stop_reason="converged", scores=[1.0])]
    best = staged.run([normalised(problem)])
    assert torch.equal(best.x, normalised(problem)) and best.score < 1e-14


def test_most_of_the_way_is_gone_at_the_longer_step(problem, colouring):
    fine, coarse = problem.with_physics_dt(problem.physics_dt / 4), problem.training_evaluator()
    staged, alone = way(fine, colouring, coarse=coarse), way(fine, colouring)
    best, expected = staged.run([centre(problem)]), alone.run([centre(problem)])
    torch.testing.assert_close(best.x, expected.x, atol=1e-4, rtol=0)
    assert coarse.simulated_steps > 0 and staged.evaluator.simulated_steps < alone.evaluator.simulated_steps


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_it_is_searched_only_where_the_pieces_end_above_the_noise(problem, colouring, noise):
    """A descent that stops at once stands for one that ends in a wrong valley."""
    stuck = LeastSquaresCfg(max_iteration=1)
    staged = way(problem, colouring, noise_score=noise, cfg=WayDownCfg(on_pieces=stuck))
    budgets = []

    def search(budget):
        budgets.append(budget)
        return normalised(problem)

    best = staged.run([torch.full_like(centre(problem), 0.9)], search)
    spent = sum(d.simulations for d in staged.descents if d.stage == PIECES and d is staged.descents[0])
    assert budgets == ([] if noise else [round(WayDownCfg().search_budget * spent)])
    assert noise or best.score < 1e-14


def test_a_way_that_is_resumed_is_the_one_that_was_interrupted(problem, colouring):
    seen = []
    staged = way(problem, colouring, on_iteration=lambda _: seen.append(checkpoint_of(staged.descents)))
    whole = staged.run([centre(problem)])
    assert {d.stage for d in staged.descents} == {PIECES, WHOLE}
    for kept in seen:
        again = way(problem, colouring)
        again.descents = Descent.restore(kept)
        end = again.run([centre(problem)])
        assert torch.equal(end.x, whole.x) and end.scores == whole.scores
