"""A drive whose own loop runs faster than its commands come."""

import pytest
from bench_recordings import Bench, chirp, record
from problems import BENCH, env_cfg

from pace_optim.problem.problem import load_problem
from pace_optim.run.settings import FitSettings


def test_a_fast_loop_is_simulated_at_its_own_rate(tmp_path):
    bench = Bench(drive_dt=0.0005, noise=0.0)
    path = record(tmp_path / "fast.csv", bench, position=chirp(1.0))
    rmse = {}
    for drive_dt in (None, bench.drive_dt):
        problem = load_problem(BENCH, data=[path], env_cfg=env_cfg(), physics_dt=0.0005, drive_dt=drive_dt)
        truth = {
            "armature": bench.armature,
            "viscous_friction": bench.viscous,
            "friction": bench.coulomb,
            "encoder_bias": bench.bias,
            "delay": bench.delay / problem.control_dt,
        }
        score = problem.evaluator().residuals(problem.space.from_dict(truth)[None]).score
        rmse[drive_dt] = float(score.sqrt())
    assert rmse[bench.drive_dt] < 0.2 * rmse[None]


def test_a_rate_that_does_not_divide_the_time_step_is_refused_by_its_name():
    with pytest.raises(ValueError, match=r"drive_dt is 0\.0007 s, expected a whole fraction"):
        load_problem(BENCH, env_cfg=env_cfg(), drive_dt=0.0007)


def test_a_rate_that_is_no_time_is_refused():
    with pytest.raises(ValueError, match="drive_dt is 0"):
        FitSettings(task=BENCH, drive_dt=0.0)
