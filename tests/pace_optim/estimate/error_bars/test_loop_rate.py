"""The rate of the drives' loops where it is not stated: what recordings show of it, and what the error bars hold."""

import dataclasses

import numpy as np
import pytest
import torch
from problems import BENCH, CALM, chirp, env_cfg, make_problem, record, replayed

from pace_envs.task_source import EnvironmentRecord
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.loop_rate import LoopRates, _against, _lagrange, _with_longer_period, loop_rates
from pace_optim.estimate.least_squares import LeastSquaresCfg, least_squares
from pace_optim.identification.conclude import conclude
from pace_optim.identification.optimization import Optimization
from pace_optim.problem.drive_steps import set_drive_rate
from pace_optim.run.folder import RunFolder
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine

GAINS = {"stiffness": 85.0, "damping": 0.6}


def recorded_at(period, duration=1.0, noise=1e-4):
    """A recording that states its gains, of a drive whose loop has a period [s]; a model file's problem."""
    cfg = env_cfg()
    for drive in cfg.scene.robot.actuators.values():
        drive.drive_dt = period
    set_drive_rate(cfg)
    problem = make_problem(replayed(chirp(duration), CALM, cfg, drive=GAINS, noise=noise))
    return dataclasses.replace(problem, assumed_loop=problem.loop_dt)


def fitted(problem):
    """Where a fit from the truth ends, and what is known there."""
    evaluator = problem.training_evaluator()
    start = problem.space.to_normalised(problem.space.from_dict(CALM))
    best = least_squares(evaluator, [start], LeastSquaresCfg(max_iteration=8))[0]
    return best.x, assess(problem, evaluator, best.x)


@pytest.mark.slow
def test_a_recording_of_a_simulation_with_the_assumed_rate_and_this_very_step_says_nothing_of_others():
    problem = recorded_at(0.0025)
    x, known = fitted(problem)
    assert loop_rates(problem, x, known.jacobian, ~np.isnan(known.uncertainty.std)) is None


@pytest.mark.slow
def test_a_rate_that_fits_best_is_compared_with_the_others_too():
    """Its values depend on it all the same. Where the fit's own step was the best, none was compared."""
    problem = recorded_at(0.0005).with_loop(0.0005)
    problem = dataclasses.replace(problem, assumed_loop=problem.loop_dt)
    x, known = fitted(problem)
    rates = loop_rates(problem, x, known.jacobian, ~np.isnan(known.uncertainty.std))
    assert rates.chosen == 0.0005 and len(rates.periods) > 3


