"""A fit that ends far above the noise says so, and what recordings do not determine keeps its prior."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from diagnoses import joint_alone
from problems import BENCH, CALM, TRUTH, chirp, env_cfg, make_problem, physical, record, replayed
from run_folders import make_result

from pace_actuators import IdentifiedDrives
from pace_optim.comparison.drive_loads import drive_loads
from pace_optim.estimate.error_bars.far_from_noise import far_end, times_noise
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.error_bars.undetermined import (
    DELAY,
    at_prior,
    held_at_prior,
    prior,
    undetermined,
    without_delay,
)
from pace_optim.estimate.error_bars.warnings import fit_warnings
from pace_optim.estimate.least_squares import LeastSquaresCfg
from pace_optim.export import FORMATS
from pace_optim.identification.fit import fit
from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive, save_recording
from pace_optim.run.settings import FitSettings
from pace_optim.run.summary import summary


def uncertainty(problem, **changes):
    size = problem.space.size
    content = {
        "std": np.zeros(size),
        "correlation": np.eye(size),
        "at_bound": (),
        "no_influence": (),
        "indistinguishable": (),
    }
    return Uncertainty(**{**content, **changes})


def test_the_end_is_told_as_a_multiple_of_the_noise_with_what_to_do():
    (told,) = far_end(370.0, 37e-3, "least_squares")
    assert "370 times the measurement noise" in told
    assert "--optimizer hybrid" in told and "error bars mean nothing" in told
    assert "First check gains, torque limits and loads." in told
    assert far_end(2.0, 1e-4, "least_squares") == far_end(None, 1e-4, "hybrid") == []


def test_the_noise_is_that_of_the_recordings():
    recording = replayed(chirp(3.0), CALM, env_cfg())
    noisy = replace(
        recording, dof_pos=recording.dof_pos + np.random.default_rng(0).normal(0, 1e-3, (len(recording.time), 1))
    )
    assert times_noise(make_problem(noisy), 5e-3) == pytest.approx(5.0, rel=0.15)


def test_what_has_no_influence_or_an_error_bar_as_wide_as_its_bounds_is_open_unless_error_bars_mean_nothing():
    problem = joint_alone().problem
    std = np.zeros(problem.space.size)
    std[problem.space["encoder_bias"]] = 10.0
    found, start = uncertainty(problem, std=std, no_influence=("delay/all",)), problem.space.start
    assert undetermined(problem, start, found) == ["encoder_bias/servo", "delay/all"]
    assert undetermined(problem, start, found, far=True) == ["delay/all"]


def test_a_bias_that_others_make_up_for_exactly_is_a_choice_of_origin():
    problem = joint_alone().problem
    group = ("encoder_bias/servo", "torque_ripple.sine/servo")
    assert undetermined(problem, problem.space.start, uncertainty(problem, indistinguishable=(group,))) == []
    exact = uncertainty(problem, indistinguishable=(group,), combinations=(group,))
    assert undetermined(problem, problem.space.start, exact) == ["encoder_bias/servo"]


def test_an_inertia_or_a_friction_that_is_told_neither_from_none_nor_from_its_prior_is_open():
    """By noise and the physics step together; a bias or a delay of 0 is a value like others."""
    problem = joint_alone().problem
    space = problem.space
    own = prior(problem)
    values = {
        **dict(zip(space.labels, own.tolist(), strict=True)),
        "armature/servo": 0.1,
        "viscous_friction/servo": 0.3,
        "friction/servo": 0.2,
    }
    x = space.to_normalised(torch.tensor([values[label] for label in space.labels], dtype=torch.float64))

    def open_(step=None, **std):
        bars = np.array([std.get(label.split("/")[0], 1e-3) for label in space.labels])
        share = np.where([step is not None and label.startswith(step) for label in space.labels], -0.3, 0.0)
        return undetermined(problem, x, uncertainty(problem, std=bars).with_step(share))

    assert open_() == [] and open_(friction=0.05) == []
    assert open_(friction=0.15) == ["friction/servo"]
    assert open_(step="viscous") == ["viscous_friction/servo"]
    assert open_(friction=np.nan) == []  # at its bound


def test_the_prior_is_the_configuration_s_value_else_zero():
    problem = joint_alone().problem
    for drive in problem.env_cfg.scene.robot.actuators.values():
        expected = 0.0 if drive.armature is None else float(drive.armature)
    assert float(prior(problem)[problem.space["armature"]]) == expected
    x = at_prior(problem, torch.full((problem.space.size,), 0.7, dtype=torch.float64), ["encoder_bias/servo"])
    assert float(problem.space.to_physical(x)[problem.space["encoder_bias"]]) == pytest.approx(0.0, abs=1e-9)
    assert float(x[0]) == 0.7


def test_the_rest_is_fitted_again_and_what_costs_too_much_at_its_prior_is_not_open():
    problem = joint_alone().problem
    x = problem.space.to_normalised(joint_alone().truth)
    cfg = LeastSquaresCfg(max_iteration=3)
    kept, labels = held_at_prior(problem, x, uncertainty(problem), ["friction/servo"], cfg)
    assert labels == [] and torch.equal(kept, x)  # no friction at all is no solution
    kept, labels = held_at_prior(
        problem, x, uncertainty(problem, no_influence=("friction/servo",)), ["friction/servo"], None
    )
    assert labels == [] and torch.equal(kept, x)  # an oscillation hid what it does


def test_warnings_are_one_for_each_kind_and_what_does_not_carry_over_comes_first():
    problem = make_problem(record(chirp(0.2), TRUTH))
    rmse = {"train": {"all": 1e-3}, "validation": {"all": 59e-3}}
    found = uncertainty(
        problem,
        at_bound=("friction/servo",),
        indistinguishable=(("encoder_bias/servo", "friction/servo"), ("encoder_bias/servo", "friction/servo")),
    )
    told = fit_warnings(problem, physical(problem, TRUTH), found, rmse, ["delay/all"], ["friction/servo"])
    assert "59.0 times" in told[0] and told[1].startswith("At a bound: friction (")
    assert told[2].startswith("These recordings do not show delay (kept at ")
    assert told[3].startswith("These recordings barely show friction of servo:")
    assert sum("cannot separate" in text for text in told) == 1


def test_exports_and_training_leave_out_what_is_not_determined(tmp_path):
    result = make_result(undetermined=["encoder_bias/hip", "armature/hip", "armature/knee", "armature/ankle"])
    result.save(tmp_path / "result.json")
    drives = IdentifiedDrives.load(tmp_path)
    content = json.loads(FORMATS["json"](drives)[0])
    assert content["parameters"]["armature"] == {} and set(content["parameters"]["encoder_bias"]) == {"knee", "ankle"}
    fields = drives.cfg_fields()
    assert "armature" not in fields and "friction" in fields


@pytest.mark.slow
def test_least_squares_in_a_wrong_valley_is_not_converged(tmp_path):
    """The recording's drive has half the gain that it states: no base model explains it."""
    told = record(chirp(1.0), CALM, drive={"stiffness": 170.0}, noise=1e-4)
    wrong = replace(told, drive=replace(told.drive, stiffness=np.array([85.0])))
    path = save_recording(tmp_path / "wrong.npz", wrong)
    settings = FitSettings(task=BENCH, data=[str(path)], optimizer="least_squares", log_dir=str(tmp_path / "logs"))
    result, _ = fit(settings)
    assert result.times_noise > 10 and result.std_means_nothing
    assert all(std is None for each in result.std.values() for std in each.values()) and not result.step_error
    assert all(entry is None for row in result.correlation["matrix"] for entry in row)
    assert "converged" not in result.stop_reasons and "times the measurement noise" in result.stop_reasons[-1]
    assert "times the measurement noise" in result.warnings[0]
    assert "± ?" in "\n".join(summary(result))


