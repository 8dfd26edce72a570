"""Where a fit begins: at what the balance of torques along its recordings gives."""

import numpy as np
import pytest
from problems import (
    BENCH,
    CALM,
    PENDULUMS_TRUTH,
    chirp,
    env_cfg,
    make_problem,
    pendulums_cfg,
    pendulums_target,
    record,
    replayed,
)

from pace_optim.identification import balanced_start as module
from pace_optim.identification.balanced_start import balanced_start

GAINS = {"stiffness": 85.0, "damping": 0.6}


def test_the_balance_of_torques_is_near_the_truth():
    problem = make_problem(replayed(chirp(4.0, high=3.0), CALM, env_cfg(BENCH), drive=GAINS, noise=1e-5))
    space = problem.space
    values = space.to_dict(space.to_physical(balanced_start(problem)[0]))
    (joint,) = problem.joint_names
    for name, near in (("armature", 0.2), ("viscous_friction", 0.2), ("friction", 0.4)):
        assert values[name][joint] == pytest.approx(np.ravel(CALM[name])[0], rel=near), name
    assert values["delay"]["all"] == pytest.approx(CALM["delay"], abs=0.5)
    assert values["encoder_bias"][joint] == space.to_dict(space.to_physical(space.start))["encoder_bias"][joint]


@pytest.mark.parametrize("offset", [0.0, 4.0])
def test_a_torque_that_no_parameter_makes_leaves_the_error_by_which_the_position_loop_yields_to_it(offset):
    """e = τ / (kp + m g l)."""
    recording = replayed(chirp(6.0, high=2.0), CALM, env_cfg(BENCH), drive=GAINS, noise=1e-5)
    recording.dof_pos[:] += offset / (GAINS["stiffness"] + 9.81 * 0.2)
    _, left = balanced_start(make_problem(recording))
    assert 1e3 * left**0.5 == pytest.approx(1e3 * offset / (GAINS["stiffness"] + 9.81 * 0.2), rel=0.2)


def test_a_joint_that_hardly_moves_has_a_start_within_its_bounds():
    problem = make_problem(replayed(0 * chirp(1.0), CALM, env_cfg(BENCH), drive=GAINS))
    start, _ = balanced_start(problem)
    assert start.isfinite().all() and (start.abs() <= 1).all()


def test_what_the_balance_puts_at_its_bound_keeps_its_start(monkeypatch):
    solved = np.array([0.05, 3.0, 0.0, 0.0, 0.0])
    monkeypatch.setattr(module, "bounded_least_squares", lambda *_: (solved, 0.0))
    problem = make_problem(replayed(chirp(1.0, high=3.0), CALM, env_cfg(BENCH), drive=GAINS))
    space, (joint,) = problem.space, problem.joint_names
    usual, values = (space.to_dict(space.to_physical(x)) for x in (space.start, balanced_start(problem)[0]))
    assert values["armature"][joint] == pytest.approx(0.05) and values["viscous_friction"][joint] == pytest.approx(3.0)
    assert values["friction"][joint] == usual["friction"][joint] > 0


def test_a_joint_that_does_not_balance_at_the_best_delay_keeps_its_start(monkeypatch, tmp_path):
    """It kept what another delay gave."""
    cfg = pendulums_cfg(tmp_path)
    problem = make_problem(record(pendulums_target(2.0), PENDULUMS_TRUTH, cfg=cfg), cfg=cfg)
    parts = iter([0.4, 0.9, 0.6, 0.1])  # of two joints at two delays
    numbers = np.array([0.05, 3.0, 0.1, 0.0, 0.0])
    monkeypatch.setattr(module, "_solved", lambda *_: (numbers, next(parts, 2.0)))
    space, (first, second) = problem.space, problem.joint_names
    usual, values = (space.to_dict(space.to_physical(x)) for x in (space.start, balanced_start(problem)[0]))
    assert values["armature"][first] == usual["armature"][first] != values["armature"][second]
    assert values["armature"][second] == pytest.approx(0.05) and values["delay"]["all"] == pytest.approx(1.0)
