"""Laws that drives have: closed forms, the heat of a session, combs, and where a diagnosis of a run begins."""

import json
import math
import sys
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diagnoses import FITS, hidden_run, joint_alone
from drive_laws import CASES, OUTSIDE, table
from drive_laws_plant import Law, Plan, simulate
from effect_envs import Drive
from problems import CALM, DT, chirp, env_cfg, make_problem, physical, record, replayed

from pace_actuators.effects import EffectCfg, comb_grid, get_effect
from pace_envs import set_physics_dt
from pace_optim.diagnosis import DiagnosisSettings, diagnose
from pace_optim.diagnosis.candidates.screening import screen
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.estimate.comb_scan import scanned
from pace_optim.joints.fits.base_fit import fit_base
from pace_optim.joints.fits.model import JointModel
from pace_optim.problem.log_and_robot import drive_reach, with_work
from pace_optim.recording.dataset import Work
from pace_optim.run.result import FitResult

RIPPLE, FADE = get_effect("torque_ripple"), get_effect("torque_fade")


def test_a_part_of_gravity_is_fed_forward():
    drive = Drive(["gravity_compensation"], {"gravity_compensation.share": 0.7})
    drive.motor.set_load_effort(torch.full((1, 1), -3.0, dtype=torch.float64))
    assert drive.one(0.1) == pytest.approx(10.0 + 0.7 * 3.0)


def test_a_supply_sags_with_the_torque_and_gives_no_more_than_a_quarter_of_its_scale():
    drive = Drive(["supply_sag"], {"supply_sag.effort": 200.0})
    assert [drive.one(target) for target in (0.2, -0.2)] == pytest.approx([18.0, -18.0])
    assert drive.one(5.0) == pytest.approx(50.0)


@pytest.mark.parametrize(
    "pair",
    [("torque_gain", "torque_ripple"), ("command_rate_limit", "command_filter"), ("torque_gain", "torque_over_torque")],
)
def test_effects_act_in_one_order_however_they_are_named(pair):
    values = {
        "torque_gain.gain": 0.5,
        "torque_ripple.cosine": 3.0,
        "command_rate_limit.velocity": 2.0,
        "command_filter.time_constant": 0.02,
        **{f"torque_over_torque.{p.name}": 1.0 for p in get_effect("torque_over_torque").parameters},
    }
    own = {name: value for name, value in values.items() if name.partition(".")[0] in pair}
    first, second = (Drive(list(names), own) for names in (pair, pair[::-1]))
    for target in (0.0, 0.1, 0.3):
        assert first.one(target) == second.one(target)


def test_a_filter_of_commands_follows_them_exactly():
    drive = Drive(["command_filter"], {"command_filter.time_constant": 0.02})
    assert drive.one(0.0) == 0.0
    steps = [drive.one(0.1) for _ in range(3)]
    assert steps == pytest.approx([10.0 * (1 - math.exp(-k * DT / 0.02)) for k in (1, 2, 3)])


@pytest.mark.slow
def test_a_torque_constant_falls_with_the_heat_of_the_session():
    drive = Drive(["torque_fade"], {"torque_fade.effort": 40.0, "torque_fade.time_constant": 2.0})
    drive.motor.remember(lambda time_constant, rows: torch.full_like(time_constant, 160.0))
    assert drive.one(0.2) == pytest.approx(20.0 * 0.9)
    for _ in range(round(10 / DT)):
        last = drive.one(0.2)
    assert last == pytest.approx(20.0 * (1 - 400 / 1600), rel=0.01)
    assert drive.one(5.0) == pytest.approx(500.0 * (1 - 400 / 1600), rel=0.01)


