"""Models of joints alone: how they move, and how they are fitted."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diagnoses import FITS, joint_alone
from problems import CALM, DT

from pace_actuators.effects import get_effect, probe_points
from pace_optim.diagnosis.candidates.multistart import multistart
from pace_optim.diagnosis.checks.data_check import check_data, encoder_steps, noise_floors, unstamped
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.joints.fits import base_fit
from pace_optim.joints.fits.base_fit import fit_base
from pace_optim.joints.fits.fits import TRIALS, Fits, JointDescent
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel, start_values, whole_values
from pace_optim.joints.fits.reference_update import ReferenceUpdate
from pace_optim.joints.fits.side_by_side import SideBySide, Slot, _merged
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.recording import Recording

STRIBECK, QUADRATIC, GAIN = (get_effect(n) for n in ("stribeck_friction", "quadratic_friction", "torque_gain"))


def descent(start, rough=False):
    """Of one model, without a simulation."""
    return JointDescent(start, torch.ones(1), False, rough, DEFAULT.fitting)


@pytest.fixture(scope="module")
def bench():
    """A short chirp of one joint."""
    return joint_alone()


@pytest.mark.parametrize(
    ("neighbours", "left", "references"),
    [
        (0, 0.04, ["measured_path"]),
        (0, 0.06, ["measured_path", "reference_path"]),  # gravity is not linear so far from what was measured
        (1, 0.04, ["reference_path"]),
    ],
)
def test_the_base_model_moves_along_what_was_measured_only_near_it(bench, monkeypatch, neighbours, left, references):
    used = []

    def fitted_along(fits, problem, fitted, along, model_effects, say):
        used.append(along.__name__)
        twins = SimpleNamespace(path=SimpleNamespace(typical_effort=lambda armature: armature))
        return twins, replace(fitted, score=torch.tensor([left**2], dtype=torch.float64))

    monkeypatch.setattr(base_fit, "_fit_along", fitted_along)
    trees = [[*bench.problem.joint_names, *["other"] * neighbours]]
    problem = replace(bench.problem, trees=trees)
    base_fit.fit_base(FITS, problem, problem.space.to_physical(problem.space.start))
    assert used == references


@pytest.mark.slow
def test_how_far_a_joint_is_from_its_reference(bench):
    motion = ReferenceUpdate(fits=FITS, problem=bench.problem, candidates=(), enough=torch.zeros(1))

    def away(**changes):
        values = torch.tensor([[({**CALM, **changes})[name] for name in BASE]], dtype=torch.float64)
        return motion.away(bench.twins, Fitted.start(JointModel.base(bench.problem), values))

    assert away() < 1e-3
    assert away(encoder_bias=CALM["encoder_bias"] + 0.03) == pytest.approx(0.03, rel=0.1)


@pytest.mark.slow
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


@pytest.mark.slow
def test_models_that_share_no_effects_move_side_by_side_as_each_alone(bench):
    base, here = JointModel.base(bench.problem), torch.tensor([True])
    start = torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64)
    own = {STRIBECK: [0.8, 0.1], QUADRATIC: [0.3], GAIN: [-0.2]}

    def slot(*effects):
        model, physical = base, start
        for effect in effects:
            values = torch.tensor([own[effect]], dtype=torch.float64)
            model, physical = model.extended(physical, effect, here, values)
        return model, physical

    def errors(*models):
        batch = SideBySide(bench.twins, [Slot(model=model, rows=1) for model, _ in models], training=True)
        where = batch.dataset.train.clone()
        where[200:] = False
        return batch.simulate([physical[None] for _, physical in models], where)

    a, b, c = own
    models = [slot(b, c), slot(a, c), slot(a, b), slot(), slot(a, b, c), slot(c)]
    together = errors(*models)
    for row, model in zip(together, models, strict=True):
        assert torch.equal(row, errors(model)[0])
    assert len({float(row.square().sum()) for row in together}) == len(models)


def test_side_by_side_each_model_keeps_the_order_of_its_effects():
    assert _merged([("b", "c"), ("a", "c"), ("a", "b"), ()]) == ["a", "b", "c"]
    assert _merged([("a",), ("b",), ("a", "b", "c")]) == ["a", "b", "c"]
    assert _merged([("a", "x"), ("a", "y"), ("a", "b", "x"), ("b", "y")])[:2] == ["a", "b"]


def test_the_descent_finds_the_base_parameters(bench):
    _, fitted, effort = fit_base(FITS, bench.problem, bench.problem.space.to_physical(bench.problem.space.start))
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
    left = FITS.validation_errors(bench.twins, [base])[0].mse.sqrt()
    run = SimpleNamespace(effects=[], rmse={"validation": {"servo": 1e-7}}, physics_dt=DT)
    for it, floor in (
        (run, left),
        (SimpleNamespace(**{**vars(run), "rmse": {"validation": {"servo": float(left)}}}), None),
        (SimpleNamespace(**{**vars(run), "effects": ["torque_gain"]}), None),
        (SimpleNamespace(**{**vars(run), "physics_dt": bench.problem.physics_dt}), None),
        (None, None),
    ):
        check = check_data(FITS, bench.problem, bench.twins, base, it)
        said = [sentence for sentence in check.sentences if "comes from the step" in sentence]
        if floor is None:
            assert float(check.floor) < 0.5 * float(left) and not said
        else:
            assert check.floor == pytest.approx(floor) and "2.5 ms" in said[0] and "on servo" in said[0]


@pytest.mark.parametrize(("began", "said"), [([0.0, 0.0], 1), ([1.7e9, 1.7e9 + 60], 0), ([0.0], 0)])
def test_recordings_that_nothing_places_in_time_are_said_to_count_in_their_order(began, said):
    """An arm's friction was cold anew in each: "unknown", and no word of why one recording alone would show it."""
    assert len(unstamped([SimpleNamespace(start_stamp=start, duration=10.0) for start in began])) == said


