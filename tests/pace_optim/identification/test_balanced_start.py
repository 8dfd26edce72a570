"""Where a fit begins: at what the balance of torques along its recordings gives."""

import numpy as np
import pytest
from problems import BENCH, CALM, chirp, env_cfg, make_problem, replayed

from pace_optim.identification.balanced_start import balanced_start

GAINS = {"stiffness": 85.0, "damping": 0.6}


def test_the_balance_of_torques_is_near_the_truth():
    problem = make_problem(replayed(chirp(4.0, high=3.0), CALM, env_cfg(BENCH), drive=GAINS, noise=1e-5))
    space = problem.space
    values = space.to_dict(space.to_physical(balanced_start(problem)))
    (joint,) = problem.joint_names
    for name, near in (("armature", 0.2), ("viscous_friction", 0.2), ("friction", 0.4)):
        assert values[name][joint] == pytest.approx(np.ravel(CALM[name])[0], rel=near), name
    assert values["delay"]["all"] == pytest.approx(CALM["delay"], abs=0.5)
    assert values["encoder_bias"][joint] == space.to_dict(space.to_physical(space.start))["encoder_bias"][joint]


def test_a_joint_that_hardly_moves_has_a_start_within_its_bounds():
    problem = make_problem(replayed(0 * chirp(1.0), CALM, env_cfg(BENCH), drive=GAINS))
    start = balanced_start(problem)
    assert start.isfinite().all() and (start.abs() <= 1).all()
