"""Models of joints alone with effects: their parameters, values that joints share, what is dropped."""

from dataclasses import replace

import pytest
import torch
from diagnoses import FakeFits, errors_of, joint_alone

from pace_actuators.effects import get_effect, probe_points
from pace_optim.diagnosis.candidates.screening import Probe
from pace_optim.diagnosis.search.one_round import _ranked
from pace_optim.diagnosis.search.pooling import pool
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel, start_values

STRIBECK, QUADRATIC, GAIN = (get_effect(n) for n in ("stribeck_friction", "quadratic_friction", "torque_gain"))


@pytest.fixture(scope="module")
def bench():
    """A short chirp of one joint."""
    return joint_alone()


def test_normalised_values_go_there_and_back(bench):
    model = JointModel.base(bench.problem).with_effect(STRIBECK, torch.tensor([True]))
    assert model.size == len(BASE) + 2 and bool(model.log[-1]) and not bool(model.log[-2])
    x = torch.linspace(-1, 1, model.size, dtype=torch.float64)[None]
    assert model.to_normalised(model.to_physical(x)) == pytest.approx(x, abs=1e-9)
    low = model.to_physical(torch.full_like(x, -1.0))
    assert low == pytest.approx(model.lower)


def test_joints_without_an_effect_do_not_fit_it(bench):
    model = JointModel.base(bench.problem).with_effect(STRIBECK, torch.tensor([False]))
    assert model.free[0].tolist() == [True] * len(BASE) + [False] * 2


def test_an_effect_spreads_to_more_joints_and_keeps_the_values_of_the_others(bench):
    base = two_of(JointModel.base(bench.problem))
    values = torch.tensor([[1.0, 0.1], [2.0, 0.3]], dtype=torch.float64)
    model, physical = base.extended(base.lower, STRIBECK, torch.tensor([True, False]), values)
    model, physical = model.extended(physical, STRIBECK, torch.tensor([False, True]), values + 1)
    assert model.size == len(BASE) + 2 and model.has.all()
    assert physical[:, model.columns(STRIBECK)].tolist() == [[1.0, 0.1], [3.0, 1.3]]


def two_of(base, **changes):
    """The base model of a joint, twice."""
    many = {name: getattr(base, name).repeat(2, 1) for name in ("lower", "upper", "ranges")}
    each = {name: getattr(base, name).repeat(2) for name in ("slides", "efforts", "loops")}
    return replace(base, has=torch.zeros(0, 2, dtype=torch.bool), **many | each | changes)


def test_a_slide_shares_no_value_with_a_hinge_and_is_not_hidden_by_its_error(bench):
    """A carriage at 1 µm beside a hinge at 1 mrad: it went to 10 µm."""
    model, both = two_of(JointModel.base(bench.problem)), torch.tensor([True, True])
    values = torch.tensor([[1.0, 0.10], [1.2, 0.12]], dtype=torch.float64)
    model, physical = model.extended(bench.truth_values.repeat(2, 1), STRIBECK, both, values)
    same = torch.randn(model.size, 40, 3, 1, generator=torch.Generator().manual_seed(0)).repeat(1, 1, 1, 2)

    def pooled(slides, rmse, after):
        now = Fitted.start(replace(model, slides=torch.tensor(slides)), physical)
        now = replace(now, jacobian=same * torch.tensor(rmse))
        outcome = Outcome(
            problem=None, base=Fitted.start(two_of(JointModel.base(bench.problem)), bench.truth_values.repeat(2, 1)),
            base_errors=errors_of(*rmse), final=now, final_errors=errors_of(*rmse),
        )  # fmt: skip
        final = pool(FakeFits(lambda *_: errors_of(*after)), outcome, torch.tensor(rmse)).final
        return final.model.to_physical(final.x)[:, model.columns(STRIBECK)] if final.model.shared else None

    assert pooled([False, False], [1e-3, 1e-6], [1e-3, 1e-5]) is None
    assert pooled([False, True], [1e-3, 1e-3], [1e-3, 1e-3]) is None
    shared = pooled([False, False], [1e-3, 1e-6], [1e-3, 1e-6])  # both know it as well beside their errors
    assert shared[0].tolist() == shared[1].tolist() == pytest.approx([1.1, 0.1 * 1.2**0.5], rel=0.02)