def test_a_fit_that_starts_at_the_truth_stays_there(bench):
    model = JointModel.base(bench.problem)
    x = model.to_normalised(torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64))
    fitted = FITS.side_by_side(
        bench.twins,
        [Fitted.start(model, model.to_physical(x))],
        max_iteration=2,
    )[0]
    assert float((fitted.x - x).abs().max()) < 0.02


def test_steps_with_the_last_derivatives_go_the_rest_of_the_way(bench):
    """A rate limit was eleven of its error bars off: fits ended after two iterations on whole recordings."""
    model, values = JointModel.base(bench.problem), bench.truth_values.clone()
    truth = model.to_normalised(values)
    values[0, : BASE.index("encoder_bias")] *= 1.03
    start = Fitted.start(model, values)
    fits = replace(FITS, cfg=replace(FITS.cfg, narrow=1e-4))  # the ground is smooth: narrow derivatives are exact
    looked, led = (fits.side_by_side(bench.twins, [start], 1, keep_jacobian=True, chords=k)[0] for k in (0, 4))
    assert torch.equal(looked.x, start.x) and torch.equal(led.jacobian, looked.jacobian)
    assert float((led.x - truth).abs().max()) < 0.1 * float((start.x - truth).abs().max())
    assert led.error == pytest.approx(fits.trained_errors(bench.twins, led), abs=1e-7)
    assert float(fits.to_the_end(bench.twins, start).score) <= float(led.score)


def test_models_far_behind_are_left_at_the_coarse_step(bench):
    model = JointModel.base(bench.problem)
    heavy = bench.truth_values.clone()
    heavy[:, BASE.index("armature")] *= 4
    held = replace(model, lower=heavy, upper=heavy)
    far, near = FITS.coarse_to_fine(bench.twins, [Fitted.start(held, heavy), Fitted.start(model, bench.truth_values)])
    assert far.jacobian is None and near.jacobian is not None
    assert float(far.score.sqrt()) > 3 * float(near.score.sqrt())


