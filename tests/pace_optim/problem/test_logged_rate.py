"""The control step of a model file is that of the log's commands, where they come faster than 400 Hz."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from models import HEAD, KD, KP, MOTORS

from pace_optim.identification.fit import fit
from pace_optim.recording import Drive, Recording, conform_recording, save_recording
from pace_optim.recording.commands import command_interval, command_timing
from pace_optim.recording.torque.law import read_law
from pace_optim.run.open import open_problem, problem_of
from pace_optim.run.settings import FitSettings


def recorded(robot, name, seconds=1.5, dt=0.001):
    """Plain MuJoCo's motion under motors whose loop runs at this step."""
    model = mujoco.MjModel.from_xml_path(str(robot))
    model.dof_damping[:], model.opt.timestep = 0.05, dt / 10
    data, time = mujoco.MjData(model), np.arange(round(seconds / dt)) * dt
    target = np.stack([0.5 * np.sin(9 * time), 0.3 * np.sin(14 * time)], axis=1)
    read = np.zeros_like(target)
    for k, wanted in enumerate(target):
        read[k] = data.qpos
        data.ctrl[:] = np.clip(KP * (wanted - data.qpos) - KD * data.qvel, -1.5, 1.5)
        mujoco.mj_step(model, data, 10)
    read += 1e-5 * np.random.default_rng(0).standard_normal(read.shape)
    drive = Drive(stiffness=KP, damping=KD)
    recording = Recording(
        name=name, joint_names=("pan", "tilt"), time=time, dof_pos=read, des_dof_pos=target, drive=drive
    )
    return str(save_recording(robot.parent / f"{name}.npz", recording))