def test_one_value_is_shared_where_that_explains_as_much(bench):
    model = two_of(JointModel.base(bench.problem))
    both = torch.tensor([True, True])
    found = torch.tensor([[1.0, 0.10], [1.2, 0.12]], dtype=torch.float64)
    plain = Fitted.start(model, bench.truth_values.repeat(2, 1))
    model, physical = model.extended(bench.truth_values.repeat(2, 1), STRIBECK, both, found)
    jacobian = torch.randn(model.size, 40, 3, 2, generator=torch.Generator().manual_seed(0))
    jacobian[..., 0] *= 10  # the first joint knows its values better
    final = replace(Fitted.start(model, physical), jacobian=jacobian)
    weights = torch.ones(1).double()
    errors = BlockErrors(square=torch.tensor([[1e-8, 1e-8]]).double(), weight=weights)
    for cost, floor, shared in ((1.0, 1e-4, True), (1.3, 1e-4, False), (1.0, 1e-5, False)):  # the last: far from it
        after = BlockErrors(square=cost * errors.square, weight=weights)
        outcome = Outcome(
            problem=None,
            base=plain,
            base_errors=errors,
            final=final,
            final_errors=errors,
        )
        outcome = pool(FakeFits(lambda _, after=after: after), outcome, torch.full((2,), floor))
        assert (STRIBECK in outcome.final.model.shared) is shared
        values = outcome.final.model.to_physical(outcome.final.x)[:, model.columns(STRIBECK)]
        if shared:
            assert values[0] == pytest.approx(values[1]) and values[0] == pytest.approx(found[0], rel=0.01)
            assert bool(outcome.final.model.free.all())
        else:
            assert values == pytest.approx(found)


def test_every_structure_that_an_effect_can_have_starts_a_fit():
    elasticity = get_effect("joint_elasticity")
    probes = [
        Probe(effect=effect, values=start_values(effect, point)[None], score=torch.tensor([score]), size=torch.ones(1))
        for effect in (elasticity, STRIBECK)
        for score, point in enumerate(probe_points(effect))
    ]
    sides = [float(p.values[0, 2]) for p in _ranked([p for p in probes if p.effect is elasticity], 0)]
    assert sorted(sides) == [0.0, 1.0]
    own = [p for p in probes if p.effect is STRIBECK]
    assert [float(p.score) for p in _ranked(own, 0)] == [len(own) - 1, len(own) - 2]


def test_where_an_encoder_sits_is_chosen_and_not_walked_to(bench):
    elasticity, yes = get_effect("joint_elasticity"), torch.tensor([True])
    fits = []
    for side in (0.0, 1.0):
        own = start_values(elasticity, {"encoder_side": side})[None]
        model, physical = JointModel.base(bench.problem).extended(bench.truth_values, elasticity, yes, own)
        fits.append(Fitted.start(model.structure_held(elasticity, physical), physical))
    assert fits[0].model.free[0].tolist() == [True] * (len(BASE) + 2) + [False]
    link, motor = fits
    assert [float(f.model.to_physical(f.x)[0, -1]) for f in fits] == [0.0, 1.0]
    assert float(link.with_joints(torch.tensor([False]), motor).physical[0, -1]) == 0.0
    assert float(link.with_joints(yes, motor).physical[0, -1]) == 1.0
    assert model.structure_held(STRIBECK, physical) is model  # it has nothing of the kind


def test_a_joint_parts_motor_and_link_only_once_and_gets_nothing_barred(bench):
    backlash, elasticity = get_effect("backlash"), get_effect("joint_elasticity")
    model = JointModel.base(bench.problem).with_effect(backlash, torch.tensor([True]))
    assert (
        not model.allowed_joints(elasticity) and not model.allowed_joints(backlash) and model.allowed_joints(STRIBECK)
    )
    assert not replace(model, barred={STRIBECK: torch.tensor([True])}).allowed_joints(STRIBECK)
