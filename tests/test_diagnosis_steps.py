"""What a diagnosis is made of: models of joints alone, their fits, and the steps of the search."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diagnoses import hidden_run, make_trial, outcome_of
from problems import CALM, DT, chirp, env_cfg, make_problem, physical, record

from pace_actuators.effects import get_effect, probe_points
from pace_envs import set_physics_dt
from pace_optim.diagnosis import next_experiment, one_round, pruning, search, sharing, swapping
from pace_optim.diagnosis.acceptance import BlockErrors
from pace_optim.diagnosis.base_fit import fit_base
from pace_optim.diagnosis.data_check import check_data
from pace_optim.diagnosis.descent import Fitted, fit_coarse_to_fine, fit_side_by_side
from pace_optim.diagnosis.error_map import error_map
from pace_optim.diagnosis.far_starts import far_starts
from pace_optim.diagnosis.model import BASE, JointModel, start_values, whole_values
from pace_optim.diagnosis.next_experiment import distances, menu, next_experiments, rivals_of
from pace_optim.diagnosis.one_round import _ranked
from pace_optim.diagnosis.own_motion import OwnMotion
from pace_optim.diagnosis.screening import Probe, absorbed_effects
from pace_optim.diagnosis.search import Outcome
from pace_optim.diagnosis.side_by_side import SideBySide, Slot
from pace_optim.diagnosis.stand_ins import stand_ins
from pace_optim.diagnosis.trials import Round
from pace_optim.diagnosis.verdict import explained_joints, labels, verdict
from pace_optim.joint_twins import reference_path, twin_problem

STRIBECK, QUADRATIC, GAIN = (get_effect(n) for n in ("stribeck_friction", "quadratic_friction", "torque_gain"))


@pytest.fixture(scope="module")
def bench():
    """A short chirp without noise, its problem with a twin of each joint, and the truth."""
    fine = env_cfg()  # what the robot does, not what a coarse step makes of it
    set_physics_dt(fine, DT / 10)
    recordings = [record(target, CALM, cfg=fine) for target in (chirp(5.0), chirp(4.0, 0.2, 3.0))]
    problem = make_problem(recordings[:1], validation=recordings[1:]).with_physics_dt(DT / 2)
    truth = physical(problem, CALM)
    return SimpleNamespace(
        problem=problem,
        truth=truth,
        truth_values=torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64),
        twins=twin_problem(problem, reference_path(problem, truth, ["com_offset"])),
    )


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
    one = JointModel.base(bench.problem)
    none = torch.zeros(0, 2, dtype=torch.bool)
    base = replace(one, has=none, lower=one.lower.repeat(2, 1), upper=one.upper.repeat(2, 1))
    values = torch.tensor([[1.0, 0.1], [2.0, 0.3]], dtype=torch.float64)
    model, physical = base.extended(base.lower, STRIBECK, torch.tensor([True, False]), values)
    model, physical = model.extended(physical, STRIBECK, torch.tensor([False, True]), values + 1)
    assert model.size == len(BASE) + 2 and model.has.all()
    assert physical[:, model.columns(STRIBECK)].tolist() == [[1.0, 0.1], [3.0, 1.3]]


def test_one_value_is_shared_where_that_explains_as_much(bench, monkeypatch):
    base = JointModel.base(bench.problem)
    none = torch.zeros(0, 2, dtype=torch.bool)
    model = replace(base, has=none, lower=base.lower.repeat(2, 1), upper=base.upper.repeat(2, 1))
    both = torch.tensor([True, True])
    found = torch.tensor([[1.0, 0.10], [1.2, 0.12]], dtype=torch.float64)
    model, physical = model.extended(bench.truth_values.repeat(2, 1), STRIBECK, both, found)
    final = Fitted.start(model, physical)
    final.jacobian = torch.randn(model.size, 40, 3, 2, generator=torch.Generator().manual_seed(0))
    final.jacobian[..., 0] *= 10  # the first joint knows its values better
    weights = torch.ones(1).double()
    errors = BlockErrors(square=torch.tensor([[1e-8, 1e-8]]).double(), weight=weights)
    for cost, shared in ((1.0, True), (1.2, False)):
        after = BlockErrors(square=cost * errors.square, weight=weights)
        monkeypatch.setattr(sharing, "fit_side_by_side", lambda _, starts, *args, **kwargs: starts)
        monkeypatch.setattr(sharing, "validation_errors", lambda *_, after=after: [after])
        outcome = Outcome(
            problem=None,
            base=final,
            base_errors=errors,
            final=final,
            final_errors=errors,
            unevenness=torch.zeros(final.model.has.shape),
        )
        sharing.share(outcome)
        assert (STRIBECK in outcome.final.model.shared) is shared
        values = outcome.final.model.to_physical(outcome.final.x)[:, model.columns(STRIBECK)]
        if shared:
            assert values[0] == pytest.approx(values[1]) and values[0] == pytest.approx(found[0], rel=0.01)
            assert bool(outcome.final.model.free.all())
        else:
            assert values == pytest.approx(found)


def test_an_older_effect_goes_where_the_newer_one_does_without_it(bench, monkeypatch):
    base = JointModel.base(bench.problem)
    values, yes = bench.truth_values, torch.tensor([True])
    for effect, own in ((STRIBECK, [1.0, 0.1]), (QUADRATIC, [0.1])):
        base, values = base.extended(values, effect, yes, torch.tensor([own], dtype=torch.float64))
    now, weights = Fitted.start(base, values), torch.ones(1).double()
    before = BlockErrors(square=torch.tensor([[1e-8]]).double(), weight=weights)
    for cost, kept in ((1.05, [False, True]), (1.3, [True, True])):
        after = BlockErrors(square=cost * before.square, weight=weights)
        for name in ("fit_coarse_to_fine", "fit_side_by_side"):
            monkeypatch.setattr(pruning, name, lambda _, starts, **kwargs: starts)
        monkeypatch.setattr(pruning, "validation_errors", lambda *_, after=after: [after])
        left, _ = pruning.pruned(bench.twins, now, before, [QUADRATIC])
        assert left.model.has[:, 0].tolist() == kept
        assert labels(left.model, ["servo"]) == [e.name for e, k in zip((STRIBECK, QUADRATIC), kept, strict=True) if k]
        assert ("stribeck_friction.effort" in whole_values(left.model, left.x, ["servo"])) is kept[0]


def test_the_effects_of_joints_that_they_do_not_explain_are_not_kept():
    outcome = outcome_of([1.0, 1.0, 1.0], [0.1, 0.9, 1.0], [STRIBECK], [[True, True, False]])
    floor = torch.full((3,), 0.05, dtype=torch.float64)
    assert verdict(outcome, floor)[0] == "effect"
    assert explained_joints(outcome, floor).tolist() == [True, False, False]
    assert verdict(outcome_of([0.1, 1.0], [0.06, 1.0], [STRIBECK], [[True, False]]), floor[:2])[0] == "unknown"


@pytest.mark.parametrize(
    ("effect", "own", "stuck"),
    [
        ("payload", [-0.6], True),
        ("payload", [0.5], False),
        ("stribeck_friction", [1.0, 0.01], False),  # the speed is no size
        ("stribeck_friction", [4.0, 0.1], True),
        ("stribeck_friction", [0.0, 0.1], False),  # nothing, and not at an end
        ("torque_limit", [get_effect("torque_limit").parameters[0].upper], False),  # next to no limit
        ("torque_limit", [get_effect("torque_limit").parameters[0].lower], True),
    ],
)
def test_an_effect_that_has_run_into_a_bound_is_not_what_is_missing(bench, effect, own, stuck):
    effect = get_effect(effect)
    now = with_effects(JointModel.base(bench.problem), bench.truth_values, (effect, [True], own))
    assert now.model.at_bounds(now.x).tolist() == [[stuck]]
    floor = torch.tensor([1e-4])
    even = torch.zeros(1, 1)
    far = Outcome(
        problem=None,
        base=now,
        base_errors=errors_of(1e-2),
        final=now,
        final_errors=errors_of(2e-3),
        unevenness=even,
    )
    assert verdict(far, floor)[0] == ("unknown" if stuck else "effect")
    stuck_one = f"At a bound, so that it stands in for something else: {effect.name} (servo)."
    assert stand_ins(far, ["servo"], floor) == ([stuck_one] if stuck else [])
    assert verdict(replace(far, final_errors=errors_of(2e-4)), floor)[0] == "effect"  # it explains everything
    two = with_effects(now.model, now.model.to_physical(now.x), (GAIN, [True], [-0.2]))
    two = replace(far, final=two, unevenness=even.repeat(2, 1))
    assert verdict(two, floor)[0] == "effect"  # beside another that is inside its bounds


def test_far_from_the_truth_a_refit_also_starts_at_the_best_of_many_points(bench):
    heavy = bench.truth_values.clone()
    model = JointModel.base(bench.problem)
    heavy[:, BASE.index("armature")] = model.upper[:, BASE.index("armature")]
    coarse, now = bench.twins.with_physics_dt(DT), Fitted.start(model, heavy)
    starts = far_starts(coarse, now, [STRIBECK, get_effect("joint_elasticity")])
    assert [start.tried.name for start in starts] == ["stribeck_friction", "joint_elasticity"]
    slots = [Slot(model=model, rows=1), *(Slot(model=start.model, rows=1) for start in starts)]
    batch = SideBySide(coarse, slots, training=True)
    rows = [heavy[None], *(start.model.to_physical(start.x)[None] for start in starts)]
    errors = batch.simulate(rows, batch.dataset.train).square().mean(dim=(1, 2, 3)).sqrt()
    assert float(errors[1]) < 0.7 * float(errors[0]) and float(errors[2]) < 0.7 * float(errors[0])


@pytest.mark.parametrize(("name", "value"), [("payload", 0.3), ("stribeck_friction", 1.0)])
def test_joints_along_the_motion_of_a_robot_with_an_effect_move_as_it_does(bench, name, value):
    effect = get_effect(name)
    own = start_values(effect, {effect.parameters[0].name: value})[None]
    model, physical = JointModel.base(bench.problem).extended(bench.truth_values, effect, torch.tensor([True]), own)
    whole = bench.problem.with_effects([name])
    names = bench.problem.joint_names
    values = whole.space.from_dict(whole_values(model, model.to_normalised(physical), names))
    path = reference_path(whole, values, [name] if effect.overrides("write_model") else [])
    batch = SideBySide(twin_problem(bench.problem, path), [Slot(model=model, rows=1)], training=False)
    moved = batch.simulate([physical[None]], torch.ones_like(batch.dataset.train))[0]
    expected = path.position - CALM["encoder_bias"] - batch.dataset.measured
    assert float((moved - expected).abs().max()) < 5e-4
    assert float((path.position - bench.twins.path.position).abs().max()) > 3e-3  # the effect is seen


def test_a_model_is_fitted_along_the_motion_that_it_gives_the_robot(bench):
    heavy = bench.truth.clone()
    heavy[bench.problem.space["armature"]] *= 3
    elsewhere = twin_problem(bench.problem, reference_path(bench.problem, heavy))
    now = Fitted.start(JointModel.base(bench.problem), bench.truth_values)
    follow = OwnMotion(problem=bench.problem, candidates=[]).follow
    along, fitted = follow(elsewhere, now)
    assert float((along.path.position - bench.twins.path.position).abs().max()) < 1e-9
    assert float(fitted.score.sqrt()) < 1e-4 and fitted.jacobian is not None
    again, same = follow(along, fitted)
    assert again is along and same is fitted  # it has not moved


def test_a_search_ends_where_no_effect_gains_anything(bench, monkeypatch):
    model = JointModel.base(bench.problem)
    base = fit_side_by_side(bench.twins, [Fitted.start(model, bench.truth_values)], 2, keep_jacobian=True)[0]
    same = torch.ones(1, dtype=torch.float64)
    begun = {None: SimpleNamespace(score=same), STRIBECK: SimpleNamespace(score=2 * same)}
    monkeypatch.setattr(one_round, "_begun", lambda *_: begun)
    monkeypatch.setattr(one_round, "_promising", lambda *_: {STRIBECK: 0 * same})
    outcome = search.add_effects(bench.twins, base, [STRIBECK], 5 * same, 1e-9 * same, 2)
    assert outcome.rounds == [] and outcome.final is base


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
    link.take(motor, torch.tensor([False]))
    assert float(link.model.to_physical(link.x)[0, -1]) == 0.0
    link.take(motor, yes)
    assert float(link.model.to_physical(link.x)[0, -1]) == 1.0
    assert model.structure_held(STRIBECK, physical) is model  # it has nothing of the kind


def test_a_joint_parts_motor_and_link_only_once_and_gets_nothing_barred(bench):
    backlash, elasticity = get_effect("backlash"), get_effect("joint_elasticity")
    model = JointModel.base(bench.problem).with_effect(backlash, torch.tensor([True]))
    assert not model.may_get(elasticity) and not model.may_get(backlash) and model.may_get(STRIBECK)
    assert not replace(model, barred={STRIBECK: torch.tensor([True])}).may_get(STRIBECK)


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
    apart = distances(bench.problem, rivals_of(outcome)[0], [c.recording for c in menu(bench.problem, 0)])
    (sentence,) = next_experiments(bench.problem, outcome, torch.tensor([1e-4], dtype=torch.float64))
    assert f"{1e3 * float(apart.max()):.2g} mrad" in sentence and "scripts/data_collection.py --task" in sentence
    (sentence,) = next_experiments(bench.problem, outcome, torch.tensor([1.0], dtype=torch.float64))
    assert "Nor would any of" in sentence


def test_one_recording_is_advised_where_it_tells_several_pairs_apart(bench, monkeypatch):
    base, values = JointModel.base(bench.problem), bench.truth_values
    effects = {STRIBECK: [0.3, 0.1], QUADRATIC: [0.05], GAIN: [0.1]}
    models = {effect: with_effects(base, values, (effect, [True], own)) for effect, own in effects.items()}
    this = Round(trials=[[]], chosen=[STRIBECK], rivals=[[QUADRATIC, GAIN]], models=models)
    outcome = outcome_of([1e-3], [2e-4], [STRIBECK], rounds=[this])
    apart = {QUADRATIC: {1: 4e-3, 2: 9e-3}, GAIN: {1: 1e-3}}  # the first pair parts further on another recording

    def distances_of(_, pair, recordings):
        return torch.tensor([apart[pair.rival].get(k, 0.0) for k in range(len(recordings))])

    monkeypatch.setattr(next_experiment, "distances", distances_of)
    noise = torch.tensor([1e-4], dtype=torch.float64)
    (sentence,) = next_experiments(bench.problem, outcome, noise)
    choice = list(menu(bench.problem, 0))[1]
    assert "stribeck_friction from quadratic_friction (servo), nor stribeck_friction from torque_gain" in sentence
    assert f"{choice.words} would" in sentence and "1 to 4 mrad, 10 to 40 times the noise" in sentence
    del apart[GAIN][1]
    told, not_told = next_experiments(bench.problem, outcome, noise)
    assert "9 mrad, 90 times" in told and "torque_gain" not in told
    assert "from torque_gain (servo). Nor would any of 8 others tried." in not_told


def test_a_base_parameter_takes_up_a_late_log_and_a_turned_mass(bench):
    fitted = fit_side_by_side(bench.twins, [Fitted.start(JointModel.base(bench.problem), bench.truth_values)], 2, True)[
        0
    ]
    effects = [get_effect(name) for name in ("stribeck_friction", "measurement_delay", "com_offset")]
    found = absorbed_effects(bench.twins.with_physics_dt(DT), fitted, effects, torch.tensor([5.0], dtype=torch.float64))
    assert [effect.name for effect in found] == ["measurement_delay", "com_offset"]
    fitted.jacobian.normal_()  # as rough as a narrow step sees joints that stick
    rough = absorbed_effects(bench.twins.with_physics_dt(DT), fitted, effects, torch.tensor([5.0], dtype=torch.float64))
    assert [effect.name for effect in rough] == ["measurement_delay", "com_offset"]


def test_an_effect_in_one_slot_changes_no_other(bench):
    base = JointModel.base(bench.problem)
    with_effects = [base.with_effect(e, torch.tensor([True])) for e in (STRIBECK, QUADRATIC)]
    values = torch.tensor([[*(CALM[name] for name in BASE)]], dtype=torch.float64)
    slots = [
        Slot(model=base, rows=1),
        Slot(model=with_effects[0], rows=2),
        Slot(model=with_effects[1], rows=1),
    ]
    batch = SideBySide(bench.twins, slots, training=True)

    def simulate(strength):
        stribeck = torch.tensor([[[0.0, 0.1]], [[strength, 0.1]]], dtype=torch.float64)
        physical = [
            values[None],
            torch.cat([values.repeat(2, 1, 1), stribeck], dim=-1),
            torch.cat([values[None], torch.zeros(1, 1, 1, dtype=torch.float64)], dim=-1),
        ]
        return batch.simulate(physical, batch.dataset.train)

    off, on = simulate(0.0), simulate(1.0)
    for row in (1, 3):  # null values are the base model, bit for bit
        assert torch.equal(off[0], off[row])
    assert torch.equal(on[[0, 1, 3]], off[[0, 1, 3]])
    assert float((on[2] - off[2]).abs().max()) > 1e-3
    assert float(off[0].square().mean().sqrt()) < 5e-5  # the twins move as the robot


def test_the_descent_finds_the_base_parameters(bench):
    _, fitted, effort = fit_base(bench.problem, bench.problem.space.to_physical(bench.problem.space.start))
    values = dict(zip(BASE, fitted.model.to_physical(fitted.x)[0].tolist(), strict=True))
    for name in ("armature", "viscous_friction", "friction", "delay"):
        assert values[name] == pytest.approx(CALM[name], rel=0.01), name
    assert values["encoder_bias"] == pytest.approx(CALM["encoder_bias"], abs=5e-4)
    assert float(fitted.score.sqrt()) < 1e-4
    assert fitted.jacobian is not None and fitted.error is not None and float(effort) > 0.1


def test_what_only_another_physics_step_leaves_counts_as_noise(bench):
    model, values = JointModel.base(bench.problem), bench.truth_values.clone()
    values[0, BASE.index("armature")] *= 1.2  # of such a size is what a coarse step does
    base = Fitted.start(model, values)
    left = search.validation_errors(bench.twins, [base])[0].mse.sqrt()
    run = SimpleNamespace(effects=[], rmse={"validation": {"servo": 1e-7}}, physics_dt=DT)
    for it, floor in (
        (run, left),
        (SimpleNamespace(**{**vars(run), "rmse": {"validation": {"servo": float(left)}}}), None),
        (SimpleNamespace(**{**vars(run), "effects": ["torque_gain"]}), None),
        (SimpleNamespace(**{**vars(run), "physics_dt": bench.problem.physics_dt}), None),
        (None, None),
    ):
        check = check_data(bench.problem, bench.twins, base, it)
        said = [sentence for sentence in check.sentences if "comes from the step" in sentence]
        if floor is None:
            assert float(check.floor) < 0.5 * float(left) and not said
        else:
            assert check.floor == pytest.approx(floor) and "2.5 ms" in said[0] and "on servo" in said[0]


def test_a_fit_that_starts_at_the_truth_stays_there(bench):
    model = JointModel.base(bench.problem)
    x = model.to_normalised(torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64))
    fitted = fit_side_by_side(
        bench.twins,
        [Fitted.start(model, model.to_physical(x))],
        max_iteration=2,
    )[0]
    assert float((fitted.x - x).abs().max()) < 0.02


def test_models_far_behind_are_left_at_the_coarse_step(bench):
    model = JointModel.base(bench.problem)
    heavy = bench.truth_values.clone()
    heavy[:, BASE.index("armature")] *= 4
    held = replace(model, lower=heavy, upper=heavy)
    far, near = fit_coarse_to_fine(bench.twins, [Fitted.start(held, heavy), Fitted.start(model, bench.truth_values)])
    assert far.jacobian is None and near.jacobian is not None
    assert float(far.score.sqrt()) > 3 * float(near.score.sqrt())


def test_an_error_map_names_the_variable_that_friction_depends_on(tmp_path):
    run = hidden_run(tmp_path, "friction_map", seed=1, duration=5.0)
    problem = run.problem
    twins, base, _ = fit_base(problem, problem.space.to_physical(problem.space.start))
    found = error_map(twins, base, torch.zeros(1))
    joint = found["joints"]["servo"]
    assert joint["best"] == "q·sgn v" and joint["r2"]["q·sgn v"] > 0.15
    assert "position, times the sign of speed" in found["sentence"]
    # friction resists: the torque that is missing has the other sign than speed
    assert np.mean(joint["curve"]["torque"]) == pytest.approx(0.0, abs=2.0)
    assert len(joint["curve"]["at"]) == len(joint["curve"]["torque"]) > 10
    assert error_map(twins, base, torch.ones(1)) == {}


@pytest.fixture
def no_fits(monkeypatch):
    """Models stay where they start; returns how to say which errors they have, by the effect that is tried."""
    for name in ("fit_coarse_to_fine", "fit_side_by_side"):
        monkeypatch.setattr(swapping, name, lambda _, starts, *args, **kwargs: starts)

    def say(errors_of):
        monkeypatch.setattr(swapping, "validation_errors", lambda _, models: [errors_of[m.tried] for m in models])

    return say


def errors_of(*rmse):
    return BlockErrors(square=torch.tensor([rmse]).double() ** 2, weight=torch.ones(1).double())


def with_effects(model, values, *effects):
    """A model of joints with effects: (effect, joints, values)."""
    for effect, joints, own in effects:
        own = torch.tensor([own] * model.num_joints, dtype=torch.float64)
        model, values = model.extended(values, effect, torch.tensor(joints), own)
    return Fitted.start(model, values)


def two_joints(bench):
    one = JointModel.base(bench.problem)
    none = torch.zeros(0, 2, dtype=torch.bool)
    return replace(one, has=none, lower=one.lower.repeat(2, 1), upper=one.upper.repeat(2, 1))


@pytest.mark.parametrize(("rmse", "agree"), [(1.05e-4, True), (1.3e-4, False)])
def test_joints_agree_on_the_effect_that_most_want_where_it_does_as_well(bench, no_fits, rmse, agree):
    base, values = two_joints(bench), bench.truth_values.repeat(2, 1)
    now = with_effects(base, values, (GAIN, [True, False], [-0.2]), (STRIBECK, [False, True], [1.0, 0.1]))
    models = {
        GAIN: with_effects(base, values, (GAIN, [True, True], [-0.21])),
        STRIBECK: with_effects(base, values, (STRIBECK, [True, True], [1.1, 0.1])),
    }
    trials = [
        [make_trial(GAIN, 0, 1e-4), make_trial(STRIBECK, 0, 2e-4)],
        [make_trial(STRIBECK, 1, 1e-4), make_trial(GAIN, 1, 2e-4)],
    ]
    this = Round(trials=trials, chosen=[GAIN, STRIBECK], rivals=[[], []], models=models)
    no_fits({STRIBECK: errors_of(2e-4, 1e-4), GAIN: errors_of(1e-4, rmse)})
    result = swapping.swapped(bench.twins, now, errors_of(1e-4, 1e-4), [this], torch.full((2,), 1e-4))
    if not agree:
        assert result is None and this.chosen == [GAIN, STRIBECK]
        return
    assert labels(result.model, ["hip", "knee"]) == ["torque_gain"]
    gains = result.model.to_physical(result.x)[:, result.model.columns(GAIN)]
    assert gains[:, 0].tolist() == pytest.approx([-0.2, -0.21])
    assert this.chosen == [GAIN, GAIN] and this.rivals == [[], [STRIBECK]]


def test_beside_a_newer_effect_another_one_may_take_the_older_one_s_place(bench, no_fits):
    base, values = JointModel.base(bench.problem), bench.truth_values
    now = with_effects(base, values, (STRIBECK, [True], [1.0, 0.1]), (QUADRATIC, [True], [0.2]))
    alone = with_effects(base, 1.1 * values, (GAIN, [True], [-0.1]))
    first = Round(
        trials=[[make_trial(STRIBECK, 0, 5e-4), make_trial(GAIN, 0, 6e-4)]],
        chosen=[STRIBECK],
        rivals=[[]],
        models={GAIN: alone},
    )
    second = Round(trials=[[make_trial(QUADRATIC, 0, 3e-4)]], chosen=[QUADRATIC], rivals=[[]])
    floor = torch.tensor([1e-4])
    no_fits({GAIN: errors_of(2.8e-4)})  # as good is not better: the older effect stays
    assert swapping.swapped(bench.twins, now, errors_of(3e-4), [first, second], floor) is None
    no_fits({GAIN: errors_of(1e-4)})
    # at the floor nothing is left to gain
    assert swapping.swapped(bench.twins, now, errors_of(1.2e-4), [first, second], floor) is None
    result = swapping.swapped(bench.twins, now, errors_of(3e-4), [first, second], floor)
    assert labels(result.model, ["servo"]) == ["quadratic_friction", "torque_gain"]
    physical = result.model.to_physical(result.x)[0]
    assert physical[: len(BASE)].tolist() == pytest.approx((1.1 * values[0]).tolist())
    assert physical[result.model.columns(QUADRATIC)].tolist() == pytest.approx([0.2])
    assert physical[result.model.columns(GAIN)].tolist() == pytest.approx([-0.1])
    assert first.chosen == [GAIN] and first.rivals == [[]] and second.chosen == [QUADRATIC]
    # a lone effect was the best of its round: nothing is tried in its place
    lone = with_effects(base, values, (STRIBECK, [True], [1.0, 0.1]))
    first.chosen = [STRIBECK]
    assert swapping.swapped(bench.twins, lone, errors_of(3e-4), [first], floor) is None