@pytest.mark.slow
def test_friction_and_torque_follow_a_logged_temperature_and_voltage():
    data = joint_alone().problem.dataset
    warm = [replace(each, temperature=np.linspace(20.0, 60.0, len(each.time))[:, None]) for each in data.recordings]
    data = replace(data, recordings=tuple(warm))
    logged = data.condition("temperature", 9)
    assert data.condition("voltage", 9) is None and logged.varies.tolist() == [True]
    assert logged.values[0, 0].tolist() == pytest.approx(np.linspace(20.0, 60.0, 9).tolist())
    line = torch.tensor([[[1.0, 0.5]]]), torch.linspace(20.0, 60.0, 9)[None, None]
    for name, values, torque, friction in (
        ("thermal_torque", {"slope": -0.01}, 10.0 * 0.85, 0.5),
        ("thermal_friction", {"slope": -0.01}, 10.0, 0.5 * 0.85),
        ("supply_voltage", {"share": 1.0, "nominal": 50.0}, 8.0, 0.5),
        ("gain_over_voltage", {"share_3": 0.25, "center": 30.0, "reach": 20.0}, 12.5, 0.5),
    ):
        drive = Drive([name], {f"{name}.{key}": value for key, value in values.items()})
        drive.motor.notice(lambda condition, places, rows, logged=line: logged)
        drive.motor.set_session_time(torch.full((1, 1), 3.0))  # half of the way: 40 °C, or 40 V
        assert drive.one(0.1) == pytest.approx(torque)
        assert float(drive.motor.joint_friction) == pytest.approx(friction)


@pytest.mark.parametrize(
    ("name", "method", "values"),
    [
        ("gain_over_time", "drive", {"share_0": 0.5, "share_8": 0.5}),
        ("gain_over_position", "drive", {"share_8": 0.5}),
        ("gain_over_speed", "drive", {}),
    ],
)
def test_curves_of_gains_multiply_the_torque(name, method, values):
    drive = Drive([name], {f"{name}.{key}": value for key, value in values.items()})
    expected = 15.0 if name != "gain_over_speed" else 10.0
    assert drive.one(0.1) == pytest.approx(expected)


def test_an_inertia_that_goes_with_the_position_takes_what_its_change_takes():
    drive = Drive(
        ["inertia_over_position"], {"inertia_over_position.share_8": 0.5, "inertia_over_position.share_9": 1.0}
    )
    one = torch.ones(1, 1, dtype=torch.float64)
    drive.motor.set_link(0.3 * one, 0.0 * one, 0.3 * one)
    drive()
    assert float(drive.motor.joint_armature) == pytest.approx(0.1 + 0.5 * 0.4)
    slope = 0.5 / 0.125
    assert drive.one(0.1, q=0.0625, v=2.0) - drive.one(0.1, q=0.0625, v=0.0) + 2.0 == pytest.approx(
        -0.5 * slope * 0.4 * 4.0, rel=1e-6
    )


def test_bounds_of_curves_follow_the_drive(tmp_path):
    curve = get_effect("torque_over_torque")
    assert curve.parameters[0].reaching(0.0, 0.0, 2.5) == (-2.5, 2.5)
    assert curve.parameters[0].reaching(0.0, 0.0) == (-10.0, 10.0)
    robot = joint_alone().problem
    model = replace(JointModel.base(robot), efforts=torch.tensor([0.5]).double())
    own = model.with_effect(curve, torch.tensor([True]))
    assert own.upper[0, own.columns(curve).start] == 0.5


def test_the_heat_of_a_session_is_that_of_all_torque_before():
    work = Work(begin=torch.tensor([0.0, 10.0]), end=torch.tensor([10.0, 20.0]), square=torch.tensor([[4.0], [9.0]]))
    time, constant = torch.tensor([[0.0], [10.0], [15.0], [20.0]]), torch.full((4, 1), 5.0)
    first = 4.0 * (1 - math.exp(-2))
    expected = [
        0.0,
        first,
        first * math.exp(-1) + 9.0 * (1 - math.exp(-1)),
        first * math.exp(-2) + 9.0 * (1 - math.exp(-2)),
    ]
    assert work.heat(time, constant)[:, 0].tolist() == pytest.approx(expected)


