"""Error bars: closed forms for linear problems, coverage on the bench, and what cannot be known said in words."""

import numpy as np
import pytest
import torch
from linear_problems import linear
from problems import TRUTH, chirp, env_cfg, make_problem, normalised, physical, record

from pace_envs.tasks.pace import Parameter
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.uncertainty import Uncertainty, autocovariance, estimate_uncertainty
from pace_optim.estimate.error_bars.undetermined import _wide
from pace_optim.estimate.least_squares import least_squares
from pace_optim.problem.parameter_space import ParameterSpace


def ar1(phi, count, rng, sigma=1e-3):
    white = sigma * rng.standard_normal(count + 500)
    series = np.zeros_like(white)
    for k in range(1, len(white)):
        series[k] = phi * series[k - 1] + white[k]
    return series[500:]


# ---------------------------------------------------------------- closed forms


def test_white_noise_gives_the_classic_covariance():
    rng = np.random.default_rng(0)
    columns, sigma = rng.standard_normal((3, 4000)), 2e-3
    columns[1] += 0.8 * columns[0]
    jacobian, space = linear(columns, sigma * rng.standard_normal(4000))
    found = estimate_uncertainty(jacobian, space, torch.zeros(3, dtype=torch.float64))
    covariance = sigma**2 * np.linalg.inv(columns @ columns.T)
    std = np.sqrt(covariance.diagonal())
    assert found.std == pytest.approx(std, rel=0.1)
    assert found.correlation == pytest.approx(covariance / std[:, None] / std, abs=0.1)
    assert (found.at_bound, found.no_influence, found.indistinguishable) == ((), (), ())


def test_what_is_held_has_no_error_bar_and_costs_the_others_none():
    """It was blanked only: what is like it kept the error bar of both being free."""
    rng, sigma = np.random.default_rng(0), 2e-3
    columns = rng.standard_normal((2, 4000))
    columns[1] = columns[0] + 0.02 * columns[1]
    jacobian, space = linear(columns, sigma * rng.standard_normal(4000))
    x = torch.zeros(2, dtype=torch.float64)
    both, one = (estimate_uncertainty(jacobian, space, x, held=held) for held in ((), space.labels[1:]))
    assert np.isnan(one.std[1]) and one.std[0] == pytest.approx(sigma / np.linalg.norm(columns[0]), rel=0.1)
    assert both.std[0] > 20 * one.std[0]


def test_two_that_move_the_same_may_be_anywhere_and_are_told_to_be_one_combination():
    """Their error bars were those of their sum, which is known well."""
    rng, sigma = np.random.default_rng(0), 2e-3
    columns = rng.standard_normal((3, 4000))
    columns[1] = columns[0]
    jacobian, space = linear(columns, sigma * rng.standard_normal(4000))
    found = estimate_uncertainty(jacobian, space, torch.zeros(3, dtype=torch.float64))
    assert found.combinations == found.indistinguishable == (tuple(space.labels[:2]),)
    assert found.std[:2] == pytest.approx(np.sqrt(1 / 6) * space.slope(torch.zeros(3)).numpy()[:2], rel=0.01)
    assert found.std[2] == pytest.approx(sigma / np.linalg.norm(columns[2]), rel=0.1)


def test_the_first_samples_noise_adds_its_own_variance():
    # one parameter, residual e = J dx + S dq0: Var(x) = σ²/JᵀJ + σ² (JᵀS / JᵀJ)²
    rng, count, sigma = np.random.default_rng(3), 4000, 1e-3
    column, moved = np.full(count, 0.7), np.exp(-np.arange(count) / 500.0)
    problem, space = linear([column], sigma * rng.standard_normal(count))
    x = torch.zeros(1, dtype=torch.float64)
    initial = torch.as_tensor(moved)[None, :, None, None]
    without = estimate_uncertainty(problem, space, x).std[0]
    found = estimate_uncertainty(problem, space, x, initial, ((0,),)).std[0]
    information = column @ column
    added = sigma * (column @ moved) / information
    assert added > 5 * without
    assert found == pytest.approx(np.hypot(sigma / np.sqrt(information), added), rel=0.05)


