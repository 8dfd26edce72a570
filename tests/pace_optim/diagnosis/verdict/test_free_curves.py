"""Curves of any form: what they are, and where they take the place of effects that do not explain the error."""

import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from diagnoses import FITS, hidden_run, make_evidence
from problems import BENCH, CALM

from pace_actuators.effects import available_effects, get_effect
from pace_actuators.effects.free_form import FreeForm
from pace_actuators.joint_units import all_hinges
from pace_optim.diagnosis import DiagnosisSettings, candidate_effects, diagnose, search_effects
from pace_optim.diagnosis.checks.data_check import DataCheck
from pace_optim.diagnosis.findings.advice import advise
from pace_optim.diagnosis.findings.findings import evidence_of, verdict_of
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.verdict.free_curves import Curves, _formula, error_map, fit_curves, take_curves
from pace_optim.diagnosis.verdict.names import Names
from pace_optim.diagnosis.verdict.verdict import part_explained, verdict
from pace_optim.joints.fits.base_fit import fit_base
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel, labels
from pace_optim.report import write_report
from pace_optim.run.result import FitResult

CURVES = [name for name in available_effects() if get_effect(name).free_form and not get_effect(name).condition]
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


@pytest.mark.parametrize(
    ("name", "at", "expected"),
    [
        ("torque_over_position", lambda x: 2.0 - 3.0 * (x - 1.0) ** 3, "τ + f(q) with f = 2 N m - "),
        ("torque_over_position", lambda x: math.sin(30 * x), ""),
        ("friction_over_temperature", lambda x: -0.01 * (x - 40.0), "with f = -0.01 1/(°C) (temperature - 40 °C)"),
    ],
)
def test_a_smooth_curve_has_a_formula(name, at, expected):
    effect, reach, center = get_effect(name), 15.0 if "temperature" in name else 0.8, 40.0 if "temp" in name else 1.0
    values = [at(center + reach * knot) for knot in effect.knots if knot != effect.zero]
    fitted = SimpleNamespace(
        jacobian=None,
        physical=torch.tensor([[*values, reach, center]]),
        model=SimpleNamespace(columns=lambda _: slice(None)),
    )
    formula = _formula(fitted, effect, 0, 0.1)
    assert (expected in formula) if expected else not formula


