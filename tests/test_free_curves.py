"""Curves of any form: what they are, and where they take the place of effects that do not explain the error."""

from dataclasses import replace

import pytest
import torch
from diagnoses import hidden_run
from problems import BENCH

from pace_actuators.effects import available_effects, get_effect
from pace_actuators.effects.free_form import FreeForm
from pace_optim.diagnosis import DiagnosisSettings, candidate_effects, diagnose
from pace_optim.diagnosis.base_fit import fit_base
from pace_optim.diagnosis.fitted import Fitted
from pace_optim.diagnosis.free_curves import error_map, fit_curves, take_curves
from pace_optim.diagnosis.search import Outcome
from pace_optim.diagnosis.validation import validation_errors
from pace_optim.diagnosis.verdict import labels, verdict
from pace_optim.fit_result import FitResult
from pace_optim.report import write_report

CURVES = [name for name in available_effects() if get_effect(name).free_form]
YES = torch.tensor([True])
FLOOR = torch.tensor([1e-4], dtype=torch.float64)


def made(name, efforts, **shape):
    """A curve of one joint, float64."""
    effect = get_effect(name)(1, 1, dt=0.0025, control_dt=0.0025, dtype=torch.float64)
    for i, effort in enumerate(efforts):
        effect.set_parameter(f"effort_{i}", effort)
    for key, value in shape.items():
        effect.set_parameter(key, value)
    effect.prepare()
    return effect


def values_at(effect, *x):
    return [float(effect.at(torch.tensor([[each]], dtype=torch.float64))) for each in x]


def test_a_curve_is_straight_between_its_knots_and_constant_beyond_them():
    friction = made("friction_over_speed", [1, 2, 3, 4, 5, 6, 7, 8.0], reach=2.0)
    assert friction.knots == (0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8, 1.0)
    assert values_at(friction, 0.0, 0.03, 0.06, 0.11, 1.6, 2.0, 99.0) == pytest.approx([0, 0.5, 1, 1.5, 7, 8, 8])
    torque = made("torque_over_position", range(17), reach=0.8, center=1.0)
    assert values_at(torque, -5.0, 0.2, 0.25, 1.0, 1.8, 5.0) == pytest.approx([0, 0, 0.5, 8, 16, 16])
    odd = made("torque_over_torque", [-6, -5, -4, -3, -2, -1, 1, 2, 3, 4, 5, 6.0], reach=10.0)
    assert values_at(odd, -20.0, -0.15, 0.0, 0.15, 3.0) == pytest.approx([-6, -0.5, 0, 0.5, 4])
    points = odd.curve({p.name: float(getattr(odd, p.name)) for p in odd.parameters})
    assert points["torque"] == pytest.approx(values_at(odd, *points["at"])) and len(points["at"]) == 13


def test_no_diagnosis_looks_for_curves_unless_it_is_told_to():
    assert len(CURVES) == 6 and all(issubclass(get_effect(name), FreeForm) for name in CURVES)
    assert not any(effect.free_form for effect in candidate_effects())
    assert candidate_effects(["friction_over_speed"])[-1] is get_effect("friction_over_speed")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short battery of a joint whose friction goes with its position."""
    return hidden_run(tmp_path_factory.mktemp("run"), "friction_map", seed=1, duration=5.0)


@pytest.fixture(scope="module")
def fitted(run):
    """Its base model, and what that leaves."""
    twins, base, _ = fit_base(run.problem, run.problem.space.to_physical(run.problem.space.start))
    return twins, base, validation_errors(twins, [base])[0]


def ended(fitted, part, effect="quadratic_friction"):
    """A search that ended with an effect which leaves so much of the squared error; with none if that is all of it."""
    twins, base, errors = fitted
    final = base
    if part < 1.0:
        values = torch.tensor([[p.start for p in get_effect(effect).parameters]], dtype=torch.float64)
        final = Fitted.start(*base.model.extended(base.model.to_physical(base.x), get_effect(effect), YES, values))
    return Outcome(
        problem=twins,
        base=base,
        base_errors=errors,
        final=final,
        final_errors=replace(errors, square=part * errors.square),
        unevenness=torch.zeros(len(final.model.effects), 1),
    )


@pytest.fixture(scope="module")
def curves(fitted):
    return fit_curves(ended(fitted, 1.0), FLOOR)


def test_the_curve_over_the_right_variable_explains_the_error(fitted, curves):
    joint = error_map(curves, ended(fitted, 1.0), ["servo"])["servo"]
    assert joint["best"] == "friction_over_position" and joint["best_label"] == "position [rad]"
    others = [part for name, part in joint["explained"].items() if name != joint["best"]]
    assert joint["explained"]["friction_over_position"] > 0.9 and max(others) < 0.5
    assert joint["sentence"].startswith("a curve of friction over position explains 9") and "mrad" in joint["sentence"]
    assert len(joint["curve"]["at"]) == len(joint["curve"]["torque"]) == 17
    assert error_map(None, ended(fitted, 1.0), ["servo"]) == {}


@pytest.mark.parametrize(("part", "instead"), [(1.0, True), (0.3, True), (0.04, False)])
def test_it_takes_the_place_of_effects_that_leave_more_than_twice_as_much(fitted, curves, monkeypatch, part, instead):
    outcome = ended(fitted, part)
    before = outcome.final
    left = 1 - float(curves.explained.max())
    assert 0.5 * 0.04 < left < 0.5 * 0.3
    refitted = "pace_optim.diagnosis.free_curves.SomeJoints.refitted"
    monkeypatch.setattr(refitted, lambda *_: (curves.models, curves.errors))
    found = fit_curves(outcome, FLOOR)
    assert found.instead.tolist() == [instead]
    take_curves(outcome, found)
    if not instead:
        assert labels(outcome.final.model, ["servo"]) == ["quadratic_friction"]
        assert verdict(outcome, FLOOR)[0] == "effect"
        assert torch.equal(outcome.final.x, before.x)
        return
    assert labels(outcome.final.model, ["servo"]) == ["friction_over_position"]
    decision, explained = verdict(outcome, FLOOR)
    assert decision == "unknown" and explained == pytest.approx(1 - left, abs=0.01)
    # what it says of its errors is what its model leaves
    assert validation_errors(fitted[0], [outcome.final])[0].mse.tolist() == pytest.approx(
        outcome.final_errors.mse.tolist(), rel=1e-3
    )


def test_no_curve_is_fitted_near_the_floor(fitted):
    near = (fitted[2].mse.sqrt() / 2.5).double()
    assert fit_curves(ended(fitted, 1.0), near) is None


@pytest.mark.slow
def test_an_unknown_effect_gets_a_curve_and_the_robot_is_fitted_with_it(run):
    found = diagnose(DiagnosisSettings(run=run.folder, effects=["torque_gain"], only=True))
    assert found.verdict == "unknown" and found.added == [] and found.free_form
    assert found.paying == ["friction_over_position"]
    assert "a curve in its place, friction_over_position," in found.summary
    refit = FitResult.load(found.runs[-1])
    assert refit.task == BENCH and refit.effects == ["friction_over_position"]
    before, after = (step["validation_rmse"] for step in found.ladder)
    assert refit.rmse["validation"]["all"] == pytest.approx(after, rel=0.5) and after < 0.3 * before
    page = write_report(found.runs[-1]).read_text("utf-8")
    assert "a curve takes its place" in page and "error-map" in page