def test_the_degrees_of_freedom_that_the_parameters_take_are_given_back():
    rng, ratio = np.random.default_rng(1), []
    for _ in range(200):
        columns = rng.standard_normal((10, 40))
        noise = rng.standard_normal(40)
        left = noise - columns.T @ np.linalg.solve(columns @ columns.T, columns @ noise)  # residuals of the fit
        jacobian, space = linear(columns, left)
        found = estimate_uncertainty(jacobian, space, torch.zeros(10, dtype=torch.float64))
        ratio.append((found.std**2 / np.linalg.inv(columns @ columns.T).diagonal()).mean())
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("phi", [0.5, 0.9, -0.5])
def test_autocorrelated_noise_widens_a_constants_error_bar_by_the_known_factor(phi):
    rng, found, count = np.random.default_rng(2), [], 20000
    for _ in range(10):
        error = ar1(phi, count, rng)
        jacobian, space = linear(np.ones((1, count)), error)
        std = estimate_uncertainty(jacobian, space, torch.zeros(1, dtype=torch.float64)).std[0]
        found.append(std / (error.std() / np.sqrt(count)))
    assert np.mean(found) == pytest.approx(np.sqrt((1 + phi) / (1 - phi)), rel=0.1)


@pytest.mark.parametrize("omega", [0.05, 0.5, 2.0])
def test_a_sine_regressor_feels_the_noise_at_its_own_frequency(omega):
    rng, found, count, phi = np.random.default_rng(3), [], 20000, 0.8
    for _ in range(10):
        error = ar1(phi, count, rng)
        jacobian, space = linear(np.sin(omega * np.arange(count))[None], error)
        std = estimate_uncertainty(jacobian, space, torch.zeros(1, dtype=torch.float64)).std[0]
        found.append(std / np.sqrt(2 * error.var() / count))
    power = (1 - phi**2) / (1 - 2 * phi * np.cos(omega) + phi**2)  # spectrum of AR(1) over its variance
    assert np.mean(found) == pytest.approx(np.sqrt(power), rel=0.15)


def test_the_autocovariance_is_that_of_the_process_and_vanishes_for_white_noise():
    rng = np.random.default_rng(4)
    found = autocovariance(ar1(0.8, 50000, rng))
    variance = 1e-6 / (1 - 0.64)
    assert found[:4] == pytest.approx(variance * 0.8 ** np.arange(4), rel=0.1)
    white = autocovariance(rng.standard_normal(50000))
    assert white[0] == pytest.approx(1.0, rel=0.05) and len(white) < 50
    assert autocovariance(np.zeros(100)).tolist() == [0.0]


def test_no_noise_no_error_bars():
    rng = np.random.default_rng(5)
    jacobian, space = linear(rng.standard_normal((2, 500)), np.zeros(500))
    found = estimate_uncertainty(jacobian, space, torch.zeros(2, dtype=torch.float64))
    assert found.std.tolist() == [0.0, 0.0] and not np.isnan(found.correlation).any()


def test_error_bars_are_in_physical_units_on_both_scales():
    rng = np.random.default_rng(6)
    columns, error = rng.standard_normal((2, 4000)), 1e-3 * rng.standard_normal(4000)
    jacobian, plain = linear(columns, error)
    parameters = [
        Parameter(name="a", unit="1", lower=(0.0,), upper=(10.0,), apply=lambda e, v: None, keys=("j",)),
        Parameter(name="b", unit="1", lower=(0.1,), upper=(10.0,), apply=lambda e, v: None, keys=("j",), scale="log"),
    ]
    x = torch.tensor([0.3, 0.0], dtype=torch.float64)
    normal = estimate_uncertainty(jacobian, plain, x).std
    found = estimate_uncertainty(jacobian, ParameterSpace(parameters), x).std
    # dp/dx is half the width, and on a logarithmic scale p times half the logarithm's width (p = 1 in the middle)
    assert found == pytest.approx(normal * [5.0, np.log(10.0)], rel=1e-9)