def test_no_diagnosis_looks_for_curves():
    assert len(CURVES) == 11 and all(issubclass(get_effect(name), FreeForm) for name in CURVES)
    assert not any(effect.free_form for effect in candidate_effects())
    with pytest.raises(ValueError, match="which every diagnosis compares with its effects"):
        candidate_effects(["torque_gain", "friction_over_speed"])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short battery of a joint whose friction goes with its position."""
    return hidden_run(tmp_path_factory.mktemp("run"), "friction_map", seed=1, duration=2.5)


@pytest.fixture(scope="module")
def fitted(run):
    """Its base model, and what that leaves."""
    twins, base, _ = fit_base(FITS, run.problem, run.problem.space.to_physical(run.problem.space.start))
    return twins, base, FITS.validation_errors(twins, [base])[0]


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
    )


@pytest.fixture(scope="module")
def curves(fitted):
    return fit_curves(FITS, ended(fitted, 1.0), FLOOR, ~YES)


@pytest.mark.slow
def test_the_curve_over_the_right_variable_explains_the_error(fitted, curves):
    joint = error_map(curves, ["servo"], curves.errors[0])["servo"]
    assert joint["best"] == "friction_over_position" and joint["best_label"] == "position [rad]"
    others = [part for name, part in joint["explained"].items() if name != joint["best"]]
    assert joint["explained"]["friction_over_position"] > 0.9 and max(others) < 0.5
    assert joint["sentence"].startswith("a curve of friction over position explains 9") and "mrad" in joint["sentence"]
    assert len(joint["curve"]["at"]) == len(joint["curve"]["torque"]) == 17
    assert min(joint["curve"]["torque"]) >= 0.0 and joint["kind"] == "friction"  # all of it, and none pushes
    assert error_map(None, ["servo"], None) == {}


@pytest.mark.parametrize(("times", "instead"), [(None, True), (4.8, True), (3.5, False)])
def test_it_takes_the_place_of_effects_that_leave_more_than_twice_as_much(fitted, curves, monkeypatch, times, instead):
    left = 1 - float(curves.explained.max())
    outcome = ended(fitted, 1.0 if times is None else times * left)
    before = outcome.final
    if times is not None:  # as evenly as the curve
        best = curves.errors[curves.best(0)]
        outcome = replace(outcome, final_errors=replace(best, square=times * best.square))
    fits = [outcome.base, *curves.models], [outcome.base_errors, *curves.errors]
    monkeypatch.setattr(Fits, "on_joints", lambda *_: fits)
    found = fit_curves(FITS, outcome, FLOOR, YES & (times is not None))
    assert found.instead.tolist() == [instead]
    outcome = take_curves(outcome, found)
    if not instead:
        assert labels(outcome.final.model, ["servo"]) == ["quadratic_friction"]
        assert verdict(outcome, FLOOR, YES)[0] == "effect"
        assert torch.equal(outcome.final.x, before.x)
        return
    assert labels(outcome.final.model, ["servo"]) == ["friction_over_position"]
    assert verdict(outcome, FLOOR, YES)[0] == "unknown"
    assert part_explained(outcome, FLOOR) == pytest.approx(1 - left, abs=0.01)
    at_floor = replace(outcome, final_errors=replace(outcome.final_errors, square=0.0 * outcome.final_errors.square))
    assert verdict(at_floor, FLOOR, YES)[0] == "unknown"
    # what it says of its errors is what its model leaves
    assert FITS.validation_errors(fitted[0], [outcome.final])[0].mse.tolist() == pytest.approx(
        outcome.final_errors.mse.tolist(), rel=1e-3
    )


@pytest.mark.parametrize(("named", "instead"), [(False, True), (True, False)])
def test_effects_that_are_not_named_do_not_keep_a_curve_away(fitted, curves, monkeypatch, named, instead):
    outcome, (_, _, base) = ended(fitted, 0.6), fitted
    after = [replace(base, square=(0.2 if k == curves.best(0) else 0.9) * base.square) for k in range(len(CURVES))]
    monkeypatch.setattr(Fits, "on_joints", lambda *_: ([outcome.base, *curves.models], [base, *after]))
    assert fit_curves(FITS, outcome, FLOOR, YES & named).instead.tolist() == [instead]


def test_a_curve_takes_the_place_of_several_effects(fitted, curves):
    one, spring = ended(fitted, 0.9), get_effect("parallel_spring")
    values = torch.tensor([[p.start for p in spring.parameters]], dtype=torch.float64)
    two = Fitted.start(*one.final.model.extended(one.final.physical, spring, YES, values))
    outcome = replace(one, final=two)
    taken = take_curves(outcome, replace(curves, instead=YES))
    assert labels(taken.final.model, ["servo"]) == ["friction_over_position"]
    assert take_curves(outcome, replace(curves, instead=~YES)).final is two


def test_no_curve_is_fitted_near_the_floor(fitted):
    near = (fitted[2].mse.sqrt() / 2.5).double()
    assert fit_curves(FITS, ended(fitted, 1.0), near, YES) is None


def test_a_joint_keeps_what_the_whole_robot_shares(fitted):
    assert fit_curves(FITS, ended(fitted, 0.9, "clock_skew"), FLOOR, YES) is None


def errors_of(*rmse):
    return BlockErrors(square=torch.tensor([rmse]).double() ** 2, weight=torch.ones(1).double())


def test_beside_joints_with_a_known_effect_others_keep_their_curves(run, monkeypatch):
    """A spring explains joint a and little of c, a curve joint b; d is at the floor."""
    spring, curve = get_effect("parallel_spring"), get_effect("friction_over_speed")
    one, four = JointModel.base(run.problem), torch.arange(4)
    all_of_them = {side: getattr(one, side).expand(4, -1) for side in ("lower", "upper", "ranges")}
    all_of_them |= {"efforts": one.efforts.expand(4), "loops": one.loops.expand(4)}
    all_of_them["slides"] = one.slides.expand(4)
    model = replace(one, has=torch.zeros(0, 4, dtype=torch.bool), **all_of_them)
    values = torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64).expand(4, -1)
    with_curve = model.extended(values, curve, four < 3, torch.full((4, len(curve.parameters)), 0.1).double())
    with_spring = model.extended(
        values, spring, (four == 0) | (four == 2), torch.tensor([[2.0, 0.1]]).double().expand(4, -1)
    )
    outcome = Outcome(
        problem=None,
        base=Fitted.start(model, values),
        base_errors=errors_of(6e-3, 3e-3, 3e-3, 1e-4),
        final=Fitted.start(*with_spring),
        final_errors=errors_of(1e-4, 3e-3, 2.4e-3, 1e-4),
    )
    curves = Curves(
        joints=(four == 1) | (four == 2),
        effects=[curve],
        models=[Fitted.start(*with_curve)],
        errors=[errors_of(6e-3, 2e-4, 2.9e-3, 1e-4)],
        explained=torch.tensor([[0.0, 0.996, 0.2, 0.0]]),
        instead=four == 1,
    )
    floor = FLOOR.expand(4)
    twins = SimpleNamespace(with_physics_dt=lambda _: None, coarsest_dt=0.0025, control_dt=0.0025)
    for name, result in (
        ("fit_base", (twins, outcome.base, FLOOR)),
        ("check_data", DataCheck(floor=floor, noise=floor)),
        ("absorbed_effects", {spring: four >= 0}),
        ("pool", outcome),
        ("fit_curves", curves),
        (
            "earned_names",
            Names(
                outcome=outcome,
                named=four == 0,
                hints=[],
                evidence={(spring, j): make_evidence(rise, 0.0, 1e-8) for j, rise in ((0, 36e-6), (2, 1e-6))},
            ),
        ),
    ):
        monkeypatch.setattr(sys.modules[search_effects.__module__], name, lambda *_, result=result, **__: result)
    tried = []
    monkeypatch.setattr(
        sys.modules[search_effects.__module__],
        "add_effects",
        lambda _, twins, base: tried.append(base.model.allowed_joints(spring)) or outcome,
    )
    robot = SimpleNamespace(
        joint_names=("a", "b", "c", "d"),
        joint_types=all_hinges(4),
        trees=(),
        dataset=run.problem.dataset,
        control_dt=0.0025,
    )
    found = search_effects(robot, None, [spring], 3)
    assert bool(tried[0].all()) and found.absorbed == {}  # what might not show is tried, and named where it does
    assert found.verdict == "effect" and found.paying == ["parallel_spring@a", "friction_over_speed@b"]
    assert found.added == ["parallel_spring@a"] and found.free_form == ["friction_over_speed@b"]
    assert found.explained == pytest.approx(1 - 9 / 54, abs=0.01)  # with what is kept
    said = " ".join([verdict_of(found, robot), *evidence_of(found, robot)])
    assert said.startswith(
        "Missing: parallel_spring@a. Covered by a curve, without a name: friction_over_speed@b. More is missing on "
        "c (3 mrad, 30 floors). On held-out recordings all of it"
    )
    monkeypatch.setattr("pace_optim.diagnosis.findings.advice.next_experiments", lambda *_: [])
    monkeypatch.setattr("pace_optim.diagnosis.findings.advice.drive_in_force", lambda _: {})
    advice = advise(robot, found.outcome, found.verdict, found.data, [])
    assert any("None of the known effects explains the error of some joints" in sentence for sentence in advice)
    told = error_map(curves, robot.joint_names, outcome.base_errors)
    assert list(told) == ["b", "c"]
    first, last = (told["b"]["curve"]["torque"][i] for i in (0, -1))  # all friction, at 0 and 0.1 rad/s
    assert first == pytest.approx(CALM["friction"])
    weak = told["c"]
    assert weak["curve"] is None and weak["sentence"].startswith("no curve")
    assert last == pytest.approx(CALM["friction"] + 0.1 + 0.1 * CALM["viscous_friction"])


@pytest.mark.slow
def test_an_unknown_effect_gets_a_curve_and_the_robot_is_fitted_with_it(run):
    found = diagnose(DiagnosisSettings(run=run.folder, effects=["torque_gain"], only=True))
    assert found.verdict == "unknown" and found.added == []
    assert found.paying == found.free_form == ["friction_over_position"]
    assert "A curve, friction_over_position, explains" in " ".join(found.evidence)
    refit = FitResult.load(found.runs[-1])
    assert refit.task == BENCH and refit.effects == ["friction_over_position"]
    before, after = (step["validation_rmse"] for step in found.ladder)
    assert refit.rmse["validation"]["all"] == pytest.approx(after, rel=0.5) and after < 0.5 * before
    page = write_report(found.runs[-1]).read_text("utf-8")
    assert "no known effect has earned its name. Covered by a curve: servo" in page and "error-map" in page
