"""The best effect of a round may stand in for two others: the search looks one round ahead."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from diagnoses import FakeFits, errors_of, make_search, make_trial
from search_worlds import ELASTICITY, GAIN, MOUNT, PAYLOAD, SPRING, STANDS_IN, found, moves, mrad

from pace_optim.diagnosis.search.carried_links import _other_rivals
from pace_optim.diagnosis.search.look_ahead import ends
from pace_optim.diagnosis.search.state import Branch
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.diagnosis.selection.rules import beats
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel

IS_IT = mrad({(MOUNT,): 7.5, (ELASTICITY,): 18.0, (GAIN,): 39.0, (MOUNT, GAIN): 0.1, (ELASTICITY, GAIN): 12.0})


def test_two_effects_are_found_behind_one_that_stands_in_for_both():
    effects, rounds = found(STANDS_IN)
    assert effects == [{"joint_elasticity", "torque_gain"}]
    assert rounds == 3  # the first, and the second along two ways


def test_the_way_taken_is_tried_again_where_the_robot_moves_otherwise_with_it():
    effects, rounds = found(STANDS_IN, follow=moves)
    assert effects == [{"joint_elasticity", "torque_gain"}] and rounds == 4


def test_the_best_effect_stays_where_no_other_leads_further():
    effects, rounds = found(IS_IT)
    assert effects == [{"mount_compliance", "torque_gain"}] and rounds == 2
    worse = {**STANDS_IN, frozenset((ELASTICITY, GAIN)): 6.1}
    assert found(worse)[0] == [{"mount_compliance", "torque_gain"}]


def test_another_way_is_taken_that_leaves_less_with_as_many_numbers():
    better = {**STANDS_IN, frozenset((ELASTICITY, GAIN)): 5.8}
    assert found(better)[0] == [{"joint_elasticity", "torque_gain"}]


def test_a_way_ends_with_the_best_of_what_pays():
    model = SimpleNamespace(names_of_joints=[[MOUNT.name]] * 2)
    branch = Branch(problem=None, now=SimpleNamespace(model=model), errors=errors_of(8e-3, 8e-3))
    trials = [
        make_trial(GAIN, 0, 1e-3, False),
        make_trial(SPRING, 0, 3e-3, True),
        make_trial(ELASTICITY, 0, 5e-3, True),
    ]
    led = ends(branch, Round(trials=[trials, []], chosen=[SPRING, None], rivals=[[], []]))
    assert [end["effects"] for end in led] == [[MOUNT.name, SPRING.name], [MOUNT.name]]
    assert [end["mse"] for end in led] == pytest.approx([9e-6, 64e-6])


@pytest.mark.parametrize(
    ("one", "other", "rmse", "wins"),
    [  # numbers: mount and elasticity 3, spring 2, gain 1
        ([GAIN], [SPRING], 1.09, True),  # alike, with fewer
        ([GAIN], [SPRING], 1.11, False),
        ([MOUNT], [ELASTICITY], 0.99, True),  # lower, with as many
        ([MOUNT], [ELASTICITY], 1.0, False),
        ([SPRING, GAIN], [GAIN], 0.92, False),  # not lower by what more numbers must bring
        ([SPRING, GAIN], [GAIN], 0.90, True),
        ([SPRING, GAIN], [GAIN, SPRING], 0.92, False),  # the same, come upon in another order
    ],
)
def test_one_way_beats_another_by_its_error_or_its_fewer_numbers(one, other, rmse, wins):
    own, others = ({"effects": [e.name for e in es], "mse": r**2} for es, r in ((one, 1e-3 * rmse), (other, 1e-3)))
    assert beats(own, others) is wins


def test_each_joint_takes_its_own_way():
    effects, _ = found(STANDS_IN, IS_IT)
    assert effects == [{"joint_elasticity", "torque_gain"}, {"mount_compliance", "torque_gain"}]


def test_nothing_is_looked_for_where_an_effect_explains_what_is_missing():
    table = mrad({(MOUNT,): 0.25, (ELASTICITY,): 0.3, (ELASTICITY, GAIN): 0.1})
    effects, rounds = found(table)
    assert effects == [{"mount_compliance"}] and rounds == 1  # it is near the floor


def test_beside_a_joint_far_from_the_floor_nothing_is_sought_on_one_near_it():
    far = mrad({(MOUNT,): 20.0, (ELASTICITY,): 0.1, (GAIN,): 39.0, (SPRING,): 20.0})
    near = mrad({(): 0.12, (MOUNT,): 0.12, (ELASTICITY,): 0.12, (GAIN,): 0.09, (SPRING,): 0.12})
    assert found(far, near)[0] == [{"joint_elasticity"}, set()]
    assert found(near)[0] == [{"torque_gain"}]


NEIGHBOUR = mrad({(MOUNT,): 20.0, (ELASTICITY,): 0.1, (GAIN,): 39.0, (SPRING,): 20.0})


def constant(rmse):
    return mrad({(): rmse, **{(effect,): rmse for effect in (MOUNT, ELASTICITY, GAIN, SPRING)}})


def after_the_neighbour(before, after):
    """A joint's table before and after the first joint has an effect."""
    return lambda everyone: after if everyone[0] else before


@pytest.mark.parametrize("rmse", [1.7, 0.25])  # far from the floor, or above it
def test_what_a_neighbour_hid_is_found_once_the_neighbour_is_explained(rmse):
    hidden = after_the_neighbour(constant(rmse), {**constant(rmse), **mrad({(GAIN,): 0.1})})
    assert found(NEIGHBOUR, hidden) == ([{"joint_elasticity"}, {"torque_gain"}], 2)