# ---------------------------------------------------------------- what cannot be known


def test_parameters_that_do_the_same_are_named_together():
    rng = np.random.default_rng(7)
    base = rng.standard_normal((3, 800))
    columns = np.stack([base[0], 2.0 * base[0], base[1], base[2]])
    jacobian, space = linear(columns, 1e-3 * rng.standard_normal(800), ["bias", "friction", "armature", "delay"])
    found = estimate_uncertainty(jacobian, space, torch.zeros(4, dtype=torch.float64))
    assert found.indistinguishable == (("bias/j", "friction/j"),)


def test_a_pair_that_is_nearly_alike_is_named_when_the_noise_hides_the_difference_and_only_then():
    rng = np.random.default_rng(8)
    base, other = rng.standard_normal((2, 800))
    columns = np.stack([base, base + 0.01 * other])
    for sigma, expected in ((0.3, (("bias/j", "friction/j"),)), (1e-4, ())):
        jacobian, space = linear(columns, sigma * rng.standard_normal(800), ["bias", "friction"])
        found = estimate_uncertainty(jacobian, space, torch.zeros(2, dtype=torch.float64))
        assert found.indistinguishable == expected
    assert found.correlation[0, 1] < -0.99


def test_a_parameter_without_influence_is_named_and_has_no_error_bar():
    rng = np.random.default_rng(9)
    columns = rng.standard_normal((3, 500))
    columns[1] = 1e-9
    jacobian, space = linear(columns, 1e-3 * rng.standard_normal(500))
    found = estimate_uncertainty(jacobian, space, torch.zeros(3, dtype=torch.float64))
    assert found.no_influence == ("p1/j",)
    assert np.isnan(found.std).tolist() == [False, True, False]
    assert np.isnan(found.correlation[1]).all() and not np.isnan(found.correlation[0, 2])


def test_a_parameter_at_its_bound_is_named_has_no_error_bar_and_narrows_the_others():
    rng = np.random.default_rng(10)
    columns = rng.standard_normal((2, 3000))
    columns[1] += columns[0]
    jacobian, space = linear(columns, 1e-3 * rng.standard_normal(3000))
    inside = estimate_uncertainty(jacobian, space, torch.tensor([0.2, 0.3], dtype=torch.float64))
    found = estimate_uncertainty(jacobian, space, torch.tensor([0.2, 1.0], dtype=torch.float64))
    assert found.at_bound == ("p1/j",) and np.isnan(found.std[1])
    assert found.std[0] == pytest.approx(1e-3 / np.linalg.norm(columns[0]), rel=0.1)
    assert found.std[0] < 0.8 * inside.std[0]