def test_what_is_asked_of_a_drive_and_what_gravity_takes_are_told():
    recording = record(chirp(1.0), CALM)
    problem = make_problem(recording)
    (told,) = drive_loads(problem, problem.evaluator(), np.zeros(1))
    servo = told["joints"]["servo"]
    kp, kd = servo["stiffness"], servo["damping"]
    speed = np.gradient(recording.dof_pos[:, 0], recording.time)
    offset = (problem.dataset.recordings[0].command - problem.dataset.recordings[0].dof_pos)[:, 0]
    assert servo["asked_peak"] == pytest.approx(np.abs(kp * offset - kd * speed).max(), rel=0.05)
    largest = np.abs(np.sin(recording.dof_pos)).max()
    assert servo["gravity_peak"] == pytest.approx(9.81 * 0.2 * largest, rel=0.02)
    assert servo["asked_rms"] < servo["asked_peak"] and servo["speed_peak"] == pytest.approx(
        np.abs(speed).max(), rel=0.1
    )


@pytest.mark.slow
def test_a_delay_that_is_not_told_from_none_is_none():
    """Beside large gains it would take damping and inertia along."""

    def ended(true, found, std):
        recording = record(chirp(1.0), {**TRUTH, "delay": true})
        noise = np.random.default_rng(0).normal(0, 1e-4, recording.dof_pos.shape)
        problem = make_problem(replace(recording, dof_pos=recording.dof_pos + noise))
        x = problem.space.to_normalised(physical(problem, {**TRUTH, "delay": found}))
        bars = np.where([label == DELAY for label in problem.space.labels], std, 0.0)
        return problem, x, uncertainty(problem, std=bars)

    near = LeastSquaresCfg(score_tolerance=0.02)
    problem, x, unsure = ended(0.0, 0.003, 0.002)
    none = without_delay(problem, x, unsure, [], near)
    assert float(problem.space.to_physical(none)[problem.space["delay"]]) == 0.0
    assert without_delay(problem, x, unsure, [DELAY], near) is None
    assert without_delay(*ended(0.0, 0.003, 0.001), [], near) is None
    assert without_delay(*ended(1.0, 1.0, 2.0), [], near) is None  # where none costs much