@pytest.mark.parametrize(
    ("repeat", "own_clock", "interval"), [(1, False, 0.001), (10, False, 0.01), (1, True, 0.001), (3, False, 0.003)]
)
def test_a_command_that_is_repeated_is_none(repeat, own_clock, interval):
    time = np.arange(2000) * 0.001 + 7.0 + 1e-7 * np.random.default_rng(0).standard_normal(2000)
    held = np.repeat(np.sin(np.arange(2000 // repeat + 1)), repeat)[:2000, None]
    clock = {"time": time, "dof_pos": held}
    if own_clock:
        clock = {"des_time": time, "time": time[::4], "dof_pos": held[::4]}
    recording = Recording(name="r", joint_names=("j",), des_dof_pos=held, **clock)
    assert command_interval(recording) == pytest.approx(interval, rel=1e-9)


def test_rounded_targets_on_one_clock_have_the_clocks_interval():
    des_time = 0.01 * np.arange(2000)
    smooth = 0.2 * np.sin(np.outer(des_time, [0.7, 0.9, 0.8]) + [0, 1, 2])
    rounded = np.round(smooth / 0.003) * 0.003  # each changes in less than half of the ticks
    recording = Recording(
        name="r", joint_names=("a", "b", "c"), time=des_time + 0.003, dof_pos=smooth, des_time=des_time,
        des_dof_pos=rounded,
    )  # fmt: skip
    assert command_interval(recording) == pytest.approx(0.01)


def test_two_topics_of_two_joints_each_have_the_interval_of_one_topic():
    des_time = np.sort(np.concatenate([0.01 * np.arange(400), 0.01 * np.arange(400) + 0.003]))
    first, second = 0.01 * np.floor(des_time / 0.01 + 1e-6), 0.01 * np.floor((des_time + 0.007) / 0.01 + 1e-6)
    target = np.sin(np.stack([first, first + 1, second, second + 1], axis=1))
    recording = Recording(
        name="r", joint_names=tuple("abcd"), time=np.arange(400) * 0.01, dof_pos=np.zeros((400, 4)),
        des_time=des_time, des_dof_pos=target,
    )  # fmt: skip
    assert command_interval(recording) == pytest.approx(0.01)


def test_joints_whose_clocks_are_shifted_have_the_interval_of_one_joint():
    des_time = np.sort(np.concatenate([0.01 * np.arange(200), 0.01 * np.arange(200) + 0.0005]))
    first, second = 0.01 * (des_time // 0.01), 0.01 * ((des_time + 0.0095) // 0.01)
    time = np.arange(400) * 0.005
    recording = Recording(
        name="r", joint_names=("a", "b"), time=time, dof_pos=np.zeros((400, 2)), des_time=des_time,
        des_dof_pos=np.sin(np.stack([first, second], axis=1)),
    )  # fmt: skip
    assert command_interval(recording) == pytest.approx(0.01)


def test_a_log_with_one_command_has_the_interval_of_its_samples():
    time = np.arange(400) * 0.005
    recording = Recording(
        name="r", joint_names=("a",), time=time, dof_pos=0.3 * np.exp(-time)[:, None], des_time=time[:1],
        des_dof_pos=np.zeros((1, 1)), dof_effort=np.sin(9 * time)[:, None],
    )  # fmt: skip
    conformed = conform_recording(recording, joint_order=("a",), control_dt=0.005)
    assert conformed.command_dt == pytest.approx(0.005) and np.all(conformed.command == 0.0)
    read_law(conformed, 0, 2.0)


def test_jitter_and_lost_commands_are_those_of_the_stamps():
    rng, ticks = np.random.default_rng(0), np.flatnonzero(np.random.default_rng(1).random(4000) > 0.03)
    late = rng.triangular(0.0, 0.0, 0.006, len(ticks))
    stamps = 5.0 + 0.02003 * ticks + late
    time = np.arange(0.0, 85.0, 0.05)
    recording = Recording(
        name="r", joint_names=("j",), time=time, dof_pos=np.zeros((len(time), 1)), des_time=stamps,
        des_dof_pos=np.sin(stamps)[:, None],
    )  # fmt: skip
    timing = command_timing([recording])
    low, high = np.quantile(late - late.mean(), (0.05, 0.95))
    assert timing.interval_s == pytest.approx(0.02003, rel=1e-5)
    assert (-timing.early_s, timing.late_s) == pytest.approx((low, high), abs=2e-5)
    assert timing.lost == pytest.approx(1 - len(ticks) / (ticks[-1] - ticks[0] + 1))
    assert command_timing([replace(recording, des_time=None)]) is None
    assert command_timing([replace(recording, des_time=np.sort(rng.uniform(5.0, 85.0, len(ticks))))]) is None


def test_commands_for_each_control_step_need_no_clock():
    time, held = np.arange(500) * 0.004, np.sin(np.arange(1997.0))[:, None]
    recording = Recording(name="r", joint_names=("j",), time=time, dof_pos=held[::4], des_dof_pos=held)
    assert command_interval(recording) == pytest.approx(0.001)


@pytest.mark.slow
def test_a_fit_takes_the_rate_of_the_logs_commands_and_its_run_keeps_it(tmp_path):
    robot = tmp_path / "head.xml"
    robot.write_text(HEAD.format(MOTORS))
    fast, slow = recorded(robot, "fast"), recorded(robot, "slow", dt=0.0025)

    told = {"task": str(robot), "data": [fast], "optimizer": "least_squares", "log_dir": str(tmp_path / "logs")}
    result, run = fit(FitSettings(check_consistency=False, **told))
    assert result.control_dt == 0.001 and any(note.startswith("control rate: 1000 Hz") for note in result.notes)
    assert result.parameters["viscous_friction"]["pan"] == pytest.approx(0.05, rel=0.01)
    assert open_problem(run, data=[slow]).control_dt == 0.001  # whatever is held against it
    assert FitSettings.load(run / "settings.json")[0].control_dt == 0.001  # what processes that help are given
    assert problem_of(FitSettings(control_dt=0.0025, **told)).control_dt == 0.0025
