"""A bound never decides between two effects: it is widened, and exact likes are always tried with each other."""

import pytest
import torch
from diagnoses import FITS, joint_alone

from pace_actuators.effects import EffectCfg, EffectParameter, available_effects, get_effect
from pace_envs import load_env_cfg
from pace_envs.tasks.pace.parameters import effect_parameters
from pace_optim.diagnosis.search.one_round import beyond_bounds, with_likes
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import JointModel, labels

OFFSET, PAYLOAD, GAIN = (get_effect(name) for name in ("torque_offset", "payload", "torque_gain"))
ALL = [get_effect(name) for name in available_effects()]


@pytest.mark.parametrize("name", ["torque_gain", "payload", "torque_offset", "friction_asymmetry", "measurement_delay"])
def test_what_acts_alike_by_construction_is_refitted_together(name):
    effect = get_effect(name)
    listed = with_likes([effect], ALL)
    assert listed[0] is effect and len(listed) == 2
    assert set(with_likes([listed[1]], ALL)) == set(listed)
    assert with_likes([effect], [effect]) == [effect]  # a like that the user does not want tried is not


@pytest.mark.parametrize(
    ("bounds", "changes", "widest"),
    [
        ((-1.5, 1.5), {}, (-6.0, 6.0)),
        ((0.0, 0.03), {}, (0.0, 0.12)),  # the null stays a bound
        ((-0.6, 1.0), {"possible": (-0.9, 9.0)}, (-0.9, 4.0)),
        ((0.1, 10.0), {"scale": "log", "null": 1.0, "start": 1.0}, (0.025, 40.0)),
        ((1.0, 600.0), {"scale": "log", "null": None, "start": 30.0}, (1.0, 600.0)),  # shapes the effect
    ],
)
def test_bounds_are_widened_as_far_as_physics_allows(bounds, changes, widest):
    options = {"name": "a", "unit": "1", "null": 0.0, "start": 0.0} | changes
    assert EffectParameter(lower=bounds[0], upper=bounds[1], **options).widest() == pytest.approx(widest)


def test_a_strong_drive_s_torques_are_sought_as_far_as_its_friction_says():
    effort, velocity = get_effect("stribeck_friction").parameters
    assert effort.widest(1.0) == (0.0, 16.0) and effort.widest(30.0) == (0.0, 120.0)
    assert velocity.widest(30.0) == velocity.widest()
    stiffness, _ = get_effect("parallel_spring").parameters  # 80.6 N m/rad on a drive of 440 N m stood at 80
    assert stiffness.widest(1.0) == (-8.0, 80.0) and stiffness.widest(44.0) == (-176.0, 176.0)
    cfg = load_env_cfg("Pace-AnymalD-v0").sim2real
    cfg.bounds["friction"][3, 1] = 30.0
    cfg.effects = ["stribeck_friction@wide"]
    (strong, _) = effect_parameters(cfg)
    assert strong.upper[3] == 120.0 and max(strong.upper[:3]) == 16.0


def test_no_factor_of_what_was_stated_can_be_negative():
    for effect in ALL:
        if effect.scales:
            (parameter,) = effect.parameters
            assert parameter.widest()[0] >= parameter.null - 1.0


def test_a_stated_load_may_not_be_there_at_all():
    assert PAYLOAD.parameters[0].widest()[0] == -1.0


def test_wide_bounds_travel_with_the_effect_s_name():
    cfg = EffectCfg.parse("payload@.*KFE@shared@wide")
    assert cfg.wide and cfg.shared and cfg.joint_names_expr == ".*KFE" and cfg.label == "payload@.*KFE@shared@wide"
    assert EffectCfg.parse("payload@wide").label == "payload@wide" and not EffectCfg.parse("payload").wide


@pytest.mark.slow
def test_a_fit_that_a_bound_holds_back_goes_on_beyond_it():
    robot = joint_alone()
    here = torch.tensor([True])
    model, values = JointModel.base(robot.problem).extended(
        robot.truth_values, OFFSET, here, torch.tensor([[4.0]], dtype=torch.float64)
    )
    calls = []

    def refit(starts):
        calls.append(starts)
        return FITS.coarse_to_fine(robot.twins, starts)

    start = Fitted.start(model, values, tried=OFFSET)
    (fitted,) = beyond_bounds([start], refit, lambda _: None)
    assert calls[0][0].model.upper[0, -1] == 16.0 and not fitted.model.at_bounds(fitted.x).any()
    assert fitted.model.to_physical(fitted.x)[0, -1] == pytest.approx(0.0, abs=0.02)
    assert labels(fitted.model, ["servo"]) == ["torque_offset@wide"]
    inside = Fitted.start(model, values * 0 + values.clamp(max=1.0), tried=OFFSET)
    assert beyond_bounds([inside], refit, lambda _: None) == [inside] and len(calls) == 1


def test_a_value_beyond_the_declared_bounds_keeps_the_bounds_that_it_was_found_in():
    robot = joint_alone()
    model, values = JointModel.base(robot.problem).extended(
        robot.truth_values, PAYLOAD, torch.tensor([True]), torch.tensor([[2.5]], dtype=torch.float64)
    )
    assert model.upper[0, -1] == 4.0 and model.lower[0, -1] == -0.6
    assert model.to_physical(model.to_normalised(values))[0, -1] == pytest.approx(2.5)