def test_a_limit_that_the_recording_contradicts_is_the_first_warning(tmp_path):
    slow = replace(record(chirp(1.0), TRUTH), drive=Drive(velocity_limit=np.array([0.1])))
    problem = load_problem(BENCH, data=[save_recording(tmp_path / "fast.npz", slow)])
    (told,) = problem.contradictions
    assert "Correct velocity_limit" in told
    rmse = {"train": {"all": 1e-3}, "validation": {"all": 1e-2}}
    warnings = fit_warnings(problem, physical(problem, TRUTH), uncertainty(problem), rmse)
    assert warnings[0] == told and len(warnings) > 1


def test_effects_have_a_line_for_each_joint_below_the_table():
    plain = make_result()
    one, *others = plain.joint_names
    curve = {f"torque_over_position.effort_{i}": {others[0]: 0.1} for i in range(17)}
    more = {"stribeck_friction.effort": {one: 1.5}, "proportional_gain.gain": {one: 0.9}, **curve}
    units = {**plain.units, **dict.fromkeys(more, "N m"), "proportional_gain.gain": "1"}
    std = {**plain.std, **{name: dict.fromkeys(values, 0.1) for name, values in more.items()}}
    lines = summary(make_result(parameters={**plain.parameters, **more}, std=std, units=units, effects=[]))
    named = [line.split() for line in lines if line.startswith(("stribeck", "proportional", "torque_over"))]
    assert named == [
        ["stribeck_friction", one, "effort", "1.5", "±", "0.1", "N", "m"],
        ["proportional_gain", one, "gain", "0.9", "±", "0.1"],
        ["torque_over_position", others[0], *["17", "values:", "see", "the", "report"]],
    ]
    assert "stribeck" not in lines[0]
