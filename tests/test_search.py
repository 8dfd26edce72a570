"""When refining is worth more than searching, and the loop around it."""

import math

import pytest
import torch
from problems import chirp, make_problem, record

import pace_optim.optimizers.search as search_module
from pace_envs.tasks.pace import CMAESOptimizerCfg
from pace_optim.optimizers.cmaes_optimizer import CMAESOptimizer
from pace_optim.optimizers.jacobian import Colouring, colour
from pace_optim.optimizers.search import RefiningPays, search
from pace_optim.problem.evaluator import Residuals


class FakeOptimizer:
    """A search whose best score falls by a factor every generation."""

    def __init__(self, factor, population=16, start=1.0):
        self.factor, self.population_size, self.score = factor, population, start
        self.generation, self.best_scores, self.reason = 0, [], None
        self.best = torch.tensor([0.5, -0.4], dtype=torch.float64)

    def evolve(self):
        self.score *= self.factor
        self.generation += 1
        self.best_scores.append(self.score)

    def stop(self, reason):
        self.reason = reason


class FakeEvaluator:
    """Residuals of a function of the normalised vector; counts simulations."""

    def __init__(self, function):
        self.function, self.space, self.simulations = function, self, 0

    def to_physical(self, x):
        return x

    def residuals(self, x, where=None):
        self.simulations += len(x)
        error = torch.stack([self.function(row) for row in x])[:, :, None, None]
        where = torch.ones(error.shape[1], 1, dtype=torch.bool)
        return Residuals(error=error, where=where, step=torch.arange(error.shape[1]))


COLOURING = Colouring(colours=((0,), (1,)), joints=((0,), (0,)))


def smooth(x):
    return torch.sinh(x - 0.1)


def flat(x):
    return torch.ones_like(x) + 1e-9 * x


def generations_until_stop(probe, optimizer, most=12):
    while optimizer.reason is None and optimizer.generation < most:
        optimizer.evolve()
        probe(optimizer)
    return optimizer.generation


def test_a_smooth_valley_is_refined_at_the_first_look_when_the_search_crawls():
    evaluator, optimizer = FakeEvaluator(smooth), FakeOptimizer(0.99)
    probe = RefiningPays(evaluator, COLOURING)
    assert generations_until_stop(probe, optimizer) == 3
    assert optimizer.reason == "refining is worth more than searching"
    assert float(smooth(probe.refined).square().sum()) < 1e-6 * float(smooth(optimizer.best).square().sum())


def test_a_landscape_that_cannot_be_refined_is_searched_on():
    evaluator, optimizer = FakeEvaluator(flat), FakeOptimizer(0.9)
    probe = RefiningPays(evaluator, COLOURING)
    assert generations_until_stop(probe, optimizer) == 12
    assert optimizer.reason is None and probe.refined is None
    assert evaluator.simulations > 0


def test_a_search_that_falls_faster_per_simulation_than_refining_goes_on():
    per_simulation = 0.4  # log of the score's fall
    optimizer = FakeOptimizer(math.exp(-per_simulation * 16))
    evaluator = FakeEvaluator(lambda x: torch.sinh(x - 0.1) + 0.2 * torch.tanh(30 * x))
    probe = RefiningPays(evaluator, COLOURING)
    generations_until_stop(probe, optimizer)
    fast = optimizer.reason
    slow = FakeOptimizer(math.exp(-1e-6 * 16))
    generations_until_stop(RefiningPays(evaluator, COLOURING), slow)
    assert fast is None and slow.reason is not None


def test_the_search_is_stopped_in_the_generation_in_which_it_slows_down():
    evaluator, optimizer = FakeEvaluator(smooth), FakeOptimizer(1e-40)  # faster than any refinement
    probe = RefiningPays(evaluator, COLOURING)
    optimizer.score = 1e200
    while optimizer.reason is None and optimizer.generation < 15:
        optimizer.factor = 1e-40 if optimizer.generation < 6 else 0.99
        optimizer.evolve()
        probe(optimizer)
    assert optimizer.generation == 9  # the first look after it slowed down at 6


@pytest.mark.parametrize("score", [0.0, math.inf])
def test_scores_of_zero_and_infinity_are_survived(score):
    optimizer = FakeOptimizer(1.0, start=score)
    generations_until_stop(RefiningPays(FakeEvaluator(smooth), COLOURING), optimizer)
    generations_until_stop(
        RefiningPays(FakeEvaluator(lambda x: torch.full_like(x, torch.nan)), COLOURING), FakeOptimizer(1.0, start=score)
    )


def test_looking_costs_a_small_part_of_the_search():
    evaluator, optimizer = FakeEvaluator(flat), FakeOptimizer(0.9, population=48)
    generations_until_stop(RefiningPays(evaluator, COLOURING), optimizer)
    assert evaluator.simulations < 0.5 * 12 * 48


def test_a_search_stopped_by_the_rule_goes_on_to_the_truth():
    problem = make_problem(record(chirp(0.6)))
    evaluator, colouring = problem.evaluator(), colour(problem.space, problem.trees, problem.joint_names)
    optimizer = CMAESOptimizer(problem.space, 16, CMAESOptimizerCfg(max_iteration=200), seed=2)
    probe = RefiningPays(evaluator, colouring)
    search(optimizer, evaluator.rollout(16), probe)
    assert optimizer.stop_reasons == ["refining is worth more than searching"]
    assert optimizer.generation <= 30 and probe.refined is not None
    best = search_module.least_squares(evaluator, colouring, [probe.refined])[0]
    assert best.score <= 1e-12


def test_the_loop_asks_simulates_tells_and_evolves_until_finished():
    calls = []

    class Optimizer:
        generation = 0

        def finished(self):
            return self.generation == 2

        def ask(self):
            calls.append("ask")

        def update_simulator(self, rollout):
            calls.append("update")

        def tell(self, sim_dof_pos, real_dof_pos):
            calls.append(f"tell {sim_dof_pos}{real_dof_pos}")

        def evolve(self):
            calls.append("evolve")
            self.generation += 1

    search(Optimizer(), [("a", "b"), ("c", "d")], lambda o: calls.append(f"after {o.generation}"))
    once = ["ask", "update", "tell ab", "tell cd", "evolve"]
    assert calls == [*once, "after 1", *once, "after 2"]