def test_how_hard_a_drive_worked_is_read_off_its_recordings():
    problem = make_problem([record(chirp(1.0), CALM), record(chirp(1.0), CALM)])
    recordings = problem.dataset.recordings
    env = problem.make_env(1)
    data = with_work(problem.dataset, env)
    assert drive_reach(env, recordings)["servo"] == pytest.approx(89.0)  # its limit
    env.close()
    assert data.work is not None and float(data.work.begin[0]) == 0.0
    assert float(data.work.end[-1]) == pytest.approx(2.0, abs=0.01)
    sim = recordings[0]
    speed = np.gradient(sim.dof_pos[:, 0], sim.time)
    asked = 85.0 * (sim.sampled_command - sim.dof_pos)[:, 0] - 0.6 * speed
    half = len(data.work.square) // 2
    assert float(data.work.square[:half].mean()) == pytest.approx(float((asked**2).mean()), rel=0.15)


@cache
def rippling(periods=61.0, size=0.5):
    """Two slow waves over two radians with a ripple, recorded at a fine step. Made once: change nothing."""
    fine = env_cfg()
    fine.set_effects(["torque_ripple"])
    set_physics_dt(fine, DT / 5)
    truth = CALM | {
        "torque_ripple.sine": {"servo": 0.6 * size},
        "torque_ripple.cosine": {"servo": 0.8 * size},
        "torque_ripple.periods": {"servo": periods},
    }
    waves = [np.sin(2 * np.pi * rate * np.arange(0, 3, DT))[:, None] for rate in (0.3, 0.5)]
    return [replayed(wave, truth, fine, noise=1e-4, seed=i) for i, wave in enumerate(waves)]


@pytest.mark.slow
def test_the_frequency_of_a_comb_is_found_among_all_its_valleys():
    """A search sat in the valley beside it, at 63.4 per turn for 60."""
    wave, other = rippling()
    problem = make_problem(wave, validation=[other]).with_physics_dt(DT / 2)
    twins, base, effort = fit_base(FITS, problem, physical(problem, CALM))
    coarse = twins.coarse()
    seen = FITS.looked_at(twins.in_windows(), [replace(base, tried=None)])[0]
    probes = screen(FITS, coarse, seen, [RIPPLE], effort, DEFAULT.candidates)
    assert len(probes) == DEFAULT.candidates.valleys
    best = max(probes, key=lambda probe: float(probe.score))
    names = [p.name for p in RIPPLE.parameters]
    sine, cosine, periods = (float(best.values[0, names.index(name)]) for name in ("sine", "cosine", "periods"))
    assert periods == pytest.approx(61.0, abs=0.8) and math.hypot(sine, cosine) == pytest.approx(0.5, rel=0.3)


@pytest.mark.slow
def test_a_fit_begins_in_the_valley_of_a_comb():
    problem = make_problem(rippling()).with_effects(["torque_ripple"])
    none = {"torque_ripple.sine": {"servo": 0.0}, "torque_ripple.cosine": {"servo": 0.0}}
    values = CALM | none | {"torque_ripple.periods": {"servo": 40.0}}
    x = problem.space.to_normalised(problem.space.from_dict(values))
    effects = [EffectCfg.parse("torque_ripple")]
    found = scanned(problem.space, problem.evaluator(), x, effects, problem.joint_names)
    own = problem.space.to_physical(found)[problem.space["torque_ripple.periods"]]
    assert float(own) == pytest.approx(61.0, abs=0.8)
    assert scanned(problem.space, problem.evaluator(), x, [EffectCfg.parse("torque_gain")], problem.joint_names) is None


