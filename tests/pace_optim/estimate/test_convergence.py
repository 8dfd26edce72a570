"""Each criterion on histories made by hand."""

import numpy as np
import pytest

from pace_optim.estimate.convergence import (
    MovingWindow,
    ParameterSpread,
    Plateau,
    ScoreSpread,
    SearchState,
    TargetScore,
)


def state(scores=(1.0, 2.0), best=(1.0,), spread=(0.5,)):
    return SearchState(generation=len(best), scores=np.array(scores), best_scores=list(best), spread=np.array(spread))


@pytest.mark.parametrize(
    ("scores", "epsilon", "stops"),
    [
        ((1.0, 1.009), 1e-2, True),
        ((1.0, 1.011), 1e-2, False),
        ((2.0, 2.019), 1e-2, True),  # relative to the lowest, not absolute
        ((1e-12, 1.5e-12), 1e-2, False),
        ((1.0, 1.2, 1.4), 0.5, True),
        ((0.0, 0.0), 1e-2, False),
    ],
)
def test_paces_rule_stops_when_the_generations_relative_spread_is_below_epsilon(scores, epsilon, stops):
    assert (ScoreSpread(epsilon)(state(scores)) is not None) is stops


def test_a_plateau_is_too_little_improvement_over_its_generations():
    rule = Plateau(generations=3, improvement=0.1)
    assert rule(state(best=(1.0, 1.0, 1.0))) is None  # too early to say
    assert "0.1 in 3 generations" in rule(state(best=(1.0, 1.0, 1.0, 0.95)))
    assert rule(state(best=(1.0, 1.0, 1.0, 0.85))) is None
    assert rule(state(best=(5.0, 1.0, 1.0, 1.0, 1.0)))  # earlier progress does not count
    assert rule(state(best=(1.0, 1.0, 1.0, 1.0, 0.1))) is None


def test_a_moving_window_compares_means_and_waits_for_two_windows():
    rule = MovingWindow(generations=2, improvement=0.1)
    assert rule(state(best=(1.0, 1.0, 1.0))) is None
    assert "2 generations improved by less than 0.1" in rule(state(best=(1.0, 1.0, 1.0, 0.9)))  # 0.95 against 1
    assert rule(state(best=(1.0, 1.0, 0.9, 0.8))) is None  # 0.85 against 1
    assert rule(state(best=(9.0, 9.0, 1.0, 1.0, 1.0, 0.95)))


def test_parameter_spread_looks_at_the_widest_parameter():
    rule = ParameterSpread(1e-3)
    assert rule(state(spread=(1e-4, 2e-3))) is None
    assert "below 0.001" in rule(state(spread=(1e-4, 9e-4)))


def test_a_target_score_stops_when_it_is_reached():
    rule = TargetScore(1e-8)
    assert rule(state(best=(1.0, 2e-8))) is None
    assert rule(state(best=(1.0, 1e-8))) == "score below 1e-08"


def test_any_function_of_the_state_is_a_criterion():
    def at_three(s):
        return "three generations" if s.generation == 3 else None

    assert at_three(state(best=(1.0, 1.0))) is None and at_three(state(best=(1.0, 1.0, 1.0)))
