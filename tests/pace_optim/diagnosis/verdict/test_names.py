"""What an effect must show before it is named, how sizes are weighed, and how it is told."""

import json
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diagnoses import FakeFits, errors_of, hidden_run, joint_alone, make_evidence, with_effects
from problems import CALM

from pace_actuators.effects import get_effect
from pace_actuators.files import write_json
from pace_optim.diagnosis import Diagnosis, DiagnosisSettings, diagnose
from pace_optim.diagnosis.checks.data_check import DataCheck
from pace_optim.diagnosis.checks.stated_facts import excluded_effects
from pace_optim.diagnosis.findings import findings
from pace_optim.diagnosis.findings.findings import Findings, evidence_of, more_missing, verdict_of
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.selection.naming import CURVE_LEAVES_LESS, DIFFERS, doubts
from pace_optim.diagnosis.selection.size_consistency import sizes_apart, unevenness
from pace_optim.diagnosis.verdict import names as names_module
from pace_optim.diagnosis.verdict.names import Hint, Names, beside_curves, earned_names, shares_of
from pace_optim.diagnosis.verdict.sizes import error_bars_from_none
from pace_optim.diagnosis.verdict.verdict import part_explained, verdict
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel, labels
from pace_optim.recording import Load
from pace_optim.report import write_report
from pace_optim.run.result import FitResult

SPRING, QUADRATIC, STRIBECK = (get_effect(n) for n in ("parallel_spring", "quadratic_friction", "stribeck_friction"))
CREEP, SKEW = get_effect("creeping_friction"), get_effect("clock_skew")
FLOOR, YES = torch.tensor([1e-4]).double(), torch.tensor([True])
SURE = make_evidence(100.0, 20.0, 1.0)
"""In units of the squared floor: far from it with the effect too."""


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, []),
        ({"left": 40.0}, []),  # it explains more than it leaves
        ({"left": 60.0}, ["it leaves more than it explains"]),
        ({"harm": 40.0}, ["it leaves more than it explains"]),
        ({"bars": 1.9}, ["its size is not significant"]),
        ({"uneven": 0.9, "left": 10.0, "floor": 0.1}, ["its size differs between recordings"]),
        (
            {"uneven": 0.9, "left": 3.0, "floor": 0.1},
            [],
        ),  # by 17 % alone, as little is left
        ({"uneven": 0.2}, ["its size differs between recordings"]),
        ({"at_bound": True}, ["it is at a bound"]),
        ({"implausible": True}, ["no drive has such a value"]),
        ({"left": 8.0, "bars": 0.0, "uneven": 1.0, "at_bound": True}, []),  # it explains everything
        ({"left": 8.0, "bars": 1.9}, ["its size is not significant"]),
        ({"left": 4.0, "implausible": True}, ["no drive has such a value"]),  # a proxy near the floor
        ({"left": 8.0, "harm": 2.0, "uneven": 1.0}, []),  # what it does to other joints is no doubt about its size
        ({"without": 8.0, "left": 1.0}, []),  # the first one of a joint
        ({"without": 8.0, "left": 1.0, "slight": True}, ["the error is near the floor without it"]),
        ({"without": 8.0, "left": 1.0, "larger": 600.0}, ["the error is near the floor without it"]),
        ({"without": 12.0, "left": 1.0, "larger": 600.0}, []),
    ],
)
def test_a_name_is_earned_by_one_rule(changes, said):
    assert doubts(replace(SURE, **changes)) == said


@pytest.fixture(scope="module")
def bench():
    """A short chirp of one joint."""
    return joint_alone()


def ended(bench, rmse, *effects, before=1e-2, trees=()):
    """A search on one joint that ended with effects."""
    base = with_effects(JointModel.base(bench.problem), bench.truth_values)
    return Outcome(
        problem=bench.twins,
        base=base,
        base_errors=errors_of(before),
        final=with_effects(base.model, bench.truth_values, *effects),
        final_errors=errors_of(rmse),
        trees=trees,
    )


