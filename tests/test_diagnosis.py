"""A diagnosis: its arithmetic on what is known, and whether it names a hidden effect."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from problems import BENCH, CALM, DT, chirp, env_cfg, make_problem, physical, record
from run_folders import make_result

from pace_actuators.effects import get_effect, probe_points
from pace_envs import set_physics_dt
from pace_optim.atomic import write_json
from pace_optim.diagnosis import candidate_effects, pruning, search, sharing
from pace_optim.diagnosis.acceptance import BlockErrors, block_errors, judge
from pace_optim.diagnosis.base_fit import fit_base
from pace_optim.diagnosis.descent import Fitted, fit_side_by_side
from pace_optim.diagnosis.error_map import error_map
from pace_optim.diagnosis.far_starts import far_starts
from pace_optim.diagnosis.model import BASE, JointModel, start_values, whole_values
from pace_optim.diagnosis.next_experiment import distances, menu, next_experiments, rivals_of
from pace_optim.diagnosis.own_motion import OwnMotion
from pace_optim.diagnosis.screening import _FOLDS, Probe, _explained, absorbed_effects
from pace_optim.diagnosis.search import Outcome, _ranked
from pace_optim.diagnosis.side_by_side import SideBySide, Slot
from pace_optim.diagnosis.trials import Round, Trial
from pace_optim.diagnosis.verdict import explained_joints, labels, ranking, verdict
from pace_optim.joint_twins import reference_path, twin_problem
from pace_optim.plant import PlantCfg, draw_visible, make_suite, plant_robot
from pace_optim.problem import load_problem
from pace_optim.recording import save_recording

ROOT = Path(__file__).parents[1]
STRIBECK, QUADRATIC, GAIN = (get_effect(n) for n in ("stribeck_friction", "quadratic_friction", "torque_gain"))


# ------------------------------------------------------------------ screening


def columns(probes=2, samples=2000, seed=0):
    """Error, Jacobian, changes and folds of one joint and one recording."""
    generator = torch.Generator().manual_seed(seed)
    jacobian = torch.randn(3, samples, 1, 1, generator=generator)
    changes = torch.randn(probes, samples, 1, 1, generator=generator)
    noise = torch.randn(samples, 1, 1, generator=generator)
    fold = (torch.arange(samples) // 100 % _FOLDS)[:, None]
    return jacobian, changes, noise, fold


def test_what_a_probe_causes_it_explains_and_its_size_is_found():
    jacobian, changes, noise, fold = columns()
    # errors are simulated less measured: the measured motion has three times the probe's change
    error = 5 * jacobian[0] - 3 * changes[1] + 0.01 * noise
    scores, sizes = _explained(error, jacobian, changes, fold)
    assert scores[1, 0] > 0.999 and abs(float(scores[0, 0])) < 0.02
    assert float(sizes[1, 0]) == pytest.approx(3.0, rel=1e-2)


def test_what_the_parameters_explain_is_no_effect_s():
    jacobian, changes, noise, fold = columns()
    changes[0] = 0.5 * jacobian[1]
    scores, _ = _explained(jacobian[1] + 0.01 * noise, jacobian, changes, fold)
    assert float(scores.abs().max()) < 0.02


def test_noise_is_explained_by_nothing_and_a_probe_without_change_by_zero():
    jacobian, changes, noise, fold = columns(probes=20)
    changes[3] = 0.0
    scores, _ = _explained(noise, jacobian, changes, fold)
    assert float(scores.max()) < 0.02 and float(scores[3, 0]) == 0.0


# ------------------------------------------------------------------ acceptance


def noisy_blocks(count, level, generator):
    square = level * (1 + 0.3 * torch.randn(count, 1, generator=generator, dtype=torch.float64)).square()
    return BlockErrors(square=square, weight=torch.ones(count, dtype=torch.float64))


def test_the_best_of_many_equals_is_no_finding():
    generator = torch.Generator().manual_seed(1)
    alarms = 0
    for _ in range(40):
        before = noisy_blocks(20, 1.0, generator)
        alarms += any(judge(before, noisy_blocks(20, 1.0, generator), 0, 25, True).significant for _ in range(25))
    assert alarms <= 3


def test_a_real_fall_is_a_finding():
    generator = torch.Generator().manual_seed(2)
    found = judge(noisy_blocks(20, 1.0, generator), noisy_blocks(20, 0.2, generator), 0, 25, True)
    assert found.significant and found.ratio == pytest.approx(5**0.5, rel=0.3) and found.t > 3


def test_three_blocks_prove_nothing():
    generator = torch.Generator().manual_seed(3)
    found = judge(noisy_blocks(3, 1.0, generator), noisy_blocks(3, 0.01, generator), 0, 1, True)
    assert not found.significant and found.ratio > 5


def test_a_further_effect_must_bring_more_than_the_first():
    before = BlockErrors(square=torch.full((20, 1), 1.0).double(), weight=torch.ones(20).double())
    scatter = 1 + 1e-3 * torch.arange(20).double()[:, None]
    after = BlockErrors(square=scatter / 1.2**2, weight=torch.ones(20).double())
    assert judge(before, after, 0, 10, True).significant
    assert not judge(before, after, 0, 10, False).significant


def test_blocks_are_seconds_of_the_samples_that_count():
    error = torch.ones(1000, 2, 1)
    error[:, 1] = 2.0
    where = torch.zeros(1000, 2, dtype=torch.bool)
    where[200:, 0], where[:410, 1] = True, True  # 2 s, and 1.025 s, whose last part is too short
    blocks = block_errors(error, where, 0.0025)
    assert blocks.square[:, 0].tolist() == [1.0, 1.0, 4.0]
    assert blocks.weight.tolist() == [400.0, 400.0, 400.0]
    assert float(blocks.mse[0]) == pytest.approx(2.0)


# ------------------------------------------------------------------ verdict


def outcome_of(before, after, effects=(), has=None, rounds=()):
    """Where a search could have ended: RMSE of each joint before and after."""

    def errors(rmse):
        return BlockErrors(square=torch.tensor([rmse]).double() ** 2, weight=torch.ones(1).double())

    has = torch.ones(len(effects), len(before), dtype=torch.bool) if has is None else torch.tensor(has)
    final = SimpleNamespace(model=SimpleNamespace(effects=tuple(effects), has=has, shared={GAIN}))
    return Outcome(
        problem=None,
        base=final,
        base_errors=errors(before),
        final=final,
        final_errors=errors(after),
        rounds=list(rounds),
    )


@pytest.mark.parametrize(
    ("before", "after", "effects", "expected"),
    [
        ([1.0], [1.0], [], "nothing_missing"),
        ([2.9], [2.9], [], "nothing_missing"),
        ([3.1], [3.1], [], "unknown"),
        ([1.0, 3.1], [1.0, 3.1], [], "unknown"),
        ([10.0], [1.0], [STRIBECK], "effect"),
        ([10.0], [6.9], [STRIBECK], "effect"),
        ([10.0], [8.0], [STRIBECK], "unknown"),
        ([3.5], [2.9], [STRIBECK], "effect"),
    ],
)
def test_the_verdict_weighs_what_is_left_against_the_floor(before, after, effects, expected):
    floor = torch.ones(len(before), dtype=torch.float64)
    assert verdict(outcome_of(before, after, effects), floor)[0] == expected


def test_the_part_explained_is_of_what_lies_above_the_floor():
    explained = verdict(outcome_of([5.0], [1.0], [STRIBECK]), torch.ones(1).double())[1]
    assert explained == pytest.approx(1.0)
    explained = verdict(outcome_of([5.0], [13**0.5], [STRIBECK]), torch.ones(1).double())[1]
    assert explained == pytest.approx(0.5)


def test_effects_are_named_as_fit_takes_them():
    outcome = outcome_of([1.0] * 3, [1.0] * 3, [STRIBECK, GAIN], [[True] * 3, [True, False, True]])
    assert labels(outcome.final.model, ("a", "b", "c")) == ["stribeck_friction", "torque_gain@a|c@shared"]


def trial(effect, joint, after, significant=True):
    return Trial(
        effect=effect,
        joint=joint,
        screen_score=0.5,
        mse_before=1e-6,
        mse_after=after**2,
        ratio=1e-3 / after,
        t=4.0,
        significant=significant,
        values={},
    )


def test_the_ranking_begins_with_what_was_added_and_names_its_rivals():
    trials = [
        [trial(QUADRATIC, 0, 2e-4), trial(STRIBECK, 0, 2.1e-4), trial(GAIN, 0, 9e-4, significant=False)],
        [trial(STRIBECK, 1, 3e-4), trial(QUADRATIC, 1, 8e-4), trial(GAIN, 1, 9e-4, significant=False)],
    ]
    models = {STRIBECK: "with stribeck", QUADRATIC: "with quadratic"}
    this = Round(trials=trials, chosen=[STRIBECK, STRIBECK], rivals=[[QUADRATIC], []], models=models)
    outcome = outcome_of([1e-3] * 2, [3e-4] * 2, [STRIBECK], rounds=[this])
    entries = ranking(outcome, ("hip", "knee"))
    assert [e["effect"] for e in entries] == ["stribeck_friction", "quadratic_friction", "torque_gain"]
    assert [e["added"] for e in entries] == [True, False, False]
    assert [e["significant"] for e in entries] == [True, True, False]
    assert entries[0]["confounded_with"] == ["quadratic_friction"]
    assert entries[1]["confounded_with"] == ["stribeck_friction"]
    assert entries[0]["joints"] == ["hip", "knee"]
    pair = rivals_of(outcome)[0]
    assert (pair.chosen, pair.rival, pair.joints) == (STRIBECK, QUADRATIC, [0])
    assert pair.models == ("with stribeck", "with quadratic")
    json.dumps(entries)


# ------------------------------------------------------------------ models and simulation


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
        outcome = Outcome(problem=None, base=final, base_errors=errors, final=final, final_errors=errors)
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
    monkeypatch.setattr(search, "_begun", lambda *_: begun)
    monkeypatch.setattr(search, "_promising", lambda *_: {STRIBECK: 0 * same})
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
    trials = [[trial(STRIBECK, 0, 2e-4), trial(QUADRATIC, 0, 2e-4)]]
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


def test_a_base_parameter_takes_up_a_late_log_and_a_turned_mass(bench):
    fitted = fit_side_by_side(bench.twins, [Fitted.start(JointModel.base(bench.problem), bench.truth_values)], 2, True)[
        0
    ]
    effects = [get_effect(name) for name in ("stribeck_friction", "measurement_delay", "com_offset")]
    found = absorbed_effects(bench.twins.with_physics_dt(DT), fitted, effects, torch.tensor([5.0], dtype=torch.float64))
    assert [effect.name for effect in found] == ["measurement_delay", "com_offset"]


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


def test_a_fit_that_starts_at_the_truth_stays_there(bench):
    model = JointModel.base(bench.problem)
    x = model.to_normalised(torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64))
    fitted = fit_side_by_side(
        bench.twins,
        [Fitted.start(model, model.to_physical(x))],
        max_iteration=2,
    )[0]
    assert float((fitted.x - x).abs().max()) < 0.02


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


# ------------------------------------------------------------------ from a run's folder


def hidden_run(folder, effect, seed=0, duration=4.0):
    """A short battery from the independent plant, and the folder of a run that was fitted to it."""
    robot = plant_robot(BENCH)
    suite = make_suite(robot, "battery", seed=seed, duration=duration)
    cfg = PlantCfg(control_dt=robot.control_dt, noise=1e-4, seed=seed)
    effects = () if effect is None else (effect,)
    drawn = draw_visible(robot, suite.runs, effects, np.random.default_rng(seed), cfg=cfg)
    paths = [str(save_recording(folder / f"{i}_{r.name}.npz", r)) for i, r in enumerate(drawn.recordings)]
    data, validation = paths[: len(suite.train)], paths[len(suite.train) :]
    run = folder / "logs" / "run"
    run.mkdir(parents=True)
    names = [*BASE[:-1]]
    values = {name: {"servo": CALM[name]} for name in names} | {"delay": {"all": CALM["delay"]}}
    result = {
        "parameters": values,
        "std": {name: dict.fromkeys(own) for name, own in values.items()},
        "at_bound": [],
        "indistinguishable": [],
        "correlation": {"labels": [], "matrix": []},
        "rmse": {part: {"servo": 0.004, "all": 0.004} for part in ("train", "validation")},
    }
    make_result(task=BENCH, joint_names=["servo"], **result).save(run / "result.json")
    settings = {"task": BENCH, "data": data, "validation": validation, "log_dir": str(folder / "logs")}
    write_json(run / "settings.json", {"settings": settings, "digests": {}})
    return SimpleNamespace(folder=run, problem=load_problem(BENCH, data=data, validation=validation))


def diagnose(*arguments, cwd=None):
    command = [sys.executable, str(ROOT / "scripts" / "diagnose.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd or ROOT)


@pytest.mark.slow
def test_a_hidden_effect_is_named(tmp_path):
    run = hidden_run(tmp_path, "stribeck_friction").folder
    done = diagnose(run, "--no_refit", "--max_effects", 1)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "verdict: effect"
    assert done.stdout.splitlines()[-1] == f"run: {run}"
    content = json.loads((run / "diagnosis.json").read_text())
    first = content["ranking"][0]
    assert "stribeck_friction" in {first["effect"], *first["confounded_with"]}
    assert first["validation_rmse_after"] < 0.5 * first["validation_rmse_before"]
    assert content["added"] == [first["effect"]] and content["runs"] == [str(run)]
    assert (run / "report.html").is_file()


@pytest.mark.slow
def test_where_nothing_is_missing_nothing_is_named(tmp_path):
    run = hidden_run(tmp_path, None).folder
    done = diagnose(run, "--no_refit", "--max_effects", 1)
    assert done.returncode == 0, done.stderr
    content = json.loads((run / "diagnosis.json").read_text())
    assert content["verdict"] == "nothing_missing" and content["added"] == []


OWN = '''
from pace_actuators.effects import Effect, EffectParameter, register_effect

@register_effect
class Lean(Effect):
    """A constant torque."""

    name = "lean_of_my_own"
    stage = "transmission"
    parameters = (EffectParameter(name="torque", unit="N m", lower=-3.0, upper=3.0, null=0.0, start=0.1, meaning="T"),)
    equation = "τ + T"
    looks = "a constant lean"
    source = "a test"

    def transmission(self, s):
        s.effort += self.torque
'''


@pytest.mark.slow
def test_an_effect_of_one_s_own_is_considered(tmp_path):
    run = hidden_run(tmp_path, "torque_offset").folder
    (tmp_path / "lean_effects.py").write_text(OWN)
    done = diagnose(run, "--no_refit", "--only", "--effects", "lean_effects:Lean", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    content = json.loads((run / "diagnosis.json").read_text())
    assert content["tried"] == ["lean_of_my_own"] and content["added"] == ["lean_of_my_own"]


def test_candidates_are_all_registered_effects_or_only_one_s_own():
    every = candidate_effects()
    assert STRIBECK in every and len(every) == len(set(every)) > 20
    assert candidate_effects(["torque_gain"], only=True) == [GAIN]
    assert candidate_effects(["torque_gain"]) == every


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["RUN"], r"result.json does not exist"),
        (["RUN", "--max_effects", "0"], "max_effects is 0, expected at least 1"),
        (["RUN", "--only"], "--only needs the effects to try"),
        (["FITTED", "--effects", "no_such_effect"], "There is no effect 'no_such_effect'"),
    ],
)
def test_bad_input_is_one_line_and_status_2(tmp_path, arguments, message):
    fitted = tmp_path / "fitted"
    fitted.mkdir()
    make_result(task=BENCH).save(fitted / "result.json")
    write_json(fitted / "settings.json", {"settings": {"task": BENCH}, "digests": {}})
    done = diagnose(*({"RUN": tmp_path, "FITTED": fitted}.get(word, word) for word in arguments))
    assert done.returncode == 2 and message in done.stderr, done.stderr
    assert "Traceback" not in done.stderr and len(done.stderr.strip().splitlines()) == 1
    assert not (fitted / "diagnosis.json").exists()
