"""The steps of the search: where it ends, its verdict, what takes another's place, what to record next."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diagnoses import FITS, errors_of, joint_alone, make_search, make_trial, outcome_of, with_effects
from problems import DT

from pace_actuators.effects import get_effect
from pace_optim.diagnosis.candidates.screening import absorbed_effects, probe_values
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.diagnosis.findings.advice import advise, rivals
from pace_optim.diagnosis.search.one_round import _short_list
from pace_optim.diagnosis.search.replace_effect import exchanged, replace_effects
from pace_optim.diagnosis.search.search import add_effects
from pace_optim.diagnosis.search.state import Branch
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.diagnosis.selection.choice import choose
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel, labels
from pace_optim.motion.design import telling_apart
from pace_optim.motion.design.telling_apart import MenuCfg, Rivals, distances, menu, next_experiments

STRIBECK, QUADRATIC, GAIN = (get_effect(n) for n in ("stribeck_friction", "quadratic_friction", "torque_gain"))
CLOCK, ELASTICITY, BACKLASH = (get_effect(n) for n in ("clock_skew", "joint_elasticity", "backlash"))


@pytest.fixture(scope="module")
def bench():
    """A short chirp of one joint."""
    return joint_alone()


def test_a_search_ends_where_no_effect_gains_anything(bench):
    base = with_effects(JointModel.base(bench.problem), bench.truth_values)
    search = make_search(lambda _: errors_of(1e-2), effects=[STRIBECK], try_effects=lambda *_, **__: None)
    outcome = add_effects(search, bench.twins, base)
    assert outcome.rounds == [] and outcome.final is base


@pytest.mark.slow
def test_rivals_are_sent_to_the_recording_where_they_part(bench):
    base = JointModel.base(bench.problem)
    values = bench.truth_values
    models = []
    for effect, own in ((STRIBECK, [0.3, 0.1]), (QUADRATIC, [0.05])):
        model, physical = base.extended(values, effect, torch.tensor([True]), torch.tensor([own], dtype=torch.float64))
        models.append(Fitted.start(model, physical))
    trials = [[make_trial(STRIBECK, 0, 2e-4), make_trial(QUADRATIC, 0, 2e-4)]]
    this = Round(
        trials=trials,
        chosen=[STRIBECK],
        rivals=[[QUADRATIC]],
        models=dict(zip((STRIBECK, QUADRATIC), models, strict=True)),
    )
    outcome = outcome_of([1e-3], [2e-4], [STRIBECK], rounds=[this])
    pairs = rivals(bench.problem.joint_names, outcome)
    (apart,) = distances(bench.problem, pairs, [[c.recording for c in menu(bench.problem, 0, MenuCfg())]])
    (sentence,) = next_experiments(bench.problem, pairs, torch.tensor([1e-4], dtype=torch.float64))
    assert f"{1e3 * float(apart.max()):.2g} mrad" in sentence and "scripts/data_collection.py --task" in sentence
    (sentence,) = next_experiments(bench.problem, pairs, torch.tensor([1.0], dtype=torch.float64))
    assert "Nor would any of" in sentence


def test_a_velocity_drive_is_sent_to_another_velocity_gain(bench):
    """A stiffness of 0 times 1.5 was on the menu, and a stiffness was advised."""
    problem = bench.problem
    like = [
        replace(recording, drive=replace(recording.drive, stiffness=np.zeros(1), damping=np.ones(1)))
        for recording in problem.dataset.recordings
    ]
    problem = replace(problem, dataset=replace(problem.dataset, recordings=like))
    words = {choice.words for choice in menu(problem, 0, MenuCfg())}
    assert any("the derivative gain" in each for each in words)
    assert not any("proportional" in each for each in words)
    for choice in menu(problem, 0, MenuCfg()):
        assert "--velocity_joints '.*'" in choice.arguments and "steps" not in choice.arguments
        assert choice.recording.des_dof_pos is None and np.ptp(choice.recording.command) == 0
        assert np.ptp(choice.recording.command_vel) > 0.1
    data = SimpleNamespace(gains=1, loads=2, noise=torch.tensor([1e-4]))
    outcome = outcome_of([1e-3], [2e-4], [STRIBECK])
    sentence = next(each for each in advise(problem, outcome, "effect", data, ()) if "same gains" in each)
    assert "another velocity gain (damping in the recording)" in sentence


def test_a_torque_drive_is_sent_to_its_own_controller(bench):
    problem = bench.problem
    like = [
        replace(each, des_dof_pos=None, des_dof_effort=each.des_dof_pos, command_effort=each.command)
        for each in problem.dataset.recordings
    ]
    problem = replace(problem, dataset=replace(problem.dataset, recordings=like))
    pair = Rivals(names=("payload", "torque_gain"), models=(None, None), joints=[0], hint="Weigh it.")
    (sentence,) = next_experiments(problem, [pair], torch.tensor([1e-4]))
    assert sentence.endswith("(servo). Record another motion of your controller, and log its commands. Weigh it.")


def test_one_recording_is_advised_where_it_tells_several_pairs_apart(bench, monkeypatch):
    base, values = JointModel.base(bench.problem), bench.truth_values
    effects = {STRIBECK: [0.3, 0.1], QUADRATIC: [0.05], GAIN: [0.1]}
    models = {effect: with_effects(base, values, (effect, [True], own)) for effect, own in effects.items()}
    this = Round(trials=[[]], chosen=[STRIBECK], rivals=[[QUADRATIC, GAIN]], models=models)
    outcome = outcome_of([1e-3], [2e-4], [STRIBECK], rounds=[this])
    apart = {QUADRATIC: {1: 4e-3, 2: 9e-3}, GAIN: {1: 1e-3}}  # the first pair parts further on another recording

    def distances_of(_, pairs, recordings):
        counts = map(len, recordings)
        return [
            torch.tensor([apart[get_effect(p.names[1])].get(k, 0.0) for k in range(n)])
            for p, n in zip(pairs, counts, strict=True)
        ]

    monkeypatch.setattr(telling_apart, "distances", distances_of)
    pairs = rivals(bench.problem.joint_names, outcome)
    noise = torch.tensor([1e-4], dtype=torch.float64)
    (sentence,) = next_experiments(bench.problem, pairs, noise)
    choice = list(menu(bench.problem, 0, MenuCfg()))[1]
    assert "stribeck_friction from quadratic_friction (servo), nor stribeck_friction from torque_gain" in sentence
    assert f"{choice.words} would" in sentence and "1 to 4 mrad, 10 to 40 times the noise" in sentence
    del apart[GAIN][1]
    told, not_told = next_experiments(bench.problem, pairs, noise)
    assert "9 mrad, 90 times" in told and "torque_gain" not in told
    assert "from torque_gain (servo). Nor would any of 8 simulated recordings." in not_told


def test_a_base_parameter_takes_up_a_late_log_and_a_turned_mass(bench):
    start, coarse = Fitted.start(JointModel.base(bench.problem), bench.truth_values), bench.twins.with_physics_dt(DT)
    fitted, effort = FITS.side_by_side(bench.twins, [start], 2, True)[0], torch.tensor([5.0], dtype=torch.float64)
    effects = [get_effect(name) for name in ("stribeck_friction", "measurement_delay", "com_offset")]
    found = absorbed_effects(FITS, coarse, fitted, effects, effort, DEFAULT.candidates)
    assert [effect.name for effect in found] == ["measurement_delay", "com_offset"]
    fitted.jacobian.normal_()  # as rough as a narrow step sees joints that stick
    rough = absorbed_effects(FITS, coarse, fitted, effects, effort, DEFAULT.candidates)
    assert [effect.name for effect in rough] == ["measurement_delay", "com_offset"]


def two_joints(bench):
    one = JointModel.base(bench.problem)
    none = torch.zeros(0, 2, dtype=torch.bool)
    bounds = {side: getattr(one, side).repeat(2, 1) for side in ("lower", "upper", "ranges")}
    drives = {name: getattr(one, name).repeat(2) for name in ("slides", "efforts", "loops")}
    return replace(one, has=none, **drives, **bounds)


@pytest.mark.parametrize("stood_out", [True, False])  # beside neighbours that moved wrongly
@pytest.mark.parametrize(("rmse", "agree"), [(1.05e-4, True), (1.3e-4, False)])
def test_joints_agree_on_the_effect_that_most_want_where_it_does_as_well(bench, rmse, agree, stood_out):
    base, values = two_joints(bench), bench.truth_values.repeat(2, 1)
    now = with_effects(base, values, (GAIN, [True, False], [0.8]), (STRIBECK, [False, True], [1.0, 0.1]))
    models = {
        GAIN: with_effects(base, values, (GAIN, [True, True], [0.79])),
        STRIBECK: with_effects(base, values, (STRIBECK, [True, True], [1.1, 0.1])),
    }
    trials = [
        [make_trial(GAIN, 0, 1e-4), make_trial(STRIBECK, 0, 2e-4)],
        [make_trial(STRIBECK, 1, 1e-4), make_trial(GAIN, 1, 2e-4, stood_out)],
    ]
    this = Round(trials=trials, chosen=[GAIN, STRIBECK], rivals=[[], []], models=models)
    errors = {STRIBECK: errors_of(2e-4, 1e-4), GAIN: errors_of(1e-4, rmse), None: errors_of(1e-4, 1e-4)}
    branch = Branch(problem=bench.twins, now=now, errors=errors[None], rounds=(this,))
    end = replace_effects(make_search(lambda of: errors[of.tried], floor=(1e-4, 1e-4)), branch)
    if not agree:
        assert end is branch
        return
    result, (this,) = end.now, end.rounds
    assert labels(result.model, ["hip", "knee"]) == ["torque_gain"]
    gains = result.model.to_physical(result.x)[:, result.model.columns(GAIN)]
    assert gains[:, 0].tolist() == pytest.approx([0.8, 0.79])
    assert this.chosen == [GAIN, GAIN] and this.rivals == [[], [STRIBECK]]


def test_where_an_encoder_sits_is_held_in_exchanges(bench):
    base, here = JointModel.base(bench.problem), torch.tensor([True])
    with_gain, sides = with_effects(base, bench.truth_values, (GAIN, [True], [0.9])), []
    for side in (0.0, 1.0):
        elasticity = with_effects(base, bench.truth_values, (ELASTICITY, [True], [300.0, 1.0, side]))
        now = exchanged(with_gain, here, GAIN, elasticity, ELASTICITY)
        column = now.model.columns(ELASTICITY).stop - 1
        assert not bool(now.model.free[0, column]) and float(now.physical[0, column]) == side
        sides.append((now, elasticity))
    now = exchanged(sides[0][0], here, ELASTICITY, sides[1][1], ELASTICITY)
    assert float(now.physical[0, column]) == 1.0  # and not where it was held before


def test_beside_a_newer_effect_another_one_may_take_the_older_one_s_place(bench):
    base, values = JointModel.base(bench.problem), bench.truth_values
    now = with_effects(base, values, (STRIBECK, [True], [1.0, 0.1]), (QUADRATIC, [True], [0.2]))
    alone = with_effects(base, 1.1 * values, (GAIN, [True], [0.9]))
    first = Round(
        trials=[[make_trial(STRIBECK, 0, 5e-4), make_trial(GAIN, 0, 6e-4)]],
        chosen=[STRIBECK],
        rivals=[[]],
        models={GAIN: alone},
    )
    second = Round(trials=[[make_trial(QUADRATIC, 0, 3e-4)]], chosen=[QUADRATIC], rivals=[[]])

    def replaced(with_gain, rmse=3e-4, rounds=(first, second), now=now):
        errors = {GAIN: errors_of(with_gain), None: errors_of(rmse)}
        branch = Branch(problem=bench.twins, now=now, errors=errors[None], rounds=tuple(rounds))
        end = replace_effects(make_search(lambda of: errors[of.tried]), branch)
        return None if end is branch else end

    assert replaced(2.8e-4) is None  # as good is not better: the older effect stays
    assert replaced(1e-4, rmse=1.2e-4) is None  # at the floor nothing is left to gain
    end = replaced(1e-4)
    assert labels(end.now.model, ["servo"]) == ["quadratic_friction", "torque_gain"]
    physical = end.now.physical[0]
    assert physical[: len(BASE)].tolist() == pytest.approx((1.1 * values[0]).tolist())
    assert physical[end.now.model.columns(QUADRATIC)].tolist() == pytest.approx([0.2])
    assert physical[end.now.model.columns(GAIN)].tolist() == pytest.approx([0.9])
    (one, two), unchanged = end.rounds, first
    assert one.chosen == [GAIN] and one.rivals == [[]] and two.chosen == [QUADRATIC]
    assert unchanged.chosen == [STRIBECK]
    # what did not stand out, and no joint has, is not tried
    weak = [[first.trials[0][0], replace(first.trials[0][1], significant=False)]]
    assert replaced(1e-4, rounds=(replace(first, trials=weak), second)) is None
    # a lone effect was the best of its round: nothing is tried in its place
    lone = with_effects(base, values, (STRIBECK, [True], [1.0, 0.1]))
    assert replaced(1e-4, rounds=(first,), now=lone) is None


@pytest.mark.parametrize(
    ("elastic", "chosen", "rivals"),
    [(1.09, ELASTICITY, [BACKLASH]), (0.99, ELASTICITY, [BACKLASH]), (1.11, BACKLASH, [])],
)
def test_of_two_effects_that_are_alike_the_one_with_fewer_numbers_is_taken(elastic, chosen, rivals):
    choice = choose([[make_trial(BACKLASH, 0, 1e-4), make_trial(ELASTICITY, 0, elastic * 1e-4)]])
    assert (choice.chosen, choice.rivals) == ([chosen], [rivals])


def test_an_effect_of_a_size_that_no_drive_has_is_no_rival_of_a_plausible_one():
    """A negative gravity compensation stood before a payload."""
    negative, payload = (make_trial(get_effect(n), 0, 1e-4) for n in ("gravity_compensation", "payload"))
    negative = replace(negative, implausible=True, mse_after=0.9 * payload.mse_after)
    assert choose([[negative, payload]]).chosen == [payload.effect] and choose([[negative, payload]]).rivals == [[]]
    assert choose([[negative]]).chosen == [negative.effect]  # a hint, as nothing else comes near


def test_the_worst_joint_is_the_one_furthest_above_its_floor():
    """Beside a hinge at 10 mrad, effects of a carriage at 0.1 mm were not refitted: m² are small beside rad²."""
    cfg = replace(DEFAULT.candidates, of_robot=1, of_joint=1)
    floor, excess = torch.tensor([1e-3, 1e-6]), torch.tensor([1e-4, 1e-8])
    explained = {GAIN: torch.tensor([0.9e-4, 0.0]), STRIBECK: torch.tensor([0.0, 0.9e-8])}
    assert _short_list(explained, excess, floor, cfg) == [STRIBECK]


@pytest.mark.parametrize(("floor", "chosen"), [((1e-3, 0.0), GAIN), ((0.0, 0.0), GAIN), ((1e-3, 1e-3), GAIN)])
def test_a_joint_whose_floor_is_zero_does_not_decide_alone(floor, chosen):
    """A simulated recording without noise has such a floor: a nanoradian of that joint outweighed all others."""
    cfg = replace(DEFAULT.candidates, of_robot=1, of_joint=1)
    explained = {GAIN: torch.tensor([1e-4, 0.0]), STRIBECK: torch.tensor([0.0, 1e-18])}
    assert _short_list(explained, torch.tensor([1e-4, 1e-18]), torch.tensor(floor), cfg) == [chosen]


def test_a_rival_that_is_chosen_makes_the_one_before_its_rival_and_is_none_of_its_own():
    this = Round(trials=[[], [], []], chosen=[GAIN, GAIN, None], rivals=[[STRIBECK, QUADRATIC], [STRIBECK], []])
    other = this.choosing([STRIBECK, QUADRATIC, GAIN])
    assert other.chosen == [STRIBECK, QUADRATIC, GAIN]
    assert other.rivals == [[QUADRATIC, GAIN], [STRIBECK], []]
    assert this.chosen == [GAIN, GAIN, None] and this.rivals == [[STRIBECK, QUADRATIC], [STRIBECK], []]


def test_the_rest_of_a_spring_is_sought_around_the_middle_of_the_motion(bench):
    """Two springs alike: the one at rest at -2.2 rad was not found from rests at -1, 0 and 1 rad."""
    spring, middle = get_effect("parallel_spring"), torch.tensor([-2.2], dtype=torch.float64)
    probes = probe_values(spring, torch.ones(1), JointModel.base(bench.problem), middle)
    stiffness, rest = torch.stack([values[0] for _, values in probes]).double().T
    assert sorted(rest.tolist()) == pytest.approx([-3.2, -2.2, -1.2])
    assert float(stiffness.min()) == float(stiffness.max()) > 0.0
