"""Refining goes from the beginning of a recording to all of it, and must end where least squares alone ends."""

import pytest
import torch
from problems import make_problem, normalised

from pace_optim.optimizers.jacobian import colour, jacobian, perturbed
from pace_optim.optimizers.least_squares import Descent, least_squares
from pace_optim.optimizers.refine import BEGINNING, refine
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
    chosen, count = dataset.beginning(BEGINNING), int(dataset.train.sum())
    assert not bool((chosen & ~dataset.train).any())
    assert int(chosen.sum()) == -(-count // 4)
    assert bool(chosen[: int(chosen.sum())].all())


def test_the_beginning_of_a_long_recording_is_no_longer_than_is_enough(problem, monkeypatch):
    dataset = make_dataset(problem.dataset.recordings, train_fraction=0.7)
    monkeypatch.setattr("pace_optim.recording.dataset._ENOUGH", 50)
    chosen = dataset.beginning(BEGINNING)
    assert int(chosen.sum()) == 50 and bool((chosen[:50] & dataset.train[:50]).all())


def test_it_ends_at_the_truth_with_fewer_steps_than_least_squares_alone(problem, colouring):
    plain, refined = problem.training_evaluator(), problem.training_evaluator()
    least_squares(plain, colouring, [centre(problem)])
    best = refine(refined, colouring, [Descent(x=centre(problem))])[0]
    assert best.score < 1e-14
    torch.testing.assert_close(best.x, normalised(problem), atol=1e-4, rtol=0)
    assert refined.simulated_steps < plain.simulated_steps


def test_the_derivatives_that_it_starts_with_are_those_of_where_it_starts(problem, colouring):
    seen = []
    refine(
        problem.training_evaluator(),
        colouring,
        [Descent(x=centre(problem))],
        lambda descents: seen.append((descents[0].x.clone(), descents[0].jacobian)),
    )
    x, given = seen[0]
    assert given is not None
    neighbours, step = perturbed(x, colouring)
    physical = problem.space.to_physical(torch.cat([x[None], neighbours]))
    fresh = jacobian(problem.training_evaluator().residuals(physical), step, colouring)
    torch.testing.assert_close(given.columns, fresh.columns, atol=1e-8, rtol=1e-5)
    torch.testing.assert_close(given.residuals.error, fresh.residuals.error, atol=1e-14, rtol=0)


def test_a_start_that_is_better_than_its_coarse_end_is_kept(problem, colouring, monkeypatch):
    def led_astray(evaluator, colouring, starts, cfg=None, on_iteration=None, where=None):
        return list(starts) if where is None else [Descent(x=torch.full_like(x, 0.9)) for x in starts]

    monkeypatch.setattr("pace_optim.optimizers.refine.least_squares", led_astray)
    best = refine(problem.training_evaluator(), colouring, [Descent(x=normalised(problem))])[0]
    assert torch.equal(best.x, normalised(problem)) and best.score < 1e-14


def test_most_of_the_way_is_gone_at_the_longer_step(problem, colouring):
    fine, coarse = problem.with_physics_dt(problem.physics_dt / 4).training_evaluator(), problem.training_evaluator()
    alone = problem.with_physics_dt(problem.physics_dt / 4).training_evaluator()
    best = refine(fine, colouring, [Descent(x=centre(problem))], coarse=coarse)[0]
    expected = refine(alone, colouring, [Descent(x=centre(problem))])[0]
    torch.testing.assert_close(best.x, expected.x, atol=1e-4, rtol=0)
    assert coarse.simulated_steps > 0 and fine.simulated_steps < alone.simulated_steps