def test_a_joint_that_nothing_explains_is_tried_no_more_than_twice():
    assert found(NEIGHBOUR, constant(1.7)) == ([{"joint_elasticity"}, set()], 2)


def test_near_the_floor_nothing_is_sought_a_second_time():
    hidden = after_the_neighbour(constant(0.13), {**constant(0.13), **mrad({(GAIN,): 0.1})})
    assert found(NEIGHBOUR, hidden) == ([{"joint_elasticity"}, set()], 1)


CARRIED = constant(1.0) | mrad({(PAYLOAD,): 0.11, (GAIN,): 0.15, (PAYLOAD, GAIN): 0.11})


@pytest.mark.parametrize(
    ("own", "without", "with_it", "effects"),
    [
        (CARRIED, 0.1, 0.1, {"payload"}),
        (CARRIED, 0.1, 2.0, {"torque_gain"}),  # the next best, which the joint above does not feel
        (constant(1.0) | mrad({(PAYLOAD,): 0.11}), 0.1, 2.0, set()),
        (CARRIED, 2.0, 0.1, {"payload"}),
    ],
)
def test_an_effect_on_a_link_is_judged_by_all_joints_that_carry_it(own, without, with_it, effects):
    """A payload of a joint whose neighbours were not explained yet took the joints above it from 0.1 to 10 mrad."""

    def above(everyone):
        return constant(with_it if everyone and PAYLOAD in everyone[1] else without)

    assert found(above, own, trees=[[0, 1]])[0] == [set(), effects]
    assert found(above, own, trees=[[0], [1]])[0] == [set(), {"payload"}]


@pytest.mark.parametrize(("pays", "rivals"), [(True, [PAYLOAD]), (False, [])])
def test_an_effect_on_a_link_that_pays_there_too_stays_a_like_of_one_that_is_not(pays, rivals):
    """A tool at a forearm's tip is not its link's mass scaled: a wrong torque constant seemed to do better."""
    none = {"models": {}}
    own = Round(
        trials=[[make_trial(GAIN, 0, 1e-4), make_trial(PAYLOAD, 0, 1e-4)]], chosen=[GAIN], rivals=[[PAYLOAD]], **none
    )
    over_tree = [make_trial(GAIN, 0, 1e-4), make_trial(PAYLOAD, 0, 2e-4, pays)]
    again = Round(trials=[over_tree], chosen=[GAIN], rivals=[[]], **none)
    assert _other_rivals(own, again, 0) == rivals


@pytest.mark.parametrize(
    ("effect", "score", "fitted"),
    [
        (ELASTICITY, 1.5, ["over wide steps", "to the end"]),
        (ELASTICITY, 1.35, ["to the end"]),  # at the floor
        (GAIN, 9.0, ["to the end"]),
    ],
)
def test_what_is_settled_was_fitted_to_whole_recordings(effect, score, fitted):
    done = []

    class Recorded(FakeFits):
        def over_wide_steps(self, problem, now, kept=None):
            done.append("over wide steps")
            return now

        def to_the_end(self, problem, now):
            done.append("to the end")
            return SimpleNamespace(**vars(now) | {"score": torch.zeros(1)})

    model = SimpleNamespace(effects=(effect,), has=torch.tensor([[True]]))
    now = SimpleNamespace(model=model, score=torch.tensor([score**2]))
    search = replace(make_search(None, floor=(1.0,)), fits=Recorded(lambda of: ("errors of", of)))
    settled, errors = search.settled("problem", now)
    assert done == fitted
    assert errors == ("errors of", settled)


@pytest.mark.parametrize(
    ("after", "taken"), [([2.0, 2.0], [True, True]), ([2.0, 9.0], [True, False]), ([9.0, 9.0], [False, False])]
)
def test_joints_take_over_a_trimmed_fit_where_it_is_better_on_validation_recordings(after, taken):
    """Two joints at an RMSE of 5; fitted without the windows in which they are far worse than elsewhere."""

    def fit(score, value):
        bounds = torch.ones(2, len(BASE) + len(ELASTICITY.parameters)).double()
        model = JointModel(
            effects=(ELASTICITY,),
            has=torch.ones(1, 2, dtype=torch.bool),
            lower=-bounds,
            upper=bounds,
            log=torch.zeros(bounds.shape[1], dtype=torch.bool),
            slides=torch.zeros(2, dtype=torch.bool),
            ranges=torch.zeros(2, 2),
            efforts=torch.full((2,), torch.inf),
            loops=torch.full((2,), 85.0),
        )
        jacobian, error = (torch.full(shape, value) for shape in ((bounds.shape[1], 3, 1, 2), (3, 1, 2)))
        return Fitted(model=model, x=value * bounds, score=score, jacobian=jacobian, error=error)

    now, other = fit(torch.tensor([25.0, 25.0]), 0.0), fit(torch.tensor([24.0, 24.0]), 1.0)
    own, asked = {now: errors_of(5.0, 5.0), other: errors_of(*after)}, []

    class Trimmed(FakeFits):
        def trimmed(self, problem, now, joints):
            asked.append(joints.tolist())
            return "trimmed"

        def to_whole(self, problem, starts):
            return [other] if starts == ["trimmed"] else starts

    search = replace(make_search(None, floor=(1.0, 3.0)), fits=Trimmed(own.get))
    settled, errors = search.settled("problem", now)
    assert asked == [[True, True]]
    expected = [two if yes else 5.0 for two, yes in zip(after, taken, strict=True)]
    assert errors.mse.sqrt().tolist() == pytest.approx(expected, rel=0.02)
    for values in (settled.x[:, 0], settled.jacobian[0, 0, 0], settled.error[0, 0]):
        assert values.bool().tolist() == taken
    assert settled.score.tolist() == [24.0 if yes else 25.0 for yes in taken]
