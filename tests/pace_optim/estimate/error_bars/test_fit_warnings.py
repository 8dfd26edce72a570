"""What a user must be told: critical delays against closed forms, bounds, over-fitting, in plain words."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from problems import (
    DT,
    PENDULUMS_TRUTH,
    TRUTH,
    chirp,
    make_problem,
    normalised,
    pendulums_cfg,
    pendulums_target,
    physical,
    record,
)
from scipy.optimize import brentq

from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.error_bars.warnings import critical_delay, fit_warnings, in_words
from pace_optim.recording import Load

FINE = {"train": {"all": 1e-3}, "validation": {"all": 1.1e-3}}


def known(problem, **changes):
    size = problem.space.size
    content = {
        "std": np.zeros(size),
        "correlation": np.eye(size),
        "at_bound": (),
        "no_influence": (),
        "indistinguishable": (),
    }
    return Uncertainty(**{**content, **changes})


# ---------------------------------------------------------------- critical delay


def characteristic(omega, delay, inertia, viscous, stiffness, damping):
    s = 1j * omega
    return inertia * s**2 + viscous * s + (stiffness + damping * s) * np.exp(-s * delay)


@pytest.mark.parametrize(
    "loop",
    [
        (0.14, 4.5, 85.0, 0.6),
        (0.05, 0.5, 20.0, 1.5),
        (0.3, 7.0, 85.0, 0.0),
        (0.02, 0.0, 60.0, 2.0),
        (1.0, 1.0, 5.0, 9.0),
    ],
)
def test_at_the_critical_delay_a_root_lies_on_the_imaginary_axis_and_at_no_shorter_one(loop):
    stiffness = loop[2]
    delay = critical_delay(*loop)
    omegas = np.geomspace(1e-2, 1e4, 200_001)
    assert np.abs(characteristic(omegas, delay, *loop)).min() < 1e-3 * stiffness
    for part in np.linspace(0.0, 0.99, 12):
        assert np.abs(characteristic(omegas, part * delay, *loop)).min() > 1e-3 * stiffness


def test_without_derivative_gain_the_critical_delay_has_a_closed_form():
    # |I w² - i d w| = P, and tan(w T) = d / (I w)
    inertia, viscous, stiffness = 0.1, 2.0, 50.0
    omega = brentq(lambda w: math.hypot(inertia * w**2, viscous * w) - stiffness, 1.0, 100.0)
    assert critical_delay(inertia, viscous, stiffness, 0.0) == pytest.approx(
        math.atan2(viscous, inertia * omega) / omega, rel=1e-9
    )


def test_an_undamped_loop_endures_no_delay_and_a_loop_without_gain_any():
    assert critical_delay(0.1, 0.0, 50.0, 0.0) == pytest.approx(0.0, abs=1e-12)
    assert critical_delay(0.1, 1.0, 0.0, 0.0) == math.inf


def bench_warnings(delay, delay_mode="effort", **facts):
    truth = {**TRUTH, "viscous_friction": 1.0, "friction": 0.0, "delay": delay}
    problem = make_problem(record(chirp(0.2), truth, **facts), delay_mode=delay_mode)
    return fit_warnings(problem, physical(problem, truth), known(problem), FINE)


def bench_limit(stiffness=85.0, damping=0.6, load=1.0 * 0.2**2):
    return critical_delay(0.1 + load, 1.0, stiffness, damping) / 0.0025


def test_a_delay_beyond_the_critical_one_is_told_and_one_below_is_not():
    limit = bench_limit()
    assert 0 < limit < 9
    (told,) = bench_warnings(1.05 * limit)
    assert f"critical delay of the control loop of servo ({2.5 * limit:.1f} ms)" in told
    assert bench_warnings(0.95 * limit) == []


def test_a_delayed_command_lies_outside_of_the_loop():
    assert bench_warnings(9.9, delay_mode="command") == []


def test_the_critical_delay_is_that_of_the_recordings_own_gains_and_load():
    stiff, soft = bench_limit(stiffness=200.0), bench_limit(stiffness=70.0)
    between = (stiff + bench_limit()) / 2
    assert stiff < between < bench_limit() < 0.9 * soft
    (told,) = bench_warnings(between, drive={"stiffness": 200.0})
    assert f"({2.5 * stiff:.1f} ms)" in told
    assert bench_warnings(0.9 * soft, drive={"stiffness": 70.0}) == []
    heavy = bench_limit(load=3.0 * 0.3**2)
    (told,) = bench_warnings(1.1 * max(heavy, bench_limit()), load=Load(load_mass=3.0, load_length=0.3))
    assert f"({2.5 * heavy:.1f} ms)" in told


def test_several_loops_are_told_in_one_sentence(tmp_path):
    truth = {**PENDULUMS_TRUTH, "viscous_friction": 0.1, "delay": 7.0}
    cfg = pendulums_cfg(tmp_path)
    recording = record(pendulums_target(0.1), cfg=cfg, truth=PENDULUMS_TRUTH)
    problem = make_problem([recording, recording], cfg=cfg, delay_mode="effort")
    (told,) = fit_warnings(problem, physical(problem, truth), known(problem), FINE)
    assert "left (" in told and " and right (" in told


@pytest.mark.slow
def test_the_simulation_oscillates_by_itself_where_the_warning_says_so():
    ends = {}
    for part in (0.7, 1.3):
        truth = {**TRUTH, "viscous_friction": 1.0, "friction": 0.0, "encoder_bias": 0.0, "delay": part * bench_limit()}
        target = np.where(np.arange(1201) < 40, 0.05, 0.0)[:, None]
        ends[part] = np.ptp(record(target, truth, delay_mode="effort").dof_pos[-200:])
    assert ends[0.7] < 5e-3 < 5e-2 < ends[1.3]


# ---------------------------------------------------------------- bounds, influence, pairs


def test_bounds_are_told_with_side_and_value_and_joints_are_gathered():
    problem = make_problem(record(chirp(0.2)))
    at = physical(problem, {**TRUTH, "friction": 2.0, "encoder_bias": -0.1, "delay": 10.0})
    labels = ("friction/servo", "encoder_bias/servo", "delay/all")
    told = fit_warnings(problem, at, known(problem, at_bound=labels), FINE)
    assert len(told) == 1 and told[0].startswith(
        "At a bound: friction (upper, 2 N m) of servo; encoder bias (lower, -0.1 rad) of servo; "
        "delay (upper, 25 ms). Find the missing physics"
    )


def test_a_limit_at_its_upper_bound_was_not_reached():
    """A reader was asked to find the physics that a torque limit stands in for, which no motion had reached."""
    problem = make_problem(record(chirp(0.2))).with_effects(["torque_limit", "torque_gain"])
    limit, gain = (f"{name}/servo" for name in ("torque_limit.effort", "torque_gain.gain"))
    high, low = problem.space.upper.clone(), problem.space.lower.clone()
    told = fit_warnings(problem, high, known(problem, at_bound=(limit, gain)), FINE)
    bound = f"{float(high[problem.space.labels.index(limit)]):g} N m"
    missing, open_above = (each for each in told if "[W9]" in each)
    assert "torque gain (upper" in missing and "torque limit" not in missing
    assert f"torque limit effort (upper, {bound}) of servo" in open_above and "physics" not in open_above
    (missing,) = (each for each in fit_warnings(problem, low, known(problem, at_bound=(limit,)), FINE) if "W9" in each)
    assert "physics" in missing


@pytest.mark.parametrize("others", [(), ("encoder_bias/servo",)])
def test_commands_count_as_logged_too_rarely_where_a_delay_of_none_is_too_late(others):
    problem = make_problem(record(noise=1e-4))
    slow = dataclasses.replace(problem.dataset.recordings[0], sample_stride=8)
    problem = dataclasses.replace(problem, dataset=dataclasses.replace(problem.dataset, recordings=(slow,)))
    far = {"train": {"all": 5e-3}, "validation": {}}
    at = physical(problem, {**TRUTH, "delay": 0.0, "friction": 2.0, "encoder_bias": -0.1})
    told = fit_warnings(problem, at, known(problem, at_bound=("delay/all", *others)), far)
    assert any("logged with the samples, every 20 ms" in each for each in told)
    assert any("At a bound: " in each and "widen" not in each for each in told)  # physics is missing
    late = physical(problem, {**TRUTH, "delay": 10.0})  # the other bound: the commands are early enough
    told = fit_warnings(problem, late, known(problem, at_bound=("delay/all", *others)), far)
    assert not any("logged with the samples" in each for each in told)


@pytest.mark.slow
def test_a_fit_whose_truth_is_beyond_a_bound_is_told():
    problem = make_problem(record(truth={**TRUTH, "friction": 0.0}, noise=1e-4))
    x = normalised(problem, {**TRUTH, "friction": 0.0})
    evaluator = problem.evaluator()
    uncertainty = assess(problem, evaluator, x).uncertainty
    told = fit_warnings(problem, problem.space.to_physical(x), uncertainty, FINE)
    assert len(told) == 1 and told[0].startswith("At a bound: friction (lower, 0 N m) of servo.")


def test_parameters_without_influence_and_inseparable_ones_are_named():
    problem = make_problem(record(chirp(0.2)))
    uncertainty = known(
        problem, no_influence=("delay/all",), indistinguishable=(("encoder_bias/servo", "friction/servo"),)
    )
    told = fit_warnings(problem, physical(problem), uncertainty, FINE, ["delay/all"])
    assert len(told) == 2
    assert told[0].startswith("These recordings do not show delay (kept at ") and " ms)" in told[0]
    assert "To identify it, send steps or a fast chirp." in told[0]
    assert "cannot separate encoder bias and friction of servo" in told[1]


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        (("encoder_bias/LF_HFE", "friction/LF_HFE"), "encoder bias and friction of LF_HFE"),
        (("armature/a", "viscous_friction/a", "delay/all"), "armature, viscous friction and delay of a"),
        (("friction/a", "friction/b"), "friction of a and friction of b"),
    ],
)
def test_sets_of_parameters_read_as_words(labels, words):
    assert in_words(labels) == words


# ---------------------------------------------------------------- over-fitting


@pytest.mark.parametrize(
    ("train", "validation", "told"),
    [
        ({"all": 1e-3}, {"all": 1.4e-3}, False),
        ({"all": 1e-3}, {"all": 1.6e-3}, True),
        ({"all": 1e-9}, {"all": 1e-7}, False),  # nothing to speak of
        ({"all": 1e-3}, {}, False),
    ],
)
def test_a_validation_error_far_above_the_training_error_is_told(train, validation, told):
    problem = make_problem(record(chirp(0.2)))
    found = fit_warnings(problem, physical(problem), known(problem), {"train": train, "validation": validation})
    assert any("does not carry over" in warning for warning in found) is told
    if told:
        assert "1.6 mrad" in found[0] and "1.6 times" in found[0] and "does not carry over" in found[0]


@pytest.mark.parametrize(("change", "told"), [(0.7e-3, True), (0.9e-3, False), (5e-3, False), (10e-3, True)])
def test_what_the_physics_step_adds_to_the_validation_error_is_not_held_against_the_fit(change, told, monkeypatch):
    problem = make_problem(record(chirp(0.2)))
    monkeypatch.setattr("pace_optim.estimate.error_bars.warnings.step_error", lambda *_: torch.tensor([change]))
    rmse = {"train": {"all": 1e-3}, "validation": {"all": 1.7e-3}}
    found = fit_warnings(problem, physical(problem), known(problem), rmse)
    assert any("does not carry over" in warning for warning in found) is told


@pytest.mark.parametrize(("of_the_change", "told"), [(0.1, False), (0.5, True), (2.0, True), (5.0, False)])
def test_a_physics_step_that_makes_the_error_is_told(of_the_change, told):
    problem = make_problem(record(chirp(0.2)))
    at, where = physical(problem), problem.dataset.train
    coarse, fine = (
        p.evaluator().residuals(at[None], where).error[0] for p in (problem, problem.with_physics_dt(DT / 2))
    )
    change = float((coarse - fine)[where[: len(coarse)]].square().mean().sqrt())
    assert change > 1e-4
    found = fit_warnings(problem, at, known(problem), {"train": {"all": of_the_change * change}, "validation": {}})
    step = [warning for warning in found if "--physics_dt 0.00125" in warning]
    assert bool(step) is told and all(f"by {1e3 * change:.3g} mrad" in warning for warning in step)


def test_all_well_says_nothing():
    problem = make_problem(record(chirp(0.2)))
    assert fit_warnings(problem, physical(problem), known(problem), FINE) == []
    assert torch.isfinite(physical(problem)).all()
