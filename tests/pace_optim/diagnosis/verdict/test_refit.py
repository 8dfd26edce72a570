"""The rule that names effects on joints alone judges the whole robot's fit too."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from diagnoses import errors_of, joint_alone, make_diagnosis, make_evidence, with_effects

from pace_actuators.effects import get_effect
from pace_optim.diagnosis import Diagnosis
from pace_optim.diagnosis.checks.data_check import DataCheck
from pace_optim.diagnosis.diagnose import _stands
from pace_optim.diagnosis.findings.findings import Findings, as_refitted, with_refit
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.wrong_links import LinkFindings
from pace_optim.joints.fits.model import JointModel

QUADRATIC, BACKLASH = get_effect("quadratic_friction"), get_effect("backlash")
FLOOR = torch.tensor([1e-4]).double()
ALONE = make_evidence(1e-4, 1e-8, 1e-8)
"""Of the joint alone: from 10 mrad to the floor of 0.1."""


def found_on_joints(*effects):
    """A joint alone whose effects are named."""
    bench = joint_alone()
    base = with_effects(JointModel.base(bench.problem), bench.truth_values)
    final = with_effects(base.model, bench.truth_values, *((effect, [True], own) for effect, own in effects))
    outcome = Outcome(
        problem=bench.twins,
        base=base,
        base_errors=errors_of(1e-2),
        final=final,
        final_errors=errors_of(1e-4),
    )
    shares = {effect: 1.0 / len(effects) for effect, _ in effects}
    return Findings(
        outcome=outcome,
        data=DataCheck(floor=FLOOR, noise=FLOOR),
        absorbed={},
        verdict="effect",
        explained=1.0,
        joint_names=["servo"],
        shares=shares,
        named={(effect, 0): ALONE for effect, _ in effects},
    )


def fit_of(rmse, value=None, std=None, at_bound=(), effect="quadratic_friction.coefficient", **changes):
    """A fit of the whole robot."""
    named = {} if value is None else {effect: {"servo": value}}
    own = {"std": {} if value is None else {effect: {"servo": std}}, "std_means_nothing": False, **changes}
    return SimpleNamespace(
        rmse={key: {"servo": rmse, "all": rmse} for key in ("train", "validation")},
        curves={},
        parameters=named,
        at_bound=list(at_bound),
        joint_types=["hinge"],
        joint_type=lambda _: "hinge",
        **own,
    )


@pytest.mark.parametrize(
    ("before", "refit", "doubt"),
    [
        (1e-2, fit_of(1e-4, 0.2, 0.01), None),
        (1e-2, fit_of(2e-3, 0.2, 0.01), None),  # far from the floor, and most is explained
        (1e-2, fit_of(9e-3, 0.2, 0.01), "it leaves more than it explains"),
        (1e-2, fit_of(1e-4, 0.01, 0.01), "its size is not significant"),
        (1e-2, fit_of(2e-3, 0.2, None), "its size is not significant"),
        (1e-2, fit_of(2e-3, 0.2, None, std_means_nothing=True), None),  # its joint alone knows
        (2e-3, fit_of(1.9e-3, 0.2, 0.01), "it leaves more than it explains"),  # so little is missing
        (
            2e-2,
            fit_of(8e-3, 0.2, 0.01),
            "it leaves more than it explains",
        ),  # the joint alone does as well
    ],
)
def test_the_whole_robot_s_fit_is_judged_by_the_rule_of_joints_alone(before, refit, doubt):
    found = as_refitted(found_on_joints((QUADRATIC, [0.2])), fit_of(before), refit)
    assert found.verdict == ("effect" if doubt is None else "unknown")
    assert found.added == ([] if doubt else ["quadratic_friction"]) and found.paying == ["quadratic_friction"]
    assert [each.doubts for each in found.hints] == ([] if doubt is None else [[doubt]])


def test_a_robot_that_is_complete_without_the_effect_lacks_nothing():
    found = as_refitted(found_on_joints((QUADRATIC, [0.2])), fit_of(1.2e-4), fit_of(1.1e-4, 0.001, 0.01))
    assert found.verdict == "nothing_missing" and found.hints == [] and found.added == []


def test_of_two_effects_only_the_one_that_the_fit_refutes_loses_its_name():
    found = found_on_joints((QUADRATIC, [0.2]), (BACKLASH, [0.01, 500.0, 5.0, 0.0][: len(BACKLASH.parameters)]))
    refit = fit_of(1e-4, 0.2, 0.01)
    gap = f"backlash.{BACKLASH.parameters[0].name}"
    refit.parameters[gap], refit.std[gap] = {"servo": 1e-3}, {"servo": 1e-3}
    found = as_refitted(found, fit_of(1e-2), refit)
    assert found.verdict == "effect" and found.added == ["quadratic_friction"]
    assert found.hints == []  # its size is zero, and the other explains the error


def told_again(found, refit, sizes, tmp_path):
    """A diagnosis once the whole robot is fitted."""
    problem = SimpleNamespace(joint_names=("servo",), joint_types=["hinge"])
    diagnosis = Diagnosis(**make_diagnosis() | {"sizes": sizes, "run": "first"})
    return with_refit(diagnosis, found, LinkFindings(), problem, fit_of(1e-2), refit, tmp_path)


def size_of(effect, parameter):
    return {
        "effect": effect,
        "parameter": parameter,
        "joint": "servo",
        "value": 0.2,
        "std": 0.002,
        "unit": "1",
        "factor": None,
        "at_bound": False,
    }


def test_verdict_errors_and_sizes_are_those_of_the_whole_robot_s_fit(tmp_path):
    sizes = [size_of("quadratic_friction", "coefficient"), size_of("payload", "mass")]
    found = found_on_joints((QUADRATIC, [0.2]))
    told = told_again(found, fit_of(1.5e-4, 0.25, 0.01), sizes, tmp_path)
    assert told.verdict == "effect" and told.runs == ["first", str(tmp_path)]
    own = {"value": 0.25, "std": 0.01, "unit": "N m s^2/rad^2"}
    assert told.sizes == [sizes[0] | own, sizes[1]]
    assert told.joints["servo"]["validation_rmse_after"] == pytest.approx(1.5e-4)
    assert [step["run"] for step in told.ladder] == told.runs
    assert "the whole robot's validation error falls from 10 to 0.15 mrad" in told.evidence[-1]
    far = told_again(found, fit_of(2e-3, 0.25, 0.01), sizes, tmp_path)
    assert far.sizes[0]["std"] is None and "More is missing on servo (2 mrad, 20 floors)" in far.summary
    lost = told_again(found, fit_of(9e-3, 0.25, 0.01), sizes, tmp_path)
    assert lost.verdict == "unknown" and lost.added == [] and lost.joints["servo"]["effects"] == ["quadratic_friction"]
    (hint,) = (sentence for sentence in lost.evidence if sentence.startswith("Hint"))
    assert hint.startswith("Hint on servo: quadratic_friction (coefficient 0.25 ± 0.01 N m s^2/rad^2) explains 19 %.")
    assert hint.endswith("It is not named, as it leaves more than it explains.")
    assert not any(entry["added"] for entry in lost.ranking)


def test_a_stiff_effect_above_the_floor_has_no_error_bar_in_the_whole_robot_either(tmp_path):
    gap = BACKLASH.parameters[0].name
    found = found_on_joints((BACKLASH, [0.01, 500.0, 5.0, 0.0][: len(BACKLASH.parameters)]))
    refit = fit_of(1.5e-4, 0.01, 1e-5, effect=f"backlash.{gap}")
    (size,) = told_again(found, refit, [size_of("backlash", gap)], tmp_path).sizes
    assert size["value"] == 0.01 and size["std"] is None


@pytest.mark.parametrize(("left", "stands"), [(1.1e-4, True), (9e-3, False)])
def test_a_hint_becomes_a_name_where_the_whole_robot_s_fit_leads_near_the_floor(left, stands):
    """Of joints that move each other one was a hint, `but its size differs`; the whole robot ended at its noise."""
    on_trial = found_on_joints((QUADRATIC, [0.2]))
    on_trial = replace(on_trial, named={(QUADRATIC, 0): replace(ALONE, left=9e-5, uneven=5.0)})
    found = replace(on_trial, named={}, verdict="unknown", on_trial=on_trial)
    run, refit = fit_of(1e-2), fit_of(left, 0.2, 0.01)
    assert _stands(on_trial, found, run, refit) is stands and _stands(found, found, run, refit)
    again = as_refitted(on_trial, run, refit)
    assert again.added == (["quadratic_friction"] if stands else [])
    assert again.verdict == ("effect" if stands else "unknown")