def named(monkeypatch, outcome, without, bars=50.0, uneven=0.0, floor=FLOOR):
    """Names of an outcome by what is left without each effect [rad], by the effects that a model then has."""
    even = torch.full(outcome.final.model.has.shape, uneven).double()
    monkeypatch.setattr(names_module, "unevenness", lambda now: even)
    monkeypatch.setattr(names_module, "error_bars_from_none", lambda now: torch.full_like(even, bars))
    moves = torch.ones(len(outcome.final.x), outcome.final.model.size, dtype=torch.bool)
    monkeypatch.setattr(Fitted, "moves", moves)
    fits = FakeFits(lambda now: without(*now.model.names_of_joints[0]))
    monkeypatch.setattr(FakeFits, "looked_at", lambda self, problem, models: models)
    return earned_names(fits, outcome, floor)


def test_of_two_effects_the_one_that_the_joint_can_do_without_goes(bench, monkeypatch):
    """A gain of 0.997, and ripples of 1 %, stood beside what was missing."""
    outcome = ended(bench, 2e-4, (QUADRATIC, [True], [0.2]), (STRIBECK, [True], [1e-3, 0.1]))
    left = {"quadratic_friction": 2.2e-4, "stribeck_friction": 9e-3}
    found = named(monkeypatch, outcome, lambda *names: errors_of(left[names[0]] if names else 1e-2))
    assert labels(found.outcome.final.model, ["servo"]) == ["quadratic_friction"] and found.hints == []
    assert float(found.outcome.final_errors.mse.sqrt()) == pytest.approx(2.2e-4)
    assert found.named.tolist() == [True] and list(shares_of(found, found.outcome)) == [QUADRATIC]


def test_effects_share_what_is_lost_without_them(bench, monkeypatch):
    outcome = ended(bench, 1e-4, (QUADRATIC, [True], [0.2]), (STRIBECK, [True], [1.0, 0.1]))
    left = {"quadratic_friction": 9e-4, "stribeck_friction": 5e-4}
    found = named(monkeypatch, outcome, lambda *names: errors_of(left[names[0]] if names else 1e-2))
    shares = shares_of(found, found.outcome)
    assert list(shares) == [STRIBECK, QUADRATIC] and shares[STRIBECK] == pytest.approx(80 / 104, abs=1e-3)


@pytest.mark.parametrize(
    ("rmse", "before", "bars", "decision", "hints"),
    [
        (5e-3, 1e-2, 50.0, "effect", 0),
        (5e-3, 1e-2, 1.0, "unknown", 1),
        (9e-3, 1e-2, 50.0, "unknown", 1),
        (2e-4, 1e-2, 0.0, "effect", 0),
        (2e-4, 1e-2, 1.0, "unknown", 1),
        (1.2e-4, 1.25e-4, 50.0, "nothing_missing", 0),
    ],
)
def test_where_no_name_is_earned_the_verdict_is_unknown_with_a_hint(
    bench, monkeypatch, rmse, before, bars, decision, hints
):
    outcome = ended(bench, rmse, (SPRING, [True], [2.0, 0.1]), before=before)
    found = named(monkeypatch, outcome, lambda *names: errors_of(before), bars)
    said, end = verdict(found.outcome, FLOOR, found.named)
    assert said == decision and len(found.hints) == hints
    kept = labels(end.final.model, ["servo"])
    assert kept == ([] if decision == "nothing_missing" else ["parallel_spring"])


def test_a_fit_without_it_that_is_as_good_as_with_it_leaves_nothing_to_name(bench, monkeypatch):
    """What paid was another end of the base model: knees of other legs had 0.0005 N m beside a leg's 0.8."""
    outcome = ended(bench, 1.4e-4, (QUADRATIC, [True], [1e-4]))
    found = named(monkeypatch, outcome, lambda *names: errors_of(1.45e-4))
    assert verdict(found.outcome, FLOOR, found.named)[0] == "nothing_missing"