def test_what_comes_from_the_step_widens_error_bars_and_goes_the_same_way_in_all():
    rng = np.random.default_rng(0)
    jacobian, space = linear(rng.standard_normal((3, 4000)), 1e-3 * rng.standard_normal(4000))
    noise = estimate_uncertainty(jacobian, space, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    share = np.array([3.0, -4.0, np.nan]) * 1e-4
    both = noise.with_step(share)
    assert both.std[:2] == pytest.approx(np.hypot(noise.std[:2], share[:2])) and np.isnan(both.std[2])
    assert both.correlation.diagonal()[:2] == pytest.approx(1.0)
    assert both.correlation[0, 1] < -0.9 and np.isnan(both.correlation[2]).all()


@pytest.mark.parametrize(("sigma", "told"), [(1e-3, True), (1e-1, False)])
def test_a_value_that_its_error_bar_tells_from_a_near_bound_is_not_at_it(sigma, told):
    """Such as a friction of a small joint, within bounds for a strong drive."""
    rng = np.random.default_rng(0)
    jacobian, space = linear(rng.standard_normal((2, 4000)), sigma * rng.standard_normal(4000))
    found = estimate_uncertainty(jacobian, space, torch.tensor([-0.9995, 0.0], dtype=torch.float64))
    assert found.at_bound == (() if told else ("p0/j",))
    assert np.isnan(found.std[0]) != told


@pytest.mark.parametrize(("shown", "told"), [(1.0, True), (1e-5, False)])
def test_a_value_that_could_be_anywhere_is_at_its_bound_by_chance(shown, told):
    """The bias of a joint without gravity ended at 0.1 rad by chance, and exports took it for a finding."""
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((2, 4000)) * np.array([[shown], [1.0]])
    jacobian, space = linear(columns, 2e-3 * rng.standard_normal(4000))
    found = estimate_uncertainty(jacobian, space, torch.tensor([-1.0, 0.0], dtype=torch.float64))
    assert found.at_bound == ("p0/j",) and found.by_chance == (() if told else ("p0/j",))


@pytest.mark.parametrize(
    ("std", "by_chance", "is_open"), [(0.49, (), False), (0.51, (), True), (np.nan, ("p0/j",), True)]
)
def test_what_two_error_bars_spread_over_its_bounds_is_open_and_so_is_what_is_at_one_by_chance(std, by_chance, is_open):
    _, space = linear(np.ones((1, 4)), np.ones(4))  # bounds -1 and 1
    known = {"correlation": np.eye(1), "at_bound": by_chance, "no_influence": (), "indistinguishable": ()}
    uncertainty = Uncertainty(std=np.array([std]), by_chance=by_chance, **known)
    assert _wide(space, uncertainty) == ({"p0/j"} if is_open else set())


def test_everything_at_its_bound_is_survived():
    rng = np.random.default_rng(11)
    jacobian, space = linear(rng.standard_normal((2, 500)), rng.standard_normal(500))
    found = estimate_uncertainty(jacobian, space, torch.tensor([1.0, -1.0], dtype=torch.float64))
    assert found.at_bound == ("p0/j", "p1/j") and np.isnan(found.std).all()


# ---------------------------------------------------------------- in the simulation


def assessed(problem, x):
    return assess(problem, problem.evaluator(), x)


@pytest.mark.slow
def test_a_drive_that_is_off_hides_the_delay():
    off = np.zeros(401, dtype=bool)
    problem = make_problem(record(torque_enable=off, noise=1e-4))
    uncertainty = assessed(problem, normalised(problem)).uncertainty
    assert "delay/all" in uncertainty.no_influence


def test_a_slow_move_in_one_direction_cannot_tell_bias_from_friction():
    ramp = (0.002 * np.minimum(np.arange(401), 400) / 400 + 0.3)[:, None]
    problem = make_problem(record(ramp, noise=1e-4))
    uncertainty = assessed(problem, normalised(problem)).uncertainty
    together = {label for group in uncertainty.indistinguishable for label in group}
    assert {"friction/servo", "encoder_bias/servo"} <= together
    moving = make_problem(record(noise=1e-4))
    uncertainty = assessed(moving, normalised(moving)).uncertainty
    assert uncertainty.indistinguishable == ()


def test_a_parameter_held_fixed_by_its_bounds_is_neither_at_a_bound_nor_without_influence():
    cfg = env_cfg()
    cfg.sim2real.set_bounds("friction", 0.3, 0.3)
    problem = make_problem(record(noise=1e-4, cfg=cfg), cfg=cfg)
    uncertainty = assessed(problem, normalised(problem)).uncertainty
    assert np.isnan(uncertainty.std).tolist() == [False, False, True, False, False]
    assert uncertainty.at_bound == uncertainty.no_influence == ()


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-4])
def test_the_truth_is_inside_the_95_percent_interval_in_90_to_99_percent_of_cases(noise):
    clean = record(chirp(0.8))
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        noisy = clean.dof_pos + noise * rng.standard_normal(clean.dof_pos.shape)
        problem = make_problem([type(clean)(**{**vars(clean), "dof_pos": noisy})])
        evaluator = problem.evaluator()
        best = least_squares(evaluator, [normalised(problem)])[0]
        uncertainty = assess(problem, evaluator, best.x).uncertainty
        error = (problem.space.to_physical(best.x) - physical(problem, TRUTH)).numpy()
        inside += (np.abs(error) < 1.96 * uncertainty.std).tolist()
    assert 0.90 <= np.mean(inside) <= 0.99