@pytest.mark.slow
def test_far_from_the_truth_a_refit_also_starts_at_the_best_of_many_points(bench):
    heavy = bench.truth_values.clone()
    model = JointModel.base(bench.problem)
    heavy[:, BASE.index("armature")] = model.upper[:, BASE.index("armature")]
    coarse, now = bench.twins.with_physics_dt(DT), Fitted.start(model, heavy)
    starts = multistart(FITS, coarse, now, [STRIBECK, get_effect("joint_elasticity")], DEFAULT.candidates)
    stiff = [start.tried.name for start in starts[1:]]
    assert starts[0].tried is STRIBECK and stiff == ["joint_elasticity"] * len(probe_points(starts[1].tried))
    slots = [Slot(model=model, rows=1), *(Slot(model=start.model, rows=1) for start in starts)]
    batch = SideBySide(coarse, slots, training=True)
    rows = [heavy[None], *(start.model.to_physical(start.x)[None] for start in starts)]
    errors = batch.simulate(rows, batch.dataset.train).square().mean(dim=(1, 2, 3)).sqrt()
    assert float(errors[1]) < 0.7 * float(errors[0]) and float(errors[2:].min()) < 0.7 * float(errors[0])
    stiffness = {round(float(start.model.to_physical(start.x)[0, len(BASE)])) for start in starts[1:]}
    assert stiffness == {200, 500, 1500, 5000}  # the best base of each probe, whatever the others' errors are


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_model_is_fitted_along_the_motion_that_it_gives_the_robot(bench):
    heavy = bench.truth.clone()
    heavy[bench.problem.space["armature"]] *= 3
    elsewhere = twin_problem(bench.problem, reference_path(bench.problem, heavy))
    now = Fitted.start(JointModel.base(bench.problem), bench.truth_values)
    follow = ReferenceUpdate(fits=FITS, problem=bench.problem, candidates=[], enough=torch.zeros(1)).follow
    along, fitted = follow(elsewhere, now)
    assert float((along.path.position - bench.twins.path.position).abs().max()) < 1e-9
    assert float(fitted.score.sqrt()) < 2e-4
    again, same = follow(along, fitted)
    assert again is along and same is fitted  # it has not moved


def test_a_descent_ends_although_damped_steps_keep_gaining_next_to_nothing(bench):
    """After such a step derivatives are new, which is no gain and no failure."""
    model = JointModel.base(bench.problem)
    way = descent(Fitted.start(model, bench.truth_values), rough=False)
    lowest, last = 1.0, model.size + 2
    asked = 0
    while not way.finished and asked < 10:
        asked += 1
        rows = way.ask()
        error = torch.full((len(rows), 1, 1, 1), 1.1 * lowest)
        if bool((rows[0] == way.x).all()):  # derivatives are asked for
            error[0] = lowest
        else:
            lowest *= 1 - 1e-5
            error[last] = lowest
        way.tell(rows, error)
    assert asked == 4 and float(way.score) == pytest.approx(lowest**2)


@pytest.mark.parametrize(
    ("promised", "rough", "expected"),
    [(1e-4, False, 1), (1e-3, False, 2), (1e-4, True, 5)],  # on to the narrowest of three steps
)
def test_a_descent_ends_where_its_linear_model_promises_next_to_nothing(bench, promised, rough, expected):
    model = JointModel.base(bench.problem)
    start = model.to_normalised(bench.truth_values)
    axes = torch.linalg.qr(torch.randn(40, model.size + 1, generator=torch.Generator().manual_seed(0)).double())[0]
    left, columns = axes[:, 0], axes[:, 1:]
    bottom = start[0] + torch.full((model.size,), math.sqrt(promised / model.size), dtype=torch.float64)
    way = descent(Fitted.start(model, bench.truth_values), rough=rough)
    asked = 0
    while not way.finished and asked < 10:
        asked += 1
        rows = way.ask()
        way.tell(rows, (left + (rows[:, 0] - bottom) @ columns.T)[..., None, None])
    assert asked == expected
    assert float(way.score) == pytest.approx(1.0 + (promised if expected == 1 else 0.0), abs=1e-6)