@pytest.mark.parametrize(("base", "kept"), [(2.5e-4, []), (5e-4, ["creeping_friction"])])
def test_a_little_smoothing_of_friction_alone_is_nothing_missing(bench, monkeypatch, base, kept):
    outcome = ended(bench, 1e-4, (CREEP, [True], [0.02]), before=base)
    found = named(monkeypatch, outcome, lambda *names: errors_of(base))
    assert labels(verdict(found.outcome, FLOOR, found.named)[1].final.model, ["servo"]) == kept


def test_what_the_run_had_needs_no_name(bench, monkeypatch):
    outcome = ended(bench, 2e-4, (QUADRATIC, [True], [0.2]), (STRIBECK, [True], [1.0, 0.1]))
    own = with_effects(JointModel.base(bench.problem), bench.truth_values, (QUADRATIC, [True], [0.2]))
    found = named(monkeypatch, replace(outcome, base=own), lambda *names: errors_of(1e-2))
    assert list(shares_of(found, found.outcome)) == [STRIBECK]


def test_the_part_explained_is_of_what_lies_above_the_floor(bench):
    assert part_explained(ended(bench, 1e-4, before=5e-4), FLOOR) == pytest.approx(1.0)
    assert part_explained(ended(bench, 13**0.5 * 1e-4, before=5e-4), FLOOR) == pytest.approx(0.5)


# ---- sizes ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return hidden_run(tmp_path_factory.mktemp("run"), None, duration=3.0)


def fitted_to(problem, *sizes, noise=0.3):
    """A model with a spring, fitted to recordings that would each have the spring in another size, and a friction."""
    model, values = JointModel.base(problem), torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64)
    for effect, own in ((SPRING, [2.0, 0.1]), (QUADRATIC, [0.1])):
        model, values = model.extended(values, effect, YES, torch.tensor([own], dtype=torch.float64))
    now, generator = Fitted.start(model, values), torch.Generator().manual_seed(0)
    jacobian = torch.randn(model.size, 500, len(sizes), 1, generator=generator)
    error = jacobian[model.columns(SPRING).start] * (torch.tensor(sizes) - sum(sizes) / len(sizes))[:, None]
    error += noise * torch.randn(500, len(sizes), 1, generator=generator)
    return replace(now, jacobian=jacobian, error=error)


@pytest.mark.slow
def test_an_effect_whose_size_differs_between_recordings_is_seen(run):
    sizes = torch.tensor([1.0, 1.1, 0.9, 2.0])
    spring, friction = unevenness(fitted_to(run.problem, *sizes))[:, 0].tolist()
    varied = sizes.var(correction=0)
    assert spring == pytest.approx(float(varied / (varied + 0.3**2)), abs=0.05) and abs(friction) < 0.05
    assert float(unevenness(fitted_to(run.problem, 1.0, 1.0, 1.0, 1.0)).max()) < 0.05
    with pytest.raises(ValueError, match="keep_jacobian"):
        unevenness(replace(fitted_to(run.problem, 1.0), jacobian=None))


def test_the_sizes_of_single_recordings_are_those_that_each_shows(run):
    moves = torch.tensor([-0.02, 0.01, 0.01, 0.04])  # normalised: what each recording has beyond the mean
    now = fitted_to(run.problem, *(-moves).tolist(), noise=1e-3)
    apart, columns = sizes_apart(now, SPRING, 0), now.model.columns(SPRING)
    own = (moves - moves.mean()).double()
    x = now.x.repeat(4, 1, 1)
    x[:, 0, columns.start] += own
    expected = torch.stack([now.model.to_physical(each)[0, columns.start] for each in x])
    assert torch.allclose(apart[:, 0], expected, atol=0.02)
    assert torch.allclose(apart[:, 1], now.physical[0, columns.start + 1], atol=0.02)


def test_halves_of_two_recordings_and_quarters_of_one_stand_for_recordings(run):
    assert float(unevenness(fitted_to(run.problem, 1.0, 2.0))[0]) > 0.5
    one = fitted_to(run.problem, 1.0)
    assert float(unevenness(one).max()) < 0.1
    falls = torch.linspace(1, -1, 500)[:, None, None] * one.jacobian[one.model.columns(SPRING).start]
    assert float(unevenness(replace(one, error=one.error + falls))[0]) > 0.5


