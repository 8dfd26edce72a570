"""The refinement: recovery of known truths, bounds, trials that diverge, several starts."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from problems import (
    CALM,
    PENDULUMS_TRUTH,
    TRUTH,
    env_cfg,
    make_problem,
    pendulums_cfg,
    pendulums_target,
    range_error,
    record,
)
from problems import normalised as normalised_truth
from scipy.optimize import lsq_linear, minimize_scalar

from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.estimate.levenberg_marquardt import bounded_step
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import Colouring
from pace_optim.run.folder import RunFolder
from pace_optim.run.history import History


def refine(problem, *starts, cfg=None, **options):
    starts = starts or (torch.zeros(problem.space.size, dtype=torch.float64),)
    evaluator = options.pop("evaluator", None) or problem.evaluator()
    return least_squares(evaluator, starts, cfg, **options)


# ---------------------------------------------------------------- recovery


@pytest.mark.parametrize("delay", [0.6, 1.0, 1.4])
@pytest.mark.parametrize("delay_mode", ["command", "effort"])
def test_the_truth_is_found_from_the_centre_of_the_bounds(delay_mode, delay):
    truth = {**CALM, "delay": delay}
    problem = make_problem(record(truth=truth, delay_mode=delay_mode), delay_mode=delay_mode)
    best = refine(problem)[0]
    assert best.score <= 1e-14 and range_error(problem, best.x, truth) < 1e-5
    assert best.iteration <= 15  # quadratic at the end


def test_two_pendulums_are_found_together_with_the_delay_they_share(tmp_path):
    cfg = pendulums_cfg(tmp_path)
    problem = make_problem(record(pendulums_target(), PENDULUMS_TRUTH, cfg=cfg), cfg=cfg)
    best = refine(problem)[0]
    assert best.score <= 1e-14 and range_error(problem, best.x, PENDULUMS_TRUTH) < 1e-5


@pytest.mark.slow
def test_recordings_at_several_gains_are_refined_together():
    problem = make_problem([record(), record(drive={"stiffness": 40.0}), record(drive={"damping": 2.0})])
    best = refine(problem)[0]
    assert best.score <= 1e-14 and range_error(problem, best.x) < 1e-5


def test_the_last_digits_are_reached_whatever_the_size_of_the_gradient():
    """The quadratic program's own tolerances are absolute: an unscaled one stops where the gradient is small."""
    problem = make_problem(record(truth=CALM, delay_mode="effort"), delay_mode="effort")
    best = refine(problem, cfg=LeastSquaresCfg(target_score=1e-20))[0]
    assert best.score <= 1e-18


def test_a_descent_ends_where_another_from_there_gains_nothing():
    told = record()
    problem = make_problem(dataclasses.replace(told, dof_pos=np.roll(told.dof_pos, 5, axis=0)))  # fits nothing exactly
    best = refine(problem)[0]
    again = refine(problem, best.x)[0]
    assert best.stop_reason == "converged"
    assert again.score > (1 - LeastSquaresCfg().creep_tolerance) * best.score


@pytest.mark.parametrize(("times", "part"), [(0.5, 1e-6), (3.0, 9e-6), (1e3, 5e-3)])
def test_what_may_be_left_to_gain_grows_with_what_is_missing(times, part):
    cfg = LeastSquaresCfg(noise_score=1e-8)
    assert cfg.tolerance(times**2 * 1e-8) == pytest.approx(part)
    assert LeastSquaresCfg().tolerance(1.0) == 1e-6  # the noise is unknown


def dense(size):
    return Colouring(colours=tuple((i,) for i in range(size)), joints=tuple((0,) for _ in range(size)))