def test_a_grid_of_a_comb_is_finer_than_a_period_over_the_range():
    grid = comb_grid(RIPPLE, 2.0)
    assert float(grid.diff().max()) == pytest.approx(math.pi / 2)
    assert float(grid[0]) == pytest.approx(math.pi)  # one period in the range
    assert float(comb_grid(RIPPLE, 6.0)[0]) == RIPPLE.parameters[2].lower
    assert len(comb_grid(RIPPLE, 0.01)) == 1
    with pytest.raises(ValueError, match="no frequency"):
        comb_grid(FADE, 2.0)


def test_a_diagnosis_begins_with_the_effects_of_the_run():
    """It named off_damping again, which the run had, and compared with the error without it."""
    robot = joint_alone()
    own = replace(EffectCfg.parse("torque_offset"), values={"effort": {"servo": 0.7}})
    base = fit_base(FITS, robot.problem, robot.truth, own=[own])[1]
    assert base.model.names_of_joints == [["torque_offset"]]
    result = SimpleNamespace(
        effects=["torque_offset", "proportional_gain"],
        parameters={"torque_offset.effort": {"servo": 0.7}, "proportional_gain.gain": {"servo": 2.0}},
        joint_names=["servo"],
    )
    module = sys.modules[diagnose.__module__]
    (cfg,) = module._own_effects(SimpleNamespace(unknown=("stiffness",)), result)
    assert cfg.effect == "torque_offset" and cfg.values == {"effort": {"servo": 0.7}}


@pytest.mark.slow
def test_a_run_that_has_what_is_missing_is_told_so(tmp_path):
    run = hidden_run(tmp_path, "torque_offset", duration=2.0)
    result = FitResult.load(run.folder)
    more = {"torque_offset.effort": {"servo": 0.5}}
    replace(
        result,
        effects=["torque_offset"],
        parameters={**result.parameters, **more},
        std={**result.std, **more},
        units={**result.units, "torque_offset.effort": "N m"},
    ).save(run.folder / "result.json")
    settings = json.loads((run.folder / "settings.json").read_text())
    settings["settings"]["effects"] = ["torque_offset"]
    (run.folder / "settings.json").write_text(json.dumps(settings))
    found = diagnose(DiagnosisSettings(run=run.folder, effects=["stribeck_friction"], only=True))
    assert (found.verdict, found.paying, found.runs) == ("nothing_missing", [], [str(run.folder)])
    assert found.sizes[0]["effect"] == "torque_offset" and found.ladder[0]["validation_rmse"] < 1.2e-4
    assert "The search began with what the run has: torque_offset." in found.data


# ---- the benchmark -------------------------------------------------------------------------------------------------


def test_the_plant_of_the_benchmark_rests_where_its_law_says():
    base = {"armature": 0.05, "viscous_friction": 1.0, "friction": 0.0, "encoder_bias": 0.01, "delay": 0.0}
    plan = Plan(name="hold", command=np.full(200, 0.5), stiffness=50.0, damping=1.0)
    free, _ = simulate(plan, base, Law(), 0.0)
    held, _ = simulate(plan, base, Law(asked=lambda tau, s: tau - s.gravity), 0.0)
    weight = 9.81 * 0.2
    q = float(free[-1]) + 0.01
    assert 50.0 * (0.5 - q + 0.01) == pytest.approx(weight * math.sin(q), rel=1e-3)
    assert float(held[-1]) == pytest.approx(0.5, abs=1e-4)


def test_the_table_of_the_benchmark_counts_wrong_names():
    one = {"seed": 0, "best_curve": None, "before": 9.0, "after": 1.0, "seconds": 3.0, "right_variable": False}
    results = [
        one | {"case": "sag", "said": ["supply_sag"], "right": True, "wrong_name": False},
        one | {"case": "lever", "said": ["torque_limit"], "right": False, "wrong_name": True},
    ]
    lines = table(results)
    assert "in the library: 1 of 1 right, 0 wrong" in lines and "outside: 0 of 1 right, 1 wrong names" in lines
    assert len(OUTSIDE) == 12 and set(OUTSIDE) < set(CASES)