def test_parameters_at_a_bound_do_not_count(run):
    """Least squares has not brought the error to a right angle with them."""
    even = fitted_to(run.problem, 1.0, 1.0, 1.0, 1.0)
    armature = BASE.index("armature")
    even.x[0, armature] = -1.0
    even.error.add_(0.5 * even.jacobian[armature])
    assert float(unevenness(even).max()) < 0.05


def test_a_size_is_as_many_error_bars_from_none_as_it_is_sure(run):
    """The spring of 2 N m/rad has an error bar of its noise over its lever: 0.3 by the square root of 2000 samples."""
    now = fitted_to(run.problem, 1.0, 1.0, 1.0, 1.0)
    slope = now.model.box.slope(now.x)[0, now.model.columns(SPRING)]
    spring, friction = error_bars_from_none(now)[:, 0].tolist()
    expected = 2.0 / (0.3 / np.sqrt(2000) * float(slope[0]))
    assert spring == pytest.approx(expected, rel=0.2) and friction < spring
    held = replace(now, model=now.model.held(SPRING, ["stiffness"], now.physical))
    assert float(error_bars_from_none(held)[0]) == 0.0


@pytest.mark.parametrize(
    ("effect", "own", "stuck"),
    [
        ("payload", [-0.6], True),
        ("payload", [0.5], False),
        ("stribeck_friction", [1.0, 0.01], True),
        ("stribeck_friction", [4.0, 0.1], True),
        ("stribeck_friction", [0.0, 0.1], False),  # nothing, and not at an end
        ("parallel_spring", [1.0, 6.3], True),
        ("torque_limit", [get_effect("torque_limit").parameters[0].upper], False),  # next to no limit
        ("torque_limit", [get_effect("torque_limit").parameters[0].lower], True),
    ],
)
def test_parameters_at_their_bounds_are_seen_where_they_move_anything(bench, effect, own, stuck):
    now = with_effects(JointModel.base(bench.problem), bench.truth_values, (get_effect(effect), [True], own))
    moves = torch.ones(1, now.model.size, dtype=torch.bool)
    assert now.model.has_at_bounds(now.x, moves).tolist() == [[stuck]]
    assert not now.model.has_at_bounds(now.x, ~moves).any() or len(own) == 1 or own[0] == 4.0


def test_a_spring_that_pushes_is_none_that_drives_have(bench):
    now = with_effects(JointModel.base(bench.problem), bench.truth_values, (SPRING, [True], [-1.0, 0.1]))
    assert now.model.implausible(now.physical).tolist() == [[True]]


def test_loads_that_were_weighed_exclude_a_common_payload_and_measured_gains_their_factors():
    payload, gain = get_effect("payload"), get_effect("proportional_gain")
    recordings = [SimpleNamespace(load=Load(load_mass=mass)) for mass in (0.5, 1.0, 1.0)]
    excluded, why = excluded_effects(recordings, [payload, gain, SPRING], (), 2)
    assert list(excluded) == [payload] and excluded[payload].tolist() == [True, True]
    assert why == ["payload was not tried: recordings state 2 loads."]
    excluded, why = excluded_effects(recordings[1:], [payload, gain, SPRING], ["stiffness"], 1)
    assert list(excluded) == [gain] and why == ["proportional_gain was not tried: stiffness was measured."]
    with pytest.raises(ValueError, match="--measured mass is not understood"):
        DiagnosisSettings(run="x", measured=["mass"])


# ---- how it is told ------------------------------------------------------------------------------------------------


def told_in_words(found, problem):
    """The verdict and its evidence."""
    return " ".join([verdict_of(found, problem), *evidence_of(found, problem)])