@pytest.mark.slow
def test_a_rate_is_fitted_to_its_end_where_the_derivatives_of_the_fit_do_not_serve():
    """A step that gained nothing passed for an end: the right rate was refused, and wrong values had small bars."""
    problem = recorded_at(0.001).with_loop(0.0005)
    problem = dataclasses.replace(problem, assumed_loop=problem.loop_dt)
    x, known = fitted(problem)
    shown = ~np.isnan(known.uncertainty.std)
    right = loop_rates(problem, x, known.jacobian, shown)
    wrong = dataclasses.replace(known.jacobian, columns=0.2 * known.jacobian.columns)  # steps five times too long
    rates = loop_rates(problem, x, wrong, shown)
    assert rates.chosen == right.chosen
    np.testing.assert_allclose(rates.values, right.values, rtol=2e-2, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("physics_dt", [0.0025, 0.0005])
def test_the_error_bars_hold_a_rate_that_a_log_with_gains_does_not_state(physics_dt):
    """Viscous friction was 53 % high with an error bar of 0.5 %, as a log that states gains seemed to state all."""
    problem = recorded_at(0.001).with_physics_dt(physics_dt)
    assert problem.assumes_loop_rate
    x, known = fitted(problem)
    rates = loop_rates(problem, x, known.jacobian, ~np.isnan(known.uncertainty.std))
    truth = problem.space.from_dict(CALM).numpy()
    off = rates.value_at(rates.chosen) - truth
    both = np.sqrt(known.uncertainty.std**2 + (rates.shares**2).sum(axis=0))
    assert (np.abs(off) < 3 * both).all()
    assert (np.abs(problem.space.to_physical(x).numpy() - truth) > 5 * known.uncertainty.std).any()
    assert (np.abs(rates.value_at(0.001) - truth) < 4 * known.uncertainty.std).all()
    assert 0.001 in rates.allowed


def test_a_later_loop_takes_away_viscous_friction_and_armature():
    """Seen h / 2 late, kp q and kd v lack kp h / 2 v and kd h / 2 a."""
    problem = recorded_at(0.0025)
    space, h = problem.space, 0.001
    x = space.to_normalised(space.from_dict(CALM))
    moved = space.to_physical(_with_longer_period(problem.evaluator(), x, h)) - space.to_physical(x)
    wanted = space.from_dict({**dict.fromkeys(CALM, 0.0), "viscous_friction": 85.0 * h / 2, "armature": 0.6 * h / 2})
    np.testing.assert_allclose(moved, wanted, atol=1e-12)


@pytest.mark.slow
def test_another_rate_that_explains_no_more_is_not_descended_with(tmp_path):
    """Where physics is missing, half of a fit's time went there."""
    problem = recorded_at(0.0025)
    own = problem.dataset.recordings[0]
    sway = 1e-3 * np.sin(5.0 * own.time)[:, None]
    told = dataclasses.replace(own, dof_pos=own.dof_pos + sway, drive=own.drive)
    problem = dataclasses.replace(make_problem(told), assumed_loop=problem.loop_dt)
    settings = FitSettings(task=BENCH, optimizer="least_squares", log_dir=str(tmp_path), check_consistency=False)
    run = Optimization(settings, problem, RunFolder(tmp_path), ProgressLine())
    run.run()
    assert run.descents[0].score > 10 * 1e-4**2
    assert not [each.stage for each in run.descents if each.stage.startswith("loop")]


@pytest.mark.slow
def test_a_fit_goes_on_with_loops_of_another_rate_that_explain_more(tmp_path):
    """A drive that saturates made 13 times the noise of it, and a diagnosis named an effect that was not there."""
    problem = recorded_at(0.001, noise=1e-5)
    settings = FitSettings(task=BENCH, optimizer="least_squares", log_dir=str(tmp_path), check_consistency=False)
    run = Optimization(settings, problem, RunFolder(tmp_path), ProgressLine())
    outcome = run.run()
    assert run.descents[0].score > 100 * 1e-5**2 * len(problem.joint_names)
    assert [each.stage for each in run.descents] == ["pieces", "loop of 0.001 s, pieces", "loop of 0.001 s, whole"]
    assert run.problem.loop_dt == 0.001 and run.problem.assumed_loop == problem.loop_dt
    result = conclude(run, EnvironmentRecord.of(BENCH, problem.env_cfg), outcome)
    assert result.loop_rate["used_s"] == 0.001 and result.times_noise < 1.5 and not result.std_means_nothing


def test_only_drive_dt_states_a_rate():
    problem = make_problem(record(drive=GAINS))
    assert not problem.assumes_loop_rate  # a configuration says how its drives run
    of_file = dataclasses.replace(problem, assumed_loop=problem.loop_dt)
    assert of_file.assumes_loop_rate
    faster = of_file.with_loop(0.001)
    assert faster.loop_dt == 0.001 and faster.physics_dt == 0.0005
    continuous = of_file.with_loop(0.0)
    assert continuous.physics_dt == of_file.physics_dt
    assert all(drive.implicit for drive in continuous.plain_cfg.scene.robot.actuators.values())


def of(likelihood, values=((1.0, 5.0), (0.7, 5.0), (0.6, 5.0))):
    return LoopRates(
        periods=(0.0025, 0.001, 0.0005),
        values=np.array(values),
        likelihood=np.array(likelihood),
        assumed=0.0025,
        fitted=0.0025,
    )


def test_a_rate_that_the_recordings_refute_is_not_used_and_the_spread_of_the_others_is_an_error():
    undecided, decided, assumed = of([1.0, 1.0, 1.0]), of([1e-4, 1.0, 1.0]), of([1.0, 1e-9, 1e-9])
    assert (undecided.chosen, decided.chosen, assumed.chosen) == (0.0025, 0.001, 0.0025)
    assert (decided.shares**2).sum(axis=0) == pytest.approx([0.2 * 0.1**2, 0.0], rel=1e-2)
    assert (undecided.shares**2).sum(axis=0)[0] == pytest.approx(0.5 * 0.3**2 + 0.125 * 0.4**2)
    assert (assumed.shares**2).sum() < 1e-9
    assert assumed.allowed == (0.0025,)


def test_both_values_of_what_depends_on_the_rate_are_told():
    space = make_problem().space
    values = np.tile(space.to_physical(space.start).numpy(), (3, 1))
    values[:, 1] = [0.23, 0.15, 0.11]
    known = np.ones(space.size, dtype=bool)
    (told,) = of([1.0, 1.0, 1.0], values).sentences(space, known)
    assert "viscous friction of servo is 0.23 with 0.4 kHz and 0.11 with 2 kHz" in told and "--drive_dt" in told
    found = values[0] + np.where(np.arange(space.size) == 1, 0.05, 0.0)
    (told,) = of([1.0, 1.0, 1.0], values).at(space, found).sentences(space, known)
    assert "is 0.28 with 0.4 kHz and 0.16 with 2 kHz" in told  # the first is the result's
    (told,) = of([1e-4, 1.0, 1.0], values).sentences(space, known)
    assert "allow 1 kHz to 2 kHz; 1 kHz is used" in told
    written = of([1e-4, 1.0, 1.0], values).to_dict(space)
    assert (
        written["used_s"] == 0.001
        and written["assumed_s"] == 0.0025
        and set(written["parameters"]) == {"0.001", "0.0005"}
    )


def test_periods_between_and_beyond_the_simulated_ones_follow_by_their_polynomial():
    nodes = (2.5, 1.0, 0.5)
    assert _lagrange(nodes, 1.0).tolist() == [0.0, 1.0, 0.0]
    for at in (0.025, 0.1, 2.0):
        assert _lagrange(nodes, at) @ (3.0 + 2.0 * np.array(nodes) ** 2) == pytest.approx(3.0 + 2.0 * at**2)


def test_chi_squared_counts_in_the_noise_along_the_difference():
    rng = np.random.default_rng(0)
    noise, apart = 1e-3 * rng.standard_normal(5000), 2e-4 * rng.standard_normal(5000)
    errors = torch.as_tensor(np.stack([noise, noise + apart]))[:, :, None, None]
    where = torch.ones(5000, 1, dtype=torch.bool)
    squares = [float(each.square().sum()) for each in errors]
    found = _against(errors, np.eye(2), where, squares[0])
    assert found[0] == 0.0 and found[1] == pytest.approx(200.0, rel=0.3)
    # half of what is left is no noise: the second one is worse by a twentieth of that
    found = _against(errors, np.eye(2), where, 0.5 * squares[0])
    worse = (squares[1] - squares[0]) / (0.25 * squares[0])
    assert found[0] == 0.0 and found[1] == pytest.approx((2 * worse) ** 2) and found[1] < 1.0


def test_a_rate_that_is_worse_by_less_than_the_noise_is_known_is_not_refuted():
    rng = np.random.default_rng(0)
    noise = 1e-3 * rng.standard_normal(100_000)
    apart = 3e-5 * rng.standard_normal(100_000)  # 90 in χ², and a thousandth of the noise's variance
    errors = torch.as_tensor(np.stack([noise, noise + apart]))[:, :, None, None]
    found = _against(errors, np.eye(2), torch.ones(100_000, 1, dtype=torch.bool), float((noise**2).sum()))
    assert 0.0 < found.max() < 1.0
