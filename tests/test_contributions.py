"""How much of what was found together is due to each effect, and how it is told."""

from types import SimpleNamespace

import pytest
import torch
from diagnoses import FITS, FakeFits, errors_of, joint_alone, make_search, with_effects

from pace_actuators.effects import get_effect
from pace_optim.diagnosis.beginning.data_check import DataCheck
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.diagnosis.search.search import without_idle
from pace_optim.diagnosis.search.state import Branch
from pace_optim.diagnosis.telling.findings import Findings, summary_of
from pace_optim.diagnosis.verdict.contributions import contributions
from pace_optim.single_joint_fits.labels import labels
from pace_optim.single_joint_fits.model import JointModel

STRIBECK, QUADRATIC, GAIN = (get_effect(n) for n in ("stribeck_friction", "quadratic_friction", "torque_gain"))


@pytest.fixture(scope="module")
def bench():
    """A short chirp of one joint."""
    return joint_alone()


def findings(outcome, each):
    floor = torch.tensor([1e-4])
    return Findings(
        outcome=outcome,
        data=DataCheck(floor=floor, noise=floor, numerical=floor),
        absorbed={},
        verdict="effect",
        explained=0.9,
        paying=labels(outcome.final.model, ["servo"], list(each)),
        shares=each,
    )


@pytest.mark.parametrize(
    ("without", "expected", "said"),
    [
        ((9e-4, 2e-4), (0.964, 0.036), "Missing: stribeck_friction (96 %), quadratic_friction (4 %). With"),
        ((2e-4, 9e-4), (0.964, 0.036), "Missing: quadratic_friction (96 %), stribeck_friction (4 %). With"),
        ((9e-4, 1.1e-4), (0.9974, 0.0026), "Missing: stribeck_friction (100 %), quadratic_friction (0.3 %). With"),
        ((0.5e-4, 2e-4), (1.0, 0.0), "Missing: quadratic_friction (100 %), stribeck_friction (below 0.1 %). With"),
    ],
)
def test_what_is_due_to_an_effect_is_what_is_lost_without_it(bench, without, expected, said):
    base, values = JointModel.base(bench.problem), bench.truth_values
    final = with_effects(base, values, (QUADRATIC, [True], [0.2]), (STRIBECK, [True], [1.0, 0.1]))
    after = {STRIBECK: errors_of(without[0]), QUADRATIC: errors_of(without[1])}
    outcome = SimpleNamespace(
        problem=bench.twins,
        final=final,
        final_errors=errors_of(1e-4),
        base_errors=errors_of(1e-3),
        unevenness=torch.zeros(2, 1),
        cfg=DEFAULT,
    )
    each = contributions(FakeFits(lambda now: after[now.tried]), outcome)
    assert list(each.values()) == pytest.approx(expected, abs=1e-3)
    found = findings(outcome, each)
    assert summary_of(found, bench.problem).startswith(said)
    assert contributions(FITS, SimpleNamespace(final=with_effects(base, values, (GAIN, [True], [0.8])))) == {GAIN: 1.0}


def test_an_effect_that_a_joint_can_do_without_is_none(bench):
    """What paid there is another end of the base model: knees of other legs had 0.0005 N m beside a leg's 0.8."""
    base = JointModel.base(bench.problem)
    both = [(QUADRATIC, [True], [0.2]), (STRIBECK, [True], [1e-4, 0.1])]
    now = with_effects(base, bench.truth_values, *both)

    def left(now, without, **changes):
        search = make_search(lambda each: errors_of(without[each.tried]), **changes)
        branch = without_idle(search, Branch(problem=bench.twins, now=now, errors=errors_of(1e-4)))
        return labels(branch.now.model, ["servo"]), float(branch.errors.mse.sqrt())

    told = {QUADRATIC: 9e-4, STRIBECK: 1.01e-4}
    assert left(now, told) == (["quadratic_friction"], pytest.approx(1.01e-4))
    assert left(now, told | {STRIBECK: 1.1e-4})[0] == ["quadratic_friction", "stribeck_friction"]
    assert left(now, told, off=("idle",))[0] == ["quadratic_friction", "stribeck_friction"]
    alone = with_effects(base, bench.truth_values, both[1])
    assert left(alone, told)[0] == ["stribeck_friction"]  # what lowered the error is told


def test_no_name_is_claimed_where_none_dominates(bench):
    base, values = JointModel.base(bench.problem), bench.truth_values
    effects = ((STRIBECK, [True], [1.0, 0.1]), (QUADRATIC, [True], [0.2]), (GAIN, [True], [0.9]))
    outcome = SimpleNamespace(
        final=with_effects(base, values, *effects),
        final_errors=errors_of(1e-4),
        base_errors=errors_of(1e-3),
        unevenness=torch.zeros(3, 1),
        cfg=DEFAULT,
    )
    found = findings(outcome, {QUADRATIC: 0.4, GAIN: 0.35, STRIBECK: 0.25})
    assert summary_of(found, bench.problem).startswith(
        "Missing: several effects, none of which dominates: quadratic_friction (40 %), torque_gain (35 %), "
        "stribeck_friction (25 %). With"
    )
