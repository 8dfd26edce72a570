"""The converter of real recordings: facts by their formulas, joints by their names, and a fit where the files are."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import real_recordings
import real_robots
import static_sag
import torch

from pace_envs import load_env_cfg
from pace_optim.problem.problem import load_problem
from pace_optim.recording import Recording, load_recording, save_recording
from pace_optim.terminal.cli import run_cli

needs_measurements = pytest.mark.skipif(
    not real_recordings.SOURCE.is_dir(), reason=f"the real recordings are not at {real_recordings.SOURCE}"
)


def made_up(name: str, joints: tuple[str, ...] = ("servo",)) -> Recording:
    time = np.linspace(0, 2, 101)
    position = 0.4 + 0.1 * np.sin(time)[:, None] * np.ones(len(joints))
    return Recording(name=name, joint_names=joints, time=time, dof_pos=position, des_dof_pos=position + 0.01)


def command(monkeypatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["real_recordings.py", *map(str, words)])
    return run_cli(real_recordings.main)


def test_the_firmware_gain_of_a_dynamixel_becomes_si_units():
    drive = real_robots.ROBOTS["xl330"].convert(made_up("kp400_sin_sin")).drive
    kt, ohms, volts = 0.387, 4.02, 7.4
    assert drive.stiffness[0] == pytest.approx(400 * 4096 / (2 * np.pi) / (256 * 885) * volts * kt / ohms)
    assert drive.damping[0] == pytest.approx(kt**2 / ohms)
    assert drive.velocity_limit[0] == pytest.approx(volts / kt)
    assert drive.effort_limit[0] == pytest.approx(2 * drive.saturation_effort[0])


def test_a_name_without_a_gain_is_refused():
    with pytest.raises(ValueError, match="says no firmware gain, expected one like kp400_sin_sin"):
        real_robots.ROBOTS["xl330"].convert(made_up("sin_sin"))


def test_the_arms_joints_get_the_models_names_and_the_jaw_becomes_an_angle():
    given = made_up("multisine", real_robots.SO101_NAMES)
    arm = real_robots.ROBOTS["so101"].convert(given)
    assert arm.joint_names == tuple(load_env_cfg("Pace-SO101-v0").sim2real.joint_order)
    assert np.array_equal(arm.dof_pos[:, :5], given.dof_pos[:, :5])
    counts = (arm.dof_pos[:, 5] + 0.174533) * 4096 / (2 * np.pi)
    np.testing.assert_allclose(counts, 1523.2 * given.dof_pos[:, 5])
    with pytest.raises(ValueError, match="found the joints servo; expected Rotation, Pitch"):
        real_robots.ROBOTS["so101"].convert(made_up("multisine"))


def test_a_part_begins_at_zero_and_one_that_is_not_there_is_refused():
    part = real_robots.cut(made_up("r"), 0.5, 1.0)
    assert part.time[0] == 0 and part.duration == pytest.approx(0.5)
    with pytest.raises(ValueError, match="has no samples from 3 to 4 s; it lasts 2 s"):
        real_robots.cut(made_up("r"), 3.0, 4.0)


def test_training_and_validation_share_no_file():
    for robot in real_robots.ROBOTS.values():
        assert not set(robot.train) & set(robot.validation)
        assert set(robot.windows) <= {*robot.train, *robot.validation}


def test_missing_recordings_are_one_clear_message(monkeypatch, tmp_path, capsys):
    assert command(monkeypatch, "fit", "xl330", "--source", tmp_path, "--log_dir", tmp_path) == 2
    assert "are not part of this project" in capsys.readouterr().err
    assert command(monkeypatch, "convert", "xl430") == 2
    assert "Unknown robot 'xl430'. Available: xl330" in capsys.readouterr().err


def test_what_is_converted_keeps_its_licence(monkeypatch, tmp_path):
    source = tmp_path / "source" / "xl330"
    save_recording(source / "kp400_sin_sin.csv", made_up("kp400_sin_sin"))
    (source / "LICENSE").write_text("theirs")
    output = tmp_path / "output"
    assert command(monkeypatch, "convert", "xl330", "--source", source.parent, "--output", output) == 0
    assert (output / "xl330" / "LICENSE").read_text() == "theirs"
    assert load_recording(output / "xl330" / "kp400_sin_sin.csv").load.load_mass == 0.49


def test_errors_are_told_by_recording_and_joint():
    joints = ["servo"]
    content = {"joint_names": joints, "recordings": []}
    for name, error, train in (("a", 0.003, True), ("b", 0.004, False)):
        measured = torch.zeros(5, 1)
        record = {"name": name, "dof_pos": measured, "sim_dof_pos": measured + error, "train": torch.full((5,), train)}
        content["recordings"].append(record)

    rmse = {"train": {"servo": 0.003, "all": 0.003}, "validation": {"servo": 0.004, "all": 0.004}}
    lines = real_recordings.errors_table(content, SimpleNamespace(rmse=rmse)).splitlines()
    assert lines[1].split() == ["a", "(train)", "3.00", "3.00"]
    assert lines[2].split() == ["b", "(held", "out)", "4.00", "4.00"]


@needs_measurements
@pytest.mark.parametrize("name", real_robots.ROBOTS)
def test_converted_recordings_fit_their_robot(name, tmp_path):
    robot = real_robots.ROBOTS[name]
    paths = {path.stem: path for path in real_robots.convert_robot(robot, real_recordings.SOURCE, tmp_path)}
    assert {*robot.train, *robot.validation} <= set(paths)
    problem = load_problem(
        robot.task,
        data=[paths[stem] for stem in robot.train],
        validation=[paths[stem] for stem in robot.validation],
    )
    assert problem.dataset.num_recordings == len(robot.train) + len(robot.validation)


@needs_measurements
def test_only_the_models_signs_give_every_servo_of_the_arm_a_positive_and_alike_stiffness():
    sags = static_sag.static_sag(real_recordings.SOURCE / "so101" / "friction_gravity.npz")
    carrying = [sag for sag in sags if sag.joint in static_sag.WEIGHT_JOINTS]
    possible = [s for s in carrying[0].gravity if all(-sag.gravity[s] / sag.lean > 0 for sag in carrying)]
    assert possible == [(1, 1, 1)]
    stiffness = [-sag.gravity[1, 1, 1] / sag.lean for sag in carrying]
    assert max(stiffness) / min(stiffness) < 1.25
    assert np.mean(stiffness) == pytest.approx(real_robots.SO101_STIFFNESS, rel=0.1)


def test_lean_and_hysteresis_of_a_made_up_arm(tmp_path):
    time = np.linspace(0, 60, 3001)
    target = 0.2 * np.sin(0.4 * time)[:, None] * np.ones(6)
    late = 0.2 * np.sin(0.4 * (time - 0.1))[:, None] * np.ones(6)
    position = late + 0.03 - 0.01 * np.sign(np.cos(0.4 * time))[:, None]
    recording = replace(made_up("r", real_robots.SO101_NAMES), time=time, dof_pos=position, des_dof_pos=target)
    path = save_recording(tmp_path / "r.npz", recording)
    for sag in static_sag.static_sag(path):
        assert sag.lean == pytest.approx(-0.03, abs=1e-3) and sag.hysteresis == pytest.approx(0.01, abs=1e-3)
