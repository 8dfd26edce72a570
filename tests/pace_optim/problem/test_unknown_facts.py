"""Facts of the drives that a user declares unknown."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bench_recordings import Bench, chirp, record

from pace_actuators import PaceDCMotorCfg
from pace_actuators.identified import DRIVE_FIELDS
from pace_optim.comparison.drive_loads import drive_loads
from pace_optim.identification.fit import fit
from pace_optim.problem.drive_facts import asked_torque, in_force
from pace_optim.problem.problem import load_problem
from pace_optim.problem.unknown_facts import identified_gains, started_from, with_identified
from pace_optim.recording import Drive, Recording, conform_recording, save_recording
from pace_optim.run.open import open_problem
from pace_optim.run.settings import FitSettings

BENCH = "Pace-TestBench-v0"


@pytest.fixture(scope="module")
def soft(tmp_path_factory):
    """Two recordings of a drive whose gains are twice what is stated."""
    folder = tmp_path_factory.mktemp("soft")
    return [
        record(folder / f"{kp}.csv", Bench(kp=kp, kd=kd, stated={"stiffness": kp / 2, "damping": kd / 2}),
               position=chirp(1.0), seed=kp) for kp, kd in ((40, 1.2), (70, 2.4))
    ]  # fmt: skip


@pytest.fixture(scope="module")
def run(soft, tmp_path_factory):
    """A fit to them that is not told the gains."""
    settings = FitSettings(
        task=BENCH, data=[str(path) for path in soft], unknown=["stiffness", "damping"], optimizer="least_squares",
        check_consistency=False, log_dir=str(tmp_path_factory.mktemp("logs")),
    )  # fmt: skip
    return fit(settings)


@pytest.mark.slow
def test_unknown_gains_are_identified_as_factors_of_what_is_stated(run):
    result, _ = run
    assert result.effects == ["proportional_gain", "derivative_gain"]
    assert result.parameters["proportional_gain.gain"]["servo"] == pytest.approx(2.0, rel=0.02)
    assert result.parameters["derivative_gain.gain"]["servo"] == pytest.approx(2.0, rel=0.1)


def test_a_run_knows_what_was_unknown_and_a_drive_has_what_was_found(run):
    result, folder = run
    problem = open_problem(folder)
    assert problem.unknown == ("stiffness", "damping") and problem.effects == result.effects
    drive = PaceDCMotorCfg.from_result(folder, stiffness=20.0, damping=0.6)
    assert {cfg.effect_class.name for cfg in drive.effects} == {"proportional_gain", "derivative_gain"}


def test_the_drives_of_a_run_ask_with_the_gains_that_were_found(run):
    """drives.json states what was asked of each drive: with the assumed gains, half of it."""
    result, folder = run
    problem = open_problem(folder)
    asked = [each["joints"]["servo"]["asked_peak"] for each in json.loads((folder / "drives.json").read_text())]
    stated = drive_loads(problem, problem.evaluator(), np.array([result.parameters["encoder_bias"]["servo"]]))
    for peak, each in zip(asked, stated, strict=True):
        assert peak == pytest.approx(2.0 * each["joints"]["servo"]["asked_peak"], rel=0.1)


def test_the_gains_themselves_are_told_where_they_are_one_set(run, soft):
    result, folder = run
    problem = open_problem(folder)
    assert not any("found:" in note for note in result.notes)  # recordings state two sets

    def told(recordings, undetermined=()):
        return identified_gains(
            problem.env_cfg, recordings, problem.unknown, result.parameters, undetermined, result.unit_of
        )

    assert told(problem.dataset.recordings) == []
    stiffness, damping = told(problem.dataset.recordings[:1])
    assert float(stiffness.split()[2]) == pytest.approx(40.0, rel=0.02) and stiffness.endswith("N m/rad (servo)")
    assert float(damping.split()[2]) == pytest.approx(1.2, rel=0.1) and damping.endswith("N m s/rad (servo)")
    assert told(problem.dataset.recordings[:1], ["proportional_gain.gain/servo"]) == [damping]


@pytest.mark.slow
def test_a_stiffness_that_the_recordings_do_not_determine_is_listed(tmp_path):
    weightless = Bench(load_mass=1e-6, stated={"stiffness": 40.0, "damping": 1.0})
    path = record(tmp_path / "free.csv", weightless, position=chirp(1.0))
    settings = FitSettings(
        task=BENCH, data=[str(path)], unknown=["stiffness"], optimizer="least_squares", check_consistency=False,
        log_dir=str(tmp_path),
    )  # fmt: skip
    result, _ = fit(settings)
    assert "proportional_gain.gain/servo" in result.undetermined
    assert result.parameters["proportional_gain.gain"]["servo"] == 1.0


def test_an_unknown_limit_is_sought_about_the_stated_one_which_no_longer_acts(tmp_path):
    stated = {"effort_limit": 6.0, "saturation_effort": 12.0, "velocity_limit": 8.0}
    path = record(tmp_path / "weak.csv", Bench(stated=stated), position=chirp(1.0))
    problem = load_problem(BENCH, data=[path], unknown=["effort_limit", "saturation_effort"])
    space = problem.space
    for label, low, high in (
        ("torque_limit.effort", 0.6, 60), ("torque_speed_limit.effort", 1.2, 120), ("torque_speed_limit.velocity", 8, 8)
    ):  # fmt: skip
        assert (float(space.lower[space[label]]), float(space.upper[space[label]])) == pytest.approx((low, high))
    env = problem.make_env(1)
    problem.training_evaluator().residuals(space.to_physical(space.start)[None])
    (drive,) = env.scene["robot"].actuators.values()
    assert drive.effort_limit.isinf().all()
    env.close()


def test_an_unknown_limit_is_sought_in_a_log_whose_samples_lie_beside_the_grid(tmp_path):
    time = np.arange(400) / 187
    recording = Recording(
        name="r", joint_names=("servo",), time=time, dof_pos=0.3 * np.sin(5 * time)[:, None],
        des_dof_pos=0.4 * np.sin(5 * time)[:, None], des_dof_vel=2.0 * np.cos(5 * time)[:, None],
        drive=Drive(stiffness=np.array([40.0]), damping=np.array([1.0]), effort_limit=np.array([10.0])),
    )  # fmt: skip
    path = save_recording(tmp_path / "r.npz", recording)
    problem = load_problem(BENCH, data=[path], unknown=["effort_limit"], tell=lambda _: None)
    assert problem.dataset.recordings[0].sample_at is not None
    where = problem.space["torque_limit.effort"]
    start = problem.space.to_physical(problem.space.start)[where]
    assert float(start) == pytest.approx(0.7 * np.hypot(4.0, 0.5), rel=0.05)


def test_an_unknown_limit_of_a_torque_log_is_sought_about_the_torques_that_were_commanded(tmp_path):
    time = np.arange(400) * 0.0025
    recording = Recording(
        name="r", joint_names=("servo",), time=time, dof_pos=3.0 * np.sin(5 * time)[:, None],
        des_dof_effort=np.sin(9 * time)[:, None], drive=Drive(effort_limit=np.array([2.0])),
    )  # fmt: skip
    path = save_recording(tmp_path / "r.npz", recording)
    problem = load_problem(BENCH, data=[path], unknown=["effort_limit"], tell=lambda _: None)
    start = problem.space.to_physical(problem.space.start)[problem.space["torque_limit.effort"]]
    assert float(start) == pytest.approx(0.7, rel=0.05)


def test_loops_that_do_not_act_ask_for_nothing():
    time = np.arange(400) * 0.0025
    torque, position = np.sin(9 * time)[:, None], 0.3 * np.sin(5 * time)[:, None]
    configured = dict.fromkeys(DRIVE_FIELDS, np.array([40.0]))
    effort = Recording(name="r", joint_names=("j",), time=time, dof_pos=position, des_dof_effort=torque)
    effort = conform_recording(effort, joint_order=("j",), control_dt=0.0025)
    assert np.array_equal(asked_torque(in_force(configured, effort), effort), torque)
    braked = replace(effort, drive=Drive(damping=np.array([2.0])))
    speed = np.gradient(position, time, axis=0)
    assert asked_torque(in_force(configured, braked), braked, speed) == pytest.approx(torque - 2.0 * speed)
    driven = replace(effort, des_dof_pos=position, command=position + 0.1)
    asked = asked_torque(in_force(configured, driven), driven, speed, clip=False)
    assert asked == pytest.approx(40 * 0.1 - 40 * speed + torque)


@pytest.mark.slow
def test_a_limit_that_was_found_is_that_of_the_drive(tmp_path):
    path = record(tmp_path / "weak.csv", Bench(current_limit=8.0, stated={"effort_limit": 20.0}), position=chirp(1.0))
    settings = FitSettings(
        task=BENCH, data=[str(path)], unknown=["effort_limit"],
        check_consistency=False, log_dir=str(tmp_path),
    )  # fmt: skip
    result, folder = fit(settings)
    assert result.drive["effort_limit"]["servo"] == result.parameters["torque_limit.effort"]["servo"]
    assert result.drive["effort_limit"]["servo"] == pytest.approx(8.0, rel=0.02)
    assert PaceDCMotorCfg.from_result(folder).effort_limit == result.drive["effort_limit"]["servo"]


def test_what_the_torque_says_is_refined(tmp_path, soft):
    path = tmp_path / "log.csv"
    rows = np.genfromtxt(soft[0], delimiter=",", names=True)
    time, q, target = (rows[name] for name in rows.dtype.names)
    torque = 40.0 * (np.roll(target, 2) - q) - 1.2 * np.gradient(q, time)
    header = "time,dof_pos/servo,des_dof_pos/servo,dof_effort/servo"
    np.savetxt(path, np.column_stack([time, q, target, torque]), "%.7f", ",", header=header, comments="")
    path.with_suffix(".json").write_text(soft[0].with_suffix(".json").read_text())
    problem = load_problem(BENCH, data=[path], unknown=["stiffness"])
    assert problem.unknown == ("stiffness",) and problem.effects == ["proportional_gain"]
    assert problem.dataset.recordings[0].drive.stiffness[0] == pytest.approx(40.0, rel=0.02)
    both = load_problem(BENCH, data=[path, soft[1]], unknown=["stiffness"])  # one has no torque
    assert both.unknown == ("stiffness",) and both.effects == ["proportional_gain"]
    assert (
        both.dataset.recordings[0].drive.stiffness[0]
        == json.loads(soft[0].with_suffix(".json").read_text())["stiffness"]
    )


def test_a_refit_of_a_diagnosis_starts_unknown_facts_where_the_run_had_them():
    run = {"friction": {"j": 0.1}, "proportional_gain.gain": {"j": 2.0}, "torque_limit.effort": {"j": 8.0}}
    found = {"friction": {"j": 0.2}, "torque_gain.gain": {"j": 0.5}, "torque_limit.effort": {"j": 7.0}}
    assert started_from(found, run, ["stiffness", "effort_limit"]) == {**found, "proportional_gain.gain": {"j": 2.0}}
    assert started_from(found, run, []) == found
    more = started_from({"proportional_gain.gain": {"j": 1.1}}, run, ["stiffness"])
    assert more["proportional_gain.gain"]["j"] == pytest.approx(2.2)  # of the gain that the run had


def test_a_diagnosis_begins_with_the_gains_that_were_found(run):
    """The base model is as good with them as the fit was; with the stated ones it is not."""
    result, folder = run
    stated = open_problem(folder, effects=())
    found = stated.as_found(result.parameters, result.undetermined)
    for before, now in zip(stated.dataset.recordings, found.dataset.recordings, strict=True):
        gain = result.parameters["proportional_gain.gain"]["servo"]
        assert now.drive.stiffness[0] == pytest.approx(gain * before.drive.stiffness[0])
    values = stated.space.from_dict({name: result.parameters[name] for name in stated.space.slices})[None]
    wrong, right = (float(p.training_evaluator().residuals(values).score.sqrt()) for p in (stated, found))
    assert right == pytest.approx(result.rmse["train"]["all"], rel=0.02) and wrong > 10 * right
    some = with_identified(
        stated.plain_cfg, stated.dataset.recordings, stated.unknown, result.parameters, ["derivative_gain.gain/servo"]
    )
    assert some[0].drive.damping[0] == stated.dataset.recordings[0].drive.damping[0]  # not determined: as stated


def test_an_effect_that_is_named_too_is_there_once(soft):
    problem = load_problem(BENCH, data=soft[:1], unknown=["stiffness"], effects=["proportional_gain", "torque_offset"])
    assert problem.effects == ["proportional_gain", "torque_offset"]


def test_a_fact_that_cannot_be_unknown_is_refused():
    with pytest.raises(ValueError, match=r"--unknown kp is not understood\. Available: stiffness, damping"):
        FitSettings(task=BENCH, unknown=["kp"])
    with pytest.raises(ValueError, match="--unknown"):
        replace(FitSettings(task=BENCH), unknown=["mass"])