def told_of(outcome, decision, shares, hints=()):
    return Findings(
        outcome=outcome,
        data=DataCheck(floor=FLOOR, noise=FLOOR),
        absorbed={},
        verdict=decision,
        explained=0.75,
        joint_names=["servo"],
        shares=shares,
        named={(effect, 0): SURE for effect in shares if decision == "effect"},
        hints=hints,
    )


def test_no_effect_is_put_first_where_none_dominates(bench):
    gain = get_effect("torque_gain")
    outcome = ended(bench, 1e-4, (STRIBECK, [True], [1.0, 0.1]), (QUADRATIC, [True], [0.2]), (gain, [True], [0.9]))
    found = told_of(outcome, "effect", {QUADRATIC: 0.4, gain: 0.35, STRIBECK: 0.25})
    assert told_in_words(found, bench.problem).startswith(
        "Missing: several effects, none of which dominates: quadratic_friction (40 %), torque_gain (35 %), "
        "stribeck_friction (25 %). On held-out"
    )
    found = told_of(outcome, "effect", {QUADRATIC: 0.9974, gain: 0.0026, STRIBECK: 0.0})
    assert "quadratic_friction (99.7 %), torque_gain (0.3 %), stribeck_friction (0 %)" in told_in_words(
        found, bench.problem
    )


def test_nothing_is_explained_to_100_percent_where_more_is_missing(bench):
    for rmse, more in ((4e-4, "More is missing on servo (0.4 mrad, 4 floors)."), (1e-4, "")):
        found = told_of(ended(bench, rmse, (STRIBECK, [True], [1.0, 0.1])), "effect", {STRIBECK: 1.0})
        said = told_in_words(replace(found, explained=0.9996), bench.problem)
        assert "it explains over 99.9 % of what lies above" in said
        assert more in said and ("More is missing" in said) is bool(more)


def test_a_joint_that_is_far_from_the_noise_in_training_alone_is_named(bench):
    """0.6 mrad in training, 5.5 floors, stood beside "more is missing" on another joint."""
    found = told_of(ended(bench, 2e-4, (STRIBECK, [True], [1.0, 0.1])), "effect", {STRIBECK: 1.0})
    assert more_missing(found, bench.problem) == {}
    found = replace(found, trained=torch.tensor([6e-4]))
    assert more_missing(found, bench.problem) == {"servo": "0.6 mrad in training, 6 floors"}


def test_an_effect_that_a_curve_replaces_becomes_a_hint(bench):
    """Stribeck friction took 98 % on two calves, and the output said that no known effect explained them."""
    outcome = ended(bench, 6.2e-4, (STRIBECK, [True], [5.0, 0.3]), before=4.16e-3)
    evidence = {(STRIBECK, 0): make_evidence(4.16e-3**2, 6.2e-4**2, 1.4e-4**2)}
    names = Names(outcome=outcome, named=YES, hints=[], evidence=evidence)
    (hint,) = beside_curves(outcome, names, YES)
    assert (hint.effect, hint.joint, hint.doubts) == ("stribeck_friction", 0, [CURVE_LEAVES_LESS])
    assert hint.explained == pytest.approx(0.979, abs=1e-3) and hint.sizes[0]["value"] == pytest.approx(5.0)
    assert beside_curves(outcome, names, ~YES) == []


def test_what_is_unknown_is_told_with_what_comes_nearest(bench):
    outcome = ended(bench, 5e-3, (SPRING, [True], [2.0, 0.1]))
    hint = Hint(effect="parallel_spring", joint=0, explained=0.75, doubts=["it is at a bound", "no drive has it"])
    said = told_in_words(told_of(outcome, "unknown", {SPRING: 1.0}, [hint]), bench.problem)
    assert said.startswith("Something is missing, and no known effect has earned its name. More is ")
    assert said.endswith("It is not named, as it is at a bound and no drive has it.") and "explains 75 %." in said


