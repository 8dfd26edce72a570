"""One strategy of the search: candidates inside their bounds, a generation at once."""

import warnings

import numpy as np
import pytest

from pace_optim.estimate.convergence import stop_rule
from pace_optim.estimate.tree_strategy import TreeStrategy, into_unit_box

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import cma
    from cma.boundary_handler import BoundTransform


def test_a_generation_comes_into_its_bounds_as_pycma_brings_each_candidate():
    x = np.random.default_rng(0).normal(scale=3.0, size=(500, 4))
    x[:9, 0] = [-1.05, -1.0, -0.95, 0.0, 0.95, 1.0, 1.05, 2.1, -2.1]
    box = BoundTransform([-1.0, 1.0])
    assert np.array_equal(into_unit_box(x), [box.repair(row) for row in x])


@pytest.mark.parametrize(("size", "population", "generations"), [(5, 12, 400), (13, 64, 60)])
def test_the_search_is_to_the_last_digit_that_of_pycma_with_bounds(size, population, generations):
    start, target = np.full(size, 0.1), np.linspace(-1.1, 1.05, size)
    start[0], start[-1] = 0.99, -1.0
    generator = np.random.default_rng(3)
    reference = cma.CMAEvolutionStrategy(
        list(start),
        0.5,
        {
            "bounds": [-1.0, 1.0],
            "popsize": population,
            "randn": lambda *shape: generator.standard_normal(shape),
            "seed": np.nan,
            "verbose": -9,
            "tolfun": 1e-13,
            "tolfunhist": 1e-14,
            "tolx": 1e-10,
            "maxiter": np.inf,
        },
    )
    own = TreeStrategy(range(size), start=start, sigma=0.5, population_size=population, seed=3, criteria=[])
    for _ in range(generations):
        x, expected = own.ask(), reference.ask()
        assert np.array_equal(x, expected)
        scores = ((x - target) ** 2 @ np.logspace(0, 3, size)) + 1e-6
        own.tell(scores, x)
        reference.tell(expected, scores)
        assert np.array_equal(own.mean, reference.result.xfavorite)
        assert np.array_equal(own.spread, reference.stds)
        assert own.stop_reason == next((f"cma: {name}" for name in reference.stop()), None)
        if own.stop_reason:
            break


@pytest.mark.parametrize("rule", ["plateau", "window", "gradient", "early_stopping"])
def test_rules_on_the_best_score_begin_anew_once_the_trees_share_their_delay(rule):
    """Each tree was compared with its best at a separate delay, and ended at once."""
    criteria = [stop_rule(f"{rule}:generations=3")]
    own = TreeStrategy(range(3), start=np.zeros(3), sigma=0.5, population_size=6, seed=0, criteria=criteria)

    def told(best):
        own.tell(best + np.arange(6.0), own.ask())
        return own.stop_reason

    assert [told(0.5**k) for k in range(8)] == [None] * 8
    own.forget_best()
    own.best_score = 1.0
    assert [told(0.9 * 0.5**k) for k in range(8)] == [None] * 8
    assert [bool(told(1.0)) for _ in range(8)][-1]
    assert len(own.best_scores) == 24