class Curved:
    """Residuals x - 0.3 and 1 + bend x²/2 in place of a simulation: what no x explains is large, and turns."""

    looks_coarser, colouring = False, dense(1)

    def __init__(self, bend):
        self.bend, self.space = bend, SimpleNamespace(to_physical=lambda x: x)

    def look_at_phases(self, physical, anew=False):
        return False

    def look_around(self, x, own_step=False):
        every = self.residuals(x)
        return every.rows(0, 1), every

    def residuals(self, physical):
        x = physical[:, 0]
        error = torch.stack([x - 0.3, 1 + 0.5 * self.bend * x.square()], dim=1)[..., None, None]
        return Residuals(error=error, where=torch.ones(2, 1, dtype=torch.bool), step=torch.arange(2))


@pytest.mark.parametrize(("bend", "start"), [(0.3, 0.25), (0.3, 0.2), (0.1, 0.25)])
def test_no_descent_ends_on_derivatives_of_elsewhere(bend, start):
    """There the gradient of elsewhere is zero, not its own: it would end up to 3e-5 above the bottom."""
    best = least_squares(Curved(bend), [torch.tensor([start], dtype=torch.float64)])[0]
    bottom = minimize_scalar(lambda x: ((x - 0.3) ** 2 + (1 + 0.5 * bend * x**2) ** 2) / 2, tol=1e-12).fun
    assert best.stop_reason == "converged" and best.score < (1 + 1e-6) * bottom


# ---------------------------------------------------------------- bounds


def bench_with_bounds(name, low, high, truth=TRUTH):
    cfg = env_cfg()
    cfg.sim2real.set_bounds(name, low, high)
    return make_problem(record(truth=truth), cfg=cfg)


@pytest.mark.parametrize(
    ("name", "low", "high", "side"),
    [("friction", 0.0, 0.2, 1.0), ("viscous_friction", 5.0, 7.0, -1.0), ("delay", 4.0, 8.0, -1.0)],
)
def test_a_truth_beyond_a_bound_ends_at_the_bound_with_the_others_optimal(name, low, high, side):
    problem = bench_with_bounds(name, low, high)
    best = refine(problem)[0]
    entry = problem.space[name].start
    assert float(best.x[entry]) == pytest.approx(side, abs=1e-9)
    others = [i for i in range(problem.space.size) if i != entry]
    moved = []
    for i in others:
        for step in (-1e-3, 1e-3):
            x = best.x.clone()
            x[i] = (x[i] + step).clamp(-1, 1)
            if not torch.equal(x, best.x):
                moved.append(x)
    scores = problem.evaluator().residuals(problem.space.to_physical(torch.stack(moved))).score
    assert float(scores.min()) > best.score
    inside = [i for i in others if abs(float(best.x[i])) < 0.999]
    best.gradient = None
    _, gradient, _ = best.look(problem.evaluator())
    assert float(gradient[inside].abs().max()) < 1e-2 * float(gradient[entry].abs())
    assert side * float(gradient[entry]) < 0  # downhill is outwards


@pytest.mark.parametrize("corner", [-1.0, 1.0])
@pytest.mark.parametrize("name", ["friction", "viscous_friction", "encoder_bias"])
def test_a_start_at_a_bound_leaves_it_when_the_truth_is_inside(name, corner):
    problem = make_problem(record())
    start = normalised_truth(problem)
    start[problem.space[name]] = corner
    best = refine(problem, start)[0]
    assert best.score <= 1e-14 and range_error(problem, best.x) < 1e-5


def test_a_truth_exactly_on_a_bound_is_found():
    truth = {**TRUTH, "friction": 0.0, "encoder_bias": 0.1}
    problem = make_problem(record(truth=truth))
    best = refine(problem)[0]
    assert best.score <= 1e-14 and range_error(problem, best.x, truth) < 1e-5


def test_starts_outside_the_bounds_are_brought_in():
    problem = make_problem(record())
    best = refine(problem, torch.full((5,), 1.5, dtype=torch.float64), cfg=LeastSquaresCfg(max_iteration=1))[0]
    assert float(best.x.abs().max()) <= 1.0


