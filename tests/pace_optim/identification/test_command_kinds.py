"""Position, velocity and torque commands, and their sum: each drive is identified to its noise."""

from __future__ import annotations

import numpy as np
import pytest
from bench_recordings import CONTROL_DT, Bench, chirp, record

from pace_optim.identification.fit import fit
from pace_optim.problem.log_and_robot import contradicted_limits
from pace_optim.recording import Recording
from pace_optim.run.settings import FitSettings

TASK = "Pace-TestBench-v0"


def fitted(tmp_path, *paths, effects=(), physics_dt=1.25e-3):
    """The result of a fit of recordings."""
    settings = FitSettings(
        task=TASK,
        data=[str(path) for path in paths],
        effects=list(effects),
        optimizer="least_squares",
        physics_dt=physics_dt,
        log_dir=str(tmp_path / "logs"),
        check_consistency=False,
    )
    return fit(settings)[0]


def check_truth(result, bench: Bench, tolerance: float = 0.03):
    """Base parameters as they are, and no more error than the noise."""
    found = {name: next(iter(values.values())) for name, values in result.parameters.items()}
    assert result.rmse["train"]["all"] < 1.15 * bench.noise
    assert result.delay_s == pytest.approx(bench.delay, abs=2e-4)
    for name, true in (("armature", bench.armature), ("viscous_friction", bench.viscous), ("friction", bench.coulomb)):
        assert found[name] == pytest.approx(true, rel=tolerance), name


@pytest.mark.slow
def test_a_drive_follows_velocity_targets_beside_positions(tmp_path):
    bench, position = Bench(kd=2.0, delay=0.0062), chirp(1.5)
    record(tmp_path / "a.csv", bench, position, np.gradient(position, CONTROL_DT))
    check_truth(fitted(tmp_path, tmp_path / "a.csv"), bench)


@pytest.mark.slow
def test_a_torque_is_fed_forward(tmp_path):
    bench, position = Bench(), chirp(1.5)
    record(tmp_path / "a.csv", bench, position, effort=1.96 * np.sin(position) + 0.3 * np.sign(np.gradient(position)))
    check_truth(fitted(tmp_path, tmp_path / "a.csv"), bench)


@pytest.mark.slow
def test_a_wheel_is_a_velocity_drive(tmp_path):
    bench = Bench(kd=3.0, bias=0.0, load_mass=0.3, load_length=0.1)
    speed = 12 * (chirp(1.5, top=4.0) - 0.3)
    record(tmp_path / "a.csv", bench, velocity=speed)
    result = fitted(tmp_path, tmp_path / "a.csv")
    assert result.rmse["train"]["all"] < 1.3 * bench.noise
    assert next(iter(result.parameters["viscous_friction"].values())) == pytest.approx(bench.viscous, rel=0.03)


def test_what_a_recording_contradicts_of_the_stated_limits_is_said():
    time = np.arange(400) * CONTROL_DT
    fast = Recording(
        name="r", joint_names=("hip", "knee"), time=time, dof_pos=np.outer(np.sin(6 * time), [1.0, 5.0]),
        des_dof_pos=np.zeros((400, 2)), dof_effort=np.outer(np.cos(6 * time), [8.0, 3.0]),
    )  # fmt: skip
    notes = contradicted_limits(fast, [20.0, 20.0], [5.0, 5.0])
    assert len(notes) == 2
    assert "no-load speed: knee reaches 30 rad/s, velocity_limit is 20 rad/s" in notes[0]
    assert "torque limit: hip reaches 8 N m, effort_limit is 5 N m" in notes[1]
    assert contradicted_limits(fast, [np.inf, 28.0], [np.nan, 8.0]) == []