def test_a_model_that_is_done_is_simulated_no_further_and_changes_nothing_beside_it(bench):
    model = JointModel.base(bench.problem)
    off = bench.truth_values * torch.tensor([[1.5, 0.5, 2.0, 1.0, 1.0]])
    first = FITS.side_by_side(bench.twins, [Fitted.start(model, bench.truth_values)], 9)[0]
    starts = [Fitted.start(model, model.to_physical(first.x)), Fitted.start(model, off)]
    alone = [FITS.side_by_side(bench.twins, [start], 4)[0] for start in starts]
    batches = []

    def side_by_side(problem, slots, training):
        batches.append(len(slots))
        return FITS.batch(problem, slots, training=training)

    together = Fits(batch=side_by_side).side_by_side(bench.twins, starts, 4)
    assert batches == [2, 1]
    for fitted, single in zip(together, alone, strict=True):
        assert torch.equal(fitted.x, single.x) and torch.equal(fitted.score, single.score)


def gaining(model, truth, gains):
    """A descent whose favoured steps lower the error by these parts, (asks, joints); how often it had to be asked."""
    way = descent(Fitted.start(model, truth), rough=False)
    lowest, asked = torch.ones(model.num_joints), 0
    for gain in [torch.zeros(model.num_joints), *(torch.tensor(each) for each in gains)]:  # derivatives come first
        if way.finished:
            break
        asked += 1
        rows = way.ask()
        lowest = lowest * (1 - gain)
        error = 1.1 * lowest.repeat(len(rows), 1)
        error[0] = lowest
        way.tell(rows, error[:, None, None])
    return way, asked


def test_a_descent_ends_when_every_joint_has_once_come_to_its_end(bench):
    one = JointModel.base(bench.problem)
    two = replace(
        one,
        has=torch.zeros(0, 2, dtype=torch.bool),
        lower=one.lower.repeat(2, 1),
        upper=one.upper.repeat(2, 1),
        ranges=one.ranges.repeat(2, 1),
        efforts=one.efforts.repeat(2),
        loops=one.loops.repeat(2),
    )
    small = 1e-5
    gains = [[small, 0.5], [small, 0.5], [0.5, small], [0.5, small], [0.5, 0.5]]  # the first joint gains again later
    way, asked = gaining(two, bench.truth_values.repeat(2, 1), gains)
    assert way.finished and asked == 5


def test_a_neighbour_moves_another_entry_of_each_joint(bench):
    """As many rows as the joint with most free entries needs, whatever effects the others have."""
    one = JointModel.base(bench.problem)
    two = replace(
        one,
        has=torch.zeros(0, 2, dtype=torch.bool),
        lower=one.lower.repeat(2, 1),
        upper=one.upper.repeat(2, 1),
        ranges=one.ranges.repeat(2, 1),
        efforts=one.efforts.repeat(2),
        loops=one.loops.repeat(2),
    )
    two = two.with_effect(GAIN, torch.tensor([True, False])).with_effect(STRIBECK, torch.tensor([False, True]))
    size, most = two.size, len(BASE) + len(STRIBECK.parameters)
    assert size == most + 1 == two.most_free + 1
    start = Fitted(model=two, x=torch.full((2, size), 0.1).double(), score=torch.full((2,), torch.inf).double())
    columns = torch.randn(50, size, 2, generator=torch.Generator().manual_seed(0)).double()
    way = JointDescent(start, torch.full((2,), 50.0), True, False, DEFAULT.fitting)
    rows = way.ask()
    assert len(rows) == most + len(TRIALS)
    moved = (rows[1 : 1 + most] != way.x).sum(dim=0)
    assert torch.equal(moved, two.free.long())  # each once
    way.tell(rows, torch.einsum("rjp,kpj->rkj", rows, columns)[:, :, None])
    found = way.result().jacobian[:, :, 0]
    assert torch.allclose(found, (columns * two.free.T).transpose(0, 1), atol=1e-9)