@pytest.mark.parametrize("damping", [0.0, 1e-3, 1.0])
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("magnitude", [1.0, 1e-9])
def test_a_bounded_step_is_the_one_that_scipy_finds(damping, seed, magnitude):
    rng = np.random.default_rng(seed)
    n = 6
    jacobian = rng.standard_normal((40, n)) * 10.0 ** rng.uniform(-2, 2, n)
    x = rng.uniform(-1, 1, n)
    x[0], x[1] = 1.0, -1.0  # at their bounds
    error = jacobian @ (x - rng.uniform(-2, 2, n)) * magnitude + 0.1 * rng.standard_normal(40) * magnitude
    hessian, gradient = jacobian.T @ jacobian, jacobian.T @ error
    found = bounded_step(torch.tensor(x), torch.tensor(hessian), torch.tensor(gradient), damping).numpy()
    root = np.sqrt(damping * np.diag(hessian))
    rows = np.vstack([jacobian, np.diag(root)]) if damping else jacobian
    right = -np.concatenate([error, np.zeros(n)]) if damping else -error
    expected = lsq_linear(rows, right, bounds=(-1 - x - 1e-15, 1 - x + 1e-15), method="bvls", tol=1e-14).x
    step = found - x

    def cost(d):
        return 0.5 * d @ (hessian + damping * np.diag(np.diag(hessian))) @ d + gradient @ d

    assert np.all(np.abs(found) <= 1.0)
    assert cost(step) <= cost(expected) + 1e-8 * abs(cost(expected))
    assert np.allclose(step, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max() + 2e-15)


def test_a_parameter_without_influence_stays_where_it_is():
    hessian = torch.diag(torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64))
    gradient = torch.tensor([0.3, 0.0, -0.2], dtype=torch.float64)
    x = torch.tensor([0.1, 0.7, -0.4], dtype=torch.float64)
    assert bounded_step(x, hessian, gradient, 1e-9).tolist() == pytest.approx([-0.2, 0.7, -0.3], abs=1e-6)


# ---------------------------------------------------------------- trials that diverge, several starts


class Fake:
    """Residuals from a function of the normalised vector, as an evaluator gives them."""

    looks_coarser = False

    def __init__(self, function, size):
        self.function, self.colouring = function, dense(size)
        self.space = self
        self.batches = []

    def to_physical(self, x):
        return x

    def look_at_phases(self, physical, anew=False):
        return False

    def look_around(self, x, own_step=False):
        every = self.residuals(x)
        return every.rows(0, 1), every

    def residuals(self, x):
        self.batches.append(x)
        error = torch.stack([self.function(row) for row in x])[:, :, None, None]
        where = torch.ones(error.shape[1], 1, dtype=torch.bool)
        return Residuals(error=error, where=where, step=torch.arange(error.shape[1]))


def test_trials_that_diverge_do_not_break_a_descent():
    target = torch.tensor([0.3, -0.2], dtype=torch.float64)

    def valley(x):  # full steps from the start land where nothing is finite
        far = torch.full((2,), torch.nan, dtype=torch.float64)
        bent = torch.stack([5 * (x[0] - target[0]), torch.tanh(4 * (x[1] - target[1]))])
        return far if x[1] < -0.6 else bent

    fake = Fake(valley, 2)
    best = least_squares(fake, [torch.tensor([-0.5, 0.4], dtype=torch.float64)])[0]
    assert torch.stack([torch.isnan(valley(x)).any() for batch in fake.batches for x in batch]).any()
    assert torch.allclose(best.x, target, atol=1e-6) and best.score < 1e-12


def test_perturbed_vectors_that_diverge_do_not_break_a_descent():
    def valley(x):
        error = torch.stack([x[0] - 0.3, x[1] + 0.2])
        return torch.full_like(error, torch.nan) if x[0] > 0.5 and x[1] != 0.0 else error

    best = least_squares(Fake(valley, 2), [torch.tensor([0.9, 0.0], dtype=torch.float64)])[0]
    assert np.isfinite(best.score) and best.stop_reason
    assert bool(best.x.isfinite().all())


