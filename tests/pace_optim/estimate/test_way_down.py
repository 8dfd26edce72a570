"""The way down: on pieces, by a search where these end above the noise, on the whole; and resumed."""

import pytest
import torch
from problems import TRUTH, chirp, env_cfg, make_problem, normalised, record, replayed

from pace_envs import set_physics_dt
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, checkpoint_of, least_squares
from pace_optim.estimate.way_down import PIECES, WHOLE, WayDown, WayDownCfg


@pytest.fixture(scope="module")
def problem():
    return make_problem()


def centre(problem):
    return torch.zeros(problem.space.size, dtype=torch.float64)


def test_pieces_are_a_share_of_the_windows_of_each_recording():
    problem = make_problem([replayed(chirp(seconds), TRUTH, env_cfg()) for seconds in (20.0, 3.0)])
    pieces = problem.on_pieces(0.25).dataset
    own = [sum(recording is each for each in pieces.recordings) for recording in problem.dataset.recordings]
    seconds = problem.dataset.train.sum(dim=0) * problem.control_dt
    assert own[1] == 1 and own[0] * 2.0 == pytest.approx(0.25 * float(seconds[0]), abs=2.0)
    assert all(bool(each) for each in pieces.train.any(dim=0))


def way(problem, noise_score=0.0, on_pieces=None, **options):
    cfg = WayDownCfg(share=0.25, **({} if on_pieces is None else {"on_pieces": on_pieces}))
    result = WayDown(problem, cfg=cfg, **options)
    result.noise_score = noise_score
    return result


def test_it_ends_at_the_truth_with_fewer_steps_than_least_squares_alone(problem):
    plain, staged = problem.training_evaluator(), way(problem)
    least_squares(plain, [centre(problem)])
    best = staged.run([centre(problem)])
    assert best.score < 1e-14 and best.stage == WHOLE
    torch.testing.assert_close(best.x, normalised(problem), atol=1e-4, rtol=0)
    assert staged.evaluator.simulated_steps < plain.simulated_steps


def test_a_start_that_is_better_than_its_end_on_pieces_is_kept(problem):
    staged = way(problem)
    astray = torch.full_like(centre(problem), 0.9)
    staged.descents = [Descent(x=astray, stage=PIECES, stop_reason="converged", scores=[1.0])]
    best = staged.run([normalised(problem)])
    assert torch.equal(best.x, normalised(problem)) and best.score < 1e-14


@pytest.mark.slow
def test_derivatives_of_a_longer_step_lead_to_the_end_of_the_finer_one(problem):
    cfg = env_cfg()
    set_physics_dt(cfg, cfg.sim.dt / 4)
    fine = make_problem(record(cfg=cfg)).with_physics_dt(cfg.sim.dt)
    nearby, plain = fine.training_evaluator(), fine.evaluator()
    best, expected = (least_squares(each, [centre(problem)])[0] for each in (nearby, plain))
    assert best.score < 1e-14 and expected.score < 1e-14
    torch.testing.assert_close(best.x, expected.x, atol=1e-4, rtol=0)
    at_the_finer_step = sum(rollout.simulated_steps for rollout in nearby._rollouts.values())
    assert at_the_finer_step < 0.65 * plain.simulated_steps


@pytest.mark.slow
def test_the_derivatives_of_the_error_bars_lead_from_beside_the_minimum_into_it():
    """A descent by derivatives of a longer step stops beside it."""
    cfg = env_cfg()
    set_physics_dt(cfg, cfg.sim.dt / 4)
    fine = make_problem(record(cfg=cfg)).with_physics_dt(cfg.sim.dt)
    nearby = fine.training_evaluator()
    beside = least_squares(nearby, [centre(fine)], LeastSquaresCfg(max_iteration=2))[0]
    known = assess(fine, fine.evaluator(), beside.x, beside, nearby)
    assert beside.score > 1e-8 and float(known.jacobian.residuals.score[0]) < 1e-6 * beside.score
    torch.testing.assert_close(known.x, normalised(fine), atol=1e-3, rtol=0)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_it_is_searched_only_where_the_pieces_end_above_the_noise(problem, noise):
    """A descent that stops at once stands for one that ends in a wrong valley."""
    stuck = LeastSquaresCfg(max_iteration=1)
    staged = way(problem, noise_score=noise, on_pieces=stuck)
    budgets = []

    def search(budget, around):
        budgets.append(budget)
        return [normalised(problem)]

    best = staged.run([torch.full_like(centre(problem), 0.9)], search)
    spent = sum(d.simulations for d in staged.descents if d.stage == PIECES and d is staged.descents[0])
    assert budgets == ([] if noise else [round(WayDownCfg().search_budget * spent)])
    assert noise or best.score < 1e-14


@pytest.mark.parametrize("missing", [0.0, 1.0])
def test_it_is_not_searched_where_missing_physics_leaves_as_much(problem, missing):
    stuck = LeastSquaresCfg(max_iteration=1)
    staged = way(problem, noise_score=1e-12, on_pieces=stuck)
    staged.missing_score = missing
    searched = []
    staged.run([torch.full_like(centre(problem), 0.9)], lambda *_: searched.append(0) or [])
    assert bool(searched) is not bool(missing)


def test_an_iteration_must_gain_more_where_the_score_is_far_above_the_noise():
    cfg = LeastSquaresCfg(noise_score=1e-8, loosest_enough=3e-2)
    assert [cfg.enough(score) for score in (1e-9, 1e-8, 4e-8, 1e-6)] == pytest.approx([2e-3, 2e-3, 8e-3, 3e-2])
    assert LeastSquaresCfg(noise_score=1e-8).enough(1e-6) == 2e-3


def test_a_way_that_had_left_pieces_goes_on_near_a_vector_on_the_whole(problem):
    """Resumed with descents on pieces alone, it had none to go on with."""
    resumed = way(problem)
    resumed.descents = [Descent(x=centre(problem), stage=PIECES, stop_reason="converged", scores=[1.0])]
    end = resumed.near(normalised(problem), LeastSquaresCfg(max_iteration=1))
    assert end.stage == WHOLE and [each.stage for each in resumed.descents] == [PIECES, WHOLE]


@pytest.mark.slow
def test_a_way_that_is_resumed_is_the_one_that_was_interrupted(problem):
    seen = []
    staged = way(problem, on_iteration=lambda _: seen.append(checkpoint_of(staged.descents)))
    whole = staged.run([centre(problem)])
    assert {d.stage for d in staged.descents} == {PIECES, WHOLE}
    for kept in seen:
        again = way(problem)
        again.descents = Descent.restore(kept)
        end = again.run([centre(problem)])
        assert torch.equal(end.x, whole.x) and end.scores == whole.scores