def test_a_model_goes_on_that_is_near_the_best_on_any_joint():
    def model(*scores):
        return SimpleNamespace(score=torch.tensor(scores))

    assert FITS._near([model(1.0, 1.0), model(16.0, 0.5), model(16.0, 16.0)]) == [True, True, False]


def test_a_descent_says_whether_it_was_still_falling_at_its_last_iteration(bench):
    model = JointModel.base(bench.problem)

    def falls(*gains):
        way, _ = gaining(model, bench.truth_values, [[gain] for gain in gains])
        return way.result().falls

    assert falls(0.5, 0.5, 0.5) and falls(0.03, 0.03, 0.03)
    assert not falls(0.5, 0.005, 0.005, 0.005)  # crawls
    assert not falls(0.5, 0.001, 0.001)  # has converged
    assert not falls()


def test_a_model_that_still_falls_goes_on_while_it_is_near_the_best():
    scores = {"slow": [1.5, 1.0, 0.3], "far": [50.0, 0.0], "done": [0.6], "best": [0.5, 0.4, 0.3, 0.2]}  # run by run
    asked = []

    class Recorded(Fits):
        def side_by_side(self, problem, starts, *_, **__):
            return fit(problem, starts)

    def fit(problem, starts):
        names = [start.name for start in starts]
        asked.append((problem, names))
        left = [scores[name] for name in names]
        own = [each.pop(0) if each else 0.15 for each in left]
        return [
            SimpleNamespace(name=name, score=torch.tensor([score]), falls=bool(more))
            for name, score, more in zip(names, own, left, strict=True)
        ]

    problem = SimpleNamespace(coarse=lambda: "coarse", in_windows=lambda: "windows")
    Recorded().coarse_to_fine(problem, [SimpleNamespace(name=name) for name in scores])
    assert asked[:3] == [("coarse", list(scores)), ("coarse", ["slow", "best"]), ("coarse", ["slow", "best"])]
    near = ["slow", "done", "best"]
    assert asked[3:] == [("windows", near), (problem, near)]  # then the finer step, at last on whole recordings


def test_derivatives_of_error_bars_move_a_joint_by_as_much_as_its_error(bench, monkeypatch):
    """A filter of 16 ms had an error bar of 5 us: over a short step, friction that sticks moved the joint more."""
    model = JointModel.base(bench.problem)
    now = Fitted.start(model, torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64))
    moves = torch.tensor([1.0, 1e-2, 1e-3, 0.0, 2e-2])
    jacobian = moves[:, None, None, None].expand(-1, 100, 2, 1)
    seen = replace(now, jacobian=jacobian, error=torch.full((100, 2, 1), 1e-4))
    began = []
    monkeypatch.setattr(Fits, "side_by_side", lambda self, problem, starts, *_, **__: began.append(starts[0]) or starts)
    FITS.looked_closely(bench.twins, seen)
    narrow, longest = DEFAULT.fitting.narrow, DEFAULT.fitting.wide[0]
    expected = [narrow, 1e-2, longest, longest, 5e-3]
    assert began[0].steps[0].tolist() == pytest.approx(expected, rel=1e-5)
    rows = descent(began[0]).ask()
    neighbours = rows[1 : 1 + model.most_free, 0] - rows[0, 0]
    assert neighbours.diagonal().abs().tolist() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("step", "said"), [(1e-6, False), (2e-5, False), (1e-3, True)])
def test_the_last_digit_of_a_file_is_no_step_of_an_encoder(step, said):
    time = np.arange(2000) / 200
    noisy = np.sin(3 * time) + 1e-4 * np.random.default_rng(0).normal(size=len(time))
    position = (np.round(noisy / step) * step)[:, None]
    one = Recording(name="r", joint_names=("j",), time=time, dof_pos=position, des_dof_pos=position, notes=())
    assert bool(encoder_steps(noise_floors([one]), ["j"])) == said