def test_a_start_that_diverges_is_given_up_and_the_others_go_on():
    def valley(x):
        return x - 0.1 if x[0] < 0.8 else torch.full_like(x, torch.nan)

    starts = [torch.full((2,), value, dtype=torch.float64) for value in (0.9, 0.0)]
    best, worst = least_squares(Fake(valley, 2), starts)
    assert best.score < 1e-12 and worst.stop_reason == "diverged at its start"


def test_a_recording_of_a_diverging_start_is_survived_in_the_simulation():
    problem = make_problem(record())
    nowhere = torch.zeros(5, dtype=torch.float64)
    nowhere[problem.space["encoder_bias"]] = torch.nan
    best, worst = refine(problem, nowhere, torch.zeros(5, dtype=torch.float64))
    assert best.score <= 1e-14 and worst.stop_reason == "diverged at its start"


def test_of_several_starts_the_hopeless_are_dropped_and_the_best_comes_first():
    def two_valleys(x):  # a good one at 0.5, a bad one at -0.5
        good, bad = torch.sin(3 * (x - 0.5)) / 3, torch.ones_like(x)
        return torch.cat([good, torch.where(x < 0, bad * (1 + 0.2 * torch.cos(40 * x) - x), 0 * x)])

    cfg = LeastSquaresCfg(target_score=1e-20, score_tolerance=1e-12, creep_tolerance=0.0)
    starts = [torch.tensor([0.2], dtype=torch.float64), torch.tensor([-0.9], dtype=torch.float64)]
    best, worst = least_squares(Fake(two_valleys, 1), starts, cfg)
    assert float(best.x) == pytest.approx(0.5, abs=1e-6)
    assert worst.stop_reason == "another start is far better"


def test_a_start_that_comes_down_beside_a_better_one_is_dropped():
    def one_valley(x):
        return torch.cat([torch.sinh(x - 0.2), torch.ones_like(x)])

    starts = [torch.tensor([value], dtype=torch.float64) for value in (0.5, -0.7)]
    best, second = least_squares(Fake(one_valley, 1), starts)
    assert second.stop_reason == "another start is in the same valley"
    assert float(best.x) == pytest.approx(0.2, abs=1e-6)


def test_the_score_never_rises_and_the_reported_one_is_that_of_x():
    problem = make_problem(record(noise=1e-3))
    evaluator = problem.evaluator()
    best = refine(problem, evaluator=evaluator)[0]
    assert all(later <= earlier for earlier, later in zip(best.scores, best.scores[1:], strict=False))
    again = evaluator.residuals(problem.space.to_physical(best.x[None])).score
    assert float(again) == pytest.approx(best.score, rel=1e-12)
    assert best.stop_reason == "converged"


def test_limits_on_iterations_and_score_are_kept():
    problem = make_problem(record())
    assert refine(problem, cfg=LeastSquaresCfg(max_iteration=3))[0].stop_reason == "max_iteration 3"
    early = refine(problem, cfg=LeastSquaresCfg(target_score=1e-6))[0]
    assert early.stop_reason == "score below 1e-06" and early.score <= 1e-6
    assert early.scores[-2] > 1e-6


def test_starts_are_not_changed():
    problem = make_problem(record())
    start = torch.zeros(5, dtype=torch.float64)
    refine(problem, start, cfg=LeastSquaresCfg(max_iteration=4))
    assert not start.any()
    assert dataclasses.is_dataclass(Descent)


# ---------------------------------------------------------------- rattling, and going on


SAMPLES, NOISE, RATTLE = 400, 0.1, 0.02
TARGET = torch.tensor([-0.5, 0.3, 0.1], dtype=torch.float64)


