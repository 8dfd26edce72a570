"""What of a result comes from the physics step: closed forms, and recordings of physics with the step and without."""

import numpy as np
import pytest
import torch
from linear_problems import linear
from problems import BENCH, CALM, chirp, env_cfg, make_problem, replayed

from pace_envs import set_physics_dt
from pace_envs.task_source import EnvironmentRecord
from pace_optim import fit
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.physics_step import change_without_step, step_share
from pace_optim.estimate.least_squares import LeastSquaresCfg, least_squares
from pace_optim.identification.conclude import conclude
from pace_optim.identification.optimization import Optimization
from pace_optim.recording import save_recording
from pace_optim.run.folder import RunFolder
from pace_optim.run.open import open_problem
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine

START = torch.zeros(2, dtype=torch.float64)


def shares(left_in_error, part=1.0, known=(True, True)):
    """Of a linear problem whose residuals change by J (0.02, -0.3) and something that no parameter makes up for."""
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((2, 4000))
    columns[1] += 0.8 * columns[0]
    own = rng.standard_normal(4000)
    own -= columns.T @ np.linalg.solve(columns @ columns.T, columns @ own)
    noise = 1e-3 * rng.standard_normal(4000)
    jacobian, space = linear(columns, noise - left_in_error * 2e-3 * own)
    change = part * (np.array([0.02, -0.3]) @ columns + 2e-3 * own)
    series = torch.as_tensor(change)[:, None, None]
    return step_share(jacobian, series, space, START, np.array(known))


def test_a_value_less_its_share_is_what_a_fit_without_the_step_would_give():
    assert shares(1.0) == pytest.approx([0.02, -0.3])
    assert shares(0.0, part=1e-2) == pytest.approx(
        [2e-4, -3e-3]
    )  # 2 % of the noise: nobody can tell whether it is there
    assert shares(0.0, part=0.0).tolist() == [0.0, 0.0]


def test_what_has_no_error_bar_has_no_share():
    assert np.isnan(shares(1.0, known=(True, False))).tolist() == [False, True]
    assert np.isnan(shares(1.0, known=(False, False))).all()


def test_a_recording_that_the_step_itself_made_has_no_share():
    assert shares(0.0).tolist() == [0.0, 0.0]


def end_of(recorded, duration=2.0):
    """A fit at 2.5 ms to a recording of the bench: its problem, error, vector and what is known there."""
    problem = make_problem(replayed(chirp(duration), CALM, recorded, noise=1e-4))
    evaluator = problem.training_evaluator()
    truth = problem.space.from_dict(CALM)
    start = problem.space.to_normalised(truth)
    best = least_squares(evaluator, [start], LeastSquaresCfg(max_iteration=8))[0]
    known = assess(problem, evaluator, best.x)
    return problem, (problem.space.to_physical(best.x) - truth).numpy(), best.x, known


def fitted(step):
    """Shares of the physics step, errors and standard deviations, of a recording of physics at some step."""
    recorded = env_cfg()
    if step != 0.0025:
        set_physics_dt(recorded, step)
    problem, off, x, known = end_of(recorded)
    change = change_without_step(problem, problem.space.to_physical(x), known.jacobian.residuals)
    share = step_share(known.jacobian, change, problem.space, x, ~np.isnan(known.uncertainty.std))
    return share, off, known.uncertainty.std


def test_error_bars_with_the_step_hold_the_truth_where_those_of_noise_do_not():
    share, off, std = fitted(0.0005)
    assert (np.abs(off) > 5 * std).any()
    assert (np.abs(off) < 3 * np.hypot(std, share)).all() and (np.abs(share) < 2 * np.abs(off) + 3 * std).all()


def test_a_simulation_with_this_very_step_is_known_as_one():
    share, off, std = fitted(0.0025)
    assert not share.any() and (np.abs(off) < 4 * std).all()


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A recording of physics at an eighth of the step."""
    recorded = env_cfg()
    set_physics_dt(recorded, 0.0003125)
    path = tmp_path_factory.mktemp("log") / "log.npz"
    return save_recording(path, replayed(chirp(1.0, high=10.0), CALM, recorded, noise=1e-4))


@pytest.mark.slow
@pytest.mark.parametrize(("stated", "finest"), [(None, 0.00125), (0.0025, 0.0025)])
def test_a_step_that_shows_in_the_error_is_halved_unless_it_is_stated(log, tmp_path, stated, finest):
    settings = FitSettings(
        task=BENCH, data=[str(log)], optimizer="least_squares", log_dir=str(tmp_path), physics_dt=stated
    )
    result, folder = fit(settings, ProgressLine())
    assert open_problem(folder).physics_dt == result.physics_dt
    assert result.physics_dt <= finest and (stated is None or result.physics_dt == stated)
    share = result.rmse["train"]["all"] / 1e-4
    assert (share < 2.0) == (stated is None)


def test_a_fit_goes_on_at_a_finer_step_where_its_step_shows(tmp_path):
    recorded = env_cfg()
    set_physics_dt(recorded, 0.0003125)
    problem = make_problem(replayed(chirp(1.0), CALM, recorded, noise=4e-5))
    settings = FitSettings(task=BENCH, optimizer="least_squares", log_dir=str(tmp_path))
    run = Optimization(settings, problem, RunFolder(tmp_path), ProgressLine())
    result = conclude(run, EnvironmentRecord.of(BENCH, problem.env_cfg), run.run())
    assert [each.stage for each in run.descents] == ["pieces", "whole", "checked step of 0.00125 s, whole"]
    assert result.physics_dt == 0.00125 and run.ended.score < 0.5 * run.descents[1].score
