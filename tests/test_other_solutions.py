"""A second solution that fits as well must be named, however sure the first one's error bars are."""

import dataclasses

import numpy as np
import torch

from pace_envs import load_env_cfg
from pace_optim.optimizers.least_squares import Descent
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.uncertainty.other_solutions import with_other_solutions
from pace_optim.uncertainty.uncertainty import Uncertainty

SPACE = ParameterSpace.of(load_env_cfg("Pace-TestBench-v0").sim2real)
SURE = Uncertainty(
    std=np.full(SPACE.size, 1e-5),
    correlation=np.eye(SPACE.size),
    at_bound=(),
    no_influence=(),
    indistinguishable=(),
)


def descents(second_score: float, **shift: float) -> list[Descent]:
    best = torch.zeros(SPACE.size, dtype=torch.float64)
    other = best.clone()
    for name, value in shift.items():
        other[SPACE[name]] = value
    return [Descent(x=best, score=1e-8), Descent(x=other, score=second_score)]


def test_parameters_that_differ_between_two_equally_good_solutions_are_named_together():
    found = with_other_solutions(SURE, descents(1.0005e-8, friction=0.3, encoder_bias=-0.4), SPACE)
    assert found.indistinguishable == (("friction/servo", "encoder_bias/servo"),)


def test_a_worse_solution_and_a_near_one_name_nothing():
    worse = with_other_solutions(SURE, descents(1.1e-8, friction=0.3, encoder_bias=-0.4), SPACE)
    near = with_other_solutions(SURE, descents(1e-8, friction=0.01, encoder_bias=-0.01), SPACE)
    assert worse.indistinguishable == near.indistinguishable == ()


def test_what_the_error_bars_cover_is_not_named_again():
    unsure = dataclasses.replace(SURE, std=SPACE.slope(torch.zeros(SPACE.size)).numpy() * 0.2)
    found = with_other_solutions(unsure, descents(1e-8, friction=0.3, encoder_bias=-0.4), SPACE)
    assert found.indistinguishable == ()