class Rattling:
    """Residuals that are linear, with noise, and with a rattle of a fifth of it that a millionth changes.

    A rotor's inertia, a delay that is nearly the same, and something else: one combination hardly moves anything.
    """

    looks_coarser, colouring = False, dense(3)

    def __init__(self, seed=0, rattle=RATTLE):
        generator = torch.Generator().manual_seed(seed)

        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        self.slope = draw(SAMPLES, 3)
        self.slope[:, 1] = 10 * self.slope[:, 0] + 3 * self.slope[:, 1]
        self.noise, self.phase, self.wave = NOISE * draw(SAMPLES), 6 * draw(SAMPLES), 1e6 * draw(SAMPLES, 3)
        self.rattle, self.space, self.rows = rattle, SimpleNamespace(to_physical=lambda x: x), 0

    def look_at_phases(self, physical, anew=False):
        return False

    def look_around(self, x, own_step=False):
        every = self.residuals(x)
        return every.rows(0, 1), every

    def residuals(self, x):
        self.rows += len(x)
        error = (x - TARGET) @ self.slope.T + self.noise + self.rattle * torch.sin(x @ self.wave.T + self.phase)
        where = torch.ones(SAMPLES, 1, dtype=torch.bool)
        return Residuals(error=error[..., None, None], where=where, step=torch.arange(SAMPLES))


def rattling_start():
    return torch.tensor([0.5, 0.0, -0.5], dtype=torch.float64)


@pytest.mark.parametrize("seed", range(6))
def test_a_weak_combination_is_found_and_its_error_bars_are_those_without_the_rattle(seed):
    """Over narrow steps its derivative was the rattle's: it hardly moved, with error bars near zero."""
    rattling, calm = Rattling(seed), Rattling(seed, rattle=0.0)
    best, right = (least_squares(each, [rattling_start()])[0] for each in (rattling, calm))
    bars = []
    for end, on in ((best, rattling), (right, calm)):
        end.gradient = None
        hessian, *_ = end.look(on)
        bars.append((torch.linalg.inv(hessian) * end.score / SAMPLES).diagonal().sqrt())
    assert torch.allclose(bars[0], bars[1], rtol=0.25)
    assert ((best.x - TARGET).abs() < 3 * bars[0]).all()
    assert best.score < 1.1 * (right.score + RATTLE**2 / 2)
    assert best.iteration < 20 and rattling.rows < 200


class Misled(Rattling):
    """The same, whose longer step sees nothing but a rattle that is larger than the error."""

    looks_coarser = True

    def look_around(self, x, own_step=False):
        every = self.residuals(x)
        wild = torch.randn(every.error.shape, generator=torch.Generator().manual_seed(self.rows))
        return every.rows(0, 1), every if own_step else dataclasses.replace(every, error=wild.double())


def test_where_a_longer_step_leads_nowhere_the_fits_own_leads_on():
    """Hands of small links ended as converged with a fifth of their values wrong."""
    best, right = (least_squares(each(), [rattling_start()])[0] for each in (Misled, Rattling))
    assert best.own_step and not right.own_step and best.score < 1.05 * right.score


def test_a_descent_that_was_interrupted_goes_on_as_if_it_had_not_been(tmp_path):
    whole = least_squares(Rattling(), [rattling_start()])[0]
    for stop in range(1, whole.iteration):

        def interrupt(descents, stop=stop):
            if descents[0].iteration == stop:
                raise KeyboardInterrupt

        descents = [Descent(x=rattling_start())]
        with pytest.raises(KeyboardInterrupt):
            least_squares(Rattling(), descents, on_iteration=interrupt)
        folder = RunFolder(tmp_path)
        folder.write_checkpoint(None, torch.zeros(0, dtype=torch.float64), descents, [], 0, 0, History())
        on = least_squares(Rattling(), Descent.restore(folder.read_checkpoint()))[0]
        assert torch.equal(on.x, whole.x) and on.scores == whole.scores and on.iteration == whole.iteration