def test_a_hint_has_its_size_and_how_far_that_goes_apart(bench):
    size = {"parameter": "stiffness", "value": 2.0, "std": 0.1, "unit": "N m/rad", "factor": None, "at_bound": False}
    far = [size | {"apart": [1.5, 2.5]}]
    hint = Hint(effect="parallel_spring", joint=0, explained=0.75, doubts=[DIFFERS], sizes=far)
    found = told_of(ended(bench, 5e-3, (SPRING, [True], [2.0, 0.1])), "unknown", {SPRING: 1.0}, [hint])
    assert told_in_words(found, bench.problem).endswith(
        "Hint on servo: parallel_spring (stiffness 2 ± 0.1 N m/rad) explains 75 %. It is not named, as its size "
        "differs between recordings (stiffness 1.5 to 2.5 N m/rad)."
    )


@pytest.mark.slow
@pytest.mark.parametrize("stopped", ["converged", "interrupted"])
def test_it_is_fitted_to_the_whole_robot_all_the_same(run, bench, monkeypatch, stopped):
    outcome = ended(bench, 5e-3, (SPRING, [True], [2.0, 0.1]))
    hint = Hint(effect="parallel_spring", joint=0, explained=0.75, doubts=["its size differs between recordings"])
    found = told_of(outcome, "unknown", {SPRING: 1.0}, [hint])
    refits, said, seen, told = [], [], [], []
    refit = run.folder.parent / "refit"

    def fit(settings, progress, on_start, assess_interrupted, before):
        refits.append(settings)
        told.append(len(seen))
        on_start(refit)
        if stopped == "interrupted":
            raise KeyboardInterrupt
        shutil.copytree(run.folder, refit, dirs_exist_ok=True)
        half = {part: dict.fromkeys(("servo", "all"), 0.002) for part in ("train", "validation")}
        replace(FitResult.load(run.folder), rmse=half).save(refit / "result.json")  # the run has 4 mrad
        return SimpleNamespace(stop_reasons=[stopped]), refit

    (run.folder.parent / "refit").mkdir(exist_ok=True)
    module = sys.modules[diagnose.__module__]
    for name, made in (("advise", []), ("error_map", {}), ("sizes", [])):
        monkeypatch.setattr(findings, name, lambda *_, made=made, **__: made)
    monkeypatch.setattr(module, "search_effects", lambda *_, **__: found)
    monkeypatch.setattr(module, "fit", fit)
    asked = json.loads((run.folder / "settings.json").read_text())
    asked["settings"]["instead_of"] = "first"  # as a fit by torques has it
    write_json(run.folder / "settings.json", asked)
    line = SimpleNamespace(say=said.append, wait_for=said.append, restart=lambda: None, close=lambda: None)
    assert diagnose(DiagnosisSettings(run=run.folder), line).runs == [str(run.folder)] and not refits
    diagnosis = diagnose(DiagnosisSettings(run=run.folder, refit=True), line, seen.append)
    assert told == [1] and seen[0].runs == [str(run.folder)]  # the verdict is told before the robot is fitted
    broken_off = stopped == "interrupted"
    assert any(f"scripts/fit.py --resume {refit}" in text for text in said) is broken_off
    assert refits[0].effects == ["parallel_spring"]
    assert refits[0].instead_of is None
    assert diagnosis.runs == [str(run.folder), str(refit)][: 1 if broken_off else 2]
    assert Diagnosis.load(refit).verdict == "unknown"
    assert diagnosis.verdict == "unknown" and diagnosis.added == [] and diagnosis.paying == ["parallel_spring"]
    assert diagnosis.hints[0]["joint"] == "servo" and "75 %" in " ".join(diagnosis.evidence)
    assert diagnosis.advice[0].startswith("To try the hints on the whole robot: ")
    assert diagnosis.advice[0].find(" --effects parallel_spring@servo ") > diagnosis.advice[0].find("fit.py --task") > 0
    assert Diagnosis.load(run.folder) == diagnosis
    page = write_report(run.folder).read_text("utf-8")
    advice = "this lowers the error: <code>scripts/fit.py … --effects parallel_spring</code>"
    assert (advice in page) is broken_off  # a refit has it
    assert "<h1>Something is missing, and no known effect has earned its name. More is missing on servo (" in page
