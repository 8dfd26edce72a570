"""What drives are told: three kinds of commands, a clock of their own, absolute stamps and sessions."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from recordings import CONTROL_DT, JOINTS, conform, fields_of, position, recording, says, written

from pace_optim.recording import Recording, conform_recording, load_recording, save_recording
from pace_optim.recording.dataset import make_dataset
from pace_optim.recording.windows import Windows

POS = fields_of()["dof_pos"]
NAN = np.nan
DAY = 86400.0
NOON = 1_764_000_000.0


def held(stamps, values, at):
    """What is commanded at instants: the last value issued."""
    return values[np.searchsorted(stamps, at, side="right") - 1]


def own_clock(**changes) -> Recording:
    """States at 100 Hz, commands at 31 Hz."""
    time, des_time = 0.01 * np.arange(200), 0.0323 * np.arange(62)
    given = {"des_dof_pos": position(des_time), "des_dof_vel": 2.0 * position(des_time), "des_time": des_time}
    return replace(recording(time), **{**given, **changes})


@pytest.mark.parametrize("suffix", [".pt", ".npz", ".csv"])
def test_every_kind_of_command_survives_a_round_trip(tmp_path, suffix):
    saved = own_clock(des_dof_effort=position(own_clock().des_time) * [1, NAN, 1], time_origin=NOON)
    loaded = load_recording(save_recording(tmp_path / f"leg{suffix}", saved))
    for key in ("time", "des_time", "dof_pos", "des_dof_pos", "des_dof_vel", "des_dof_effort"):
        assert np.array_equal(getattr(saved, key), getattr(loaded, key), equal_nan=True), key
    assert loaded.time_origin == NOON
    assert loaded.has_effort_command.tolist() == [True, False, True]


def test_commands_of_another_clock_are_held_at_their_true_instants():
    raw = own_clock()
    conformed = conform(raw)
    assert conformed.sample_stride == 4 and np.array_equal(conformed.dof_pos, raw.dof_pos)
    steps = CONTROL_DT * np.arange(len(conformed.command))
    fine = np.linspace(0.0, CONTROL_DT, 2001)[:-1] + CONTROL_DT / 4000
    for key, values in (("command", raw.des_dof_pos), ("command_vel", raw.des_dof_vel)):
        expected = held(raw.des_time, values, steps[:, None] + fine).mean(axis=1)
        assert np.allclose(getattr(conformed, key), expected, atol=1e-3)
    assert conformed.command_effort is None


def test_a_recording_with_a_second_clock_can_be_saved_once_conformed(tmp_path):
    conformed = conform(own_clock())
    again = conform(load_recording(save_recording(tmp_path / "leg.npz", conformed)))
    for key in ("time", "des_time", "command", "command_vel", "dof_pos"):
        assert np.array_equal(getattr(conformed, key), getattr(again, key)), key


def test_commands_follow_the_drift_of_the_clock_that_samples_are_kept_on():
    time = 0.01 * np.arange(1000) * (1 + 4e-5)
    conformed = conform(recording(time, des_time=time + 0.005, des_dof_pos=position(time)))
    assert not any("Resampled" in note for note in conformed.notes)
    assert conformed.sample_stride == 4
    changes = np.flatnonzero(np.diff(conformed.command[:, 0]))
    assert set(np.diff(changes)) <= {1, 3, 4} and np.all((changes + 1) % 4 <= 2)


def test_what_comes_before_the_first_command_is_left_out():
    raw = own_clock(des_time=0.3 + 0.01 * np.arange(62))
    conformed = conform(raw)
    assert np.array_equal(conformed.dof_pos[0], raw.dof_pos[30])
    assert np.array_equal(conformed.command[0], raw.des_dof_pos[0])
    assert conformed.start_stamp == pytest.approx(0.3)
    assert any("0.3 s were left out" in note for note in conformed.notes)
    with pytest.raises(ValueError, match=says("190 of 200 samples come before the first command")):
        conform(own_clock(des_time=1.9 + 0.01 * np.arange(62)))


def test_a_joint_without_position_commands_keeps_its_place_and_has_no_position_loop():
    time = CONTROL_DT * np.arange(400)
    raw = recording(time, des_dof_pos=position(time) * [1, NAN, NAN], des_dof_vel=position(time) * [NAN, 1, NAN],
                    des_dof_effort=position(time) * [NAN, NAN, 1], dof_vel=position(time) * [1, 1, NAN])  # fmt: skip
    conformed = conform(raw, joint_order=("ankle", "hip", "knee"))
    assert conformed.has_position_command.tolist() == [False, True, False]
    assert conformed.has_velocity_command.tolist() == [False, False, True]
    assert np.array_equal(conformed.command[:, 0], np.full(400, raw.dof_pos[0, 2]))
    assert np.array_equal(conformed.command_vel[:, 2], raw.des_dof_vel[:, 1])
    assert np.all(conformed.command_vel[:, :2] == 0.0) and np.all(conformed.command_effort[:, 1:] == 0.0)
    data = make_dataset([conformed, replace(conformed, command_effort=None)])
    assert torch.equal(data.command_effort[:, 1], torch.zeros(400, 3, dtype=torch.float64))
    assert torch.isfinite(data.measured_vel).all()
    slope = np.gradient(raw.dof_pos[:, 2], time)[0]  # it holds no speed
    assert float(data.start_vel[0, 0]) == pytest.approx(slope, rel=0.05) and data.start_vel[0, 1] == raw.dof_vel[0, 0]
    assert torch.equal(data.select([1]).command_vel, data.command_vel[:, [1]])
    assert torch.equal(data.on_joints([2]).command_vel, data.command_vel[..., [2]])
    windows = Windows.of(data, CONTROL_DT)
    assert windows.cut(data).command_vel.shape == windows.cut(data).command.shape


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"des_dof_pos": None, "stiffness": 20.0, "des_dof_vel": POS}, ["stiffness of 20", "des_dof_pos"]),
        ({"des_time": np.arange(90) * 0.0025}, ["des_dof_pos has shape (100, 3)", "des_time has 90"]),
        ({"des_time": np.zeros(100)}, ["des_time does not increase"]),
        ({"des_time": 50.0 + np.arange(100.0)}, ["des_time", "do not meet"]),
        ({"des_time": NOON + np.arange(100.0)}, ["des_time is Unix time", "one clock"]),
        ({"des_dof_vell": POS}, ["did you mean 'des_dof_vel'"]),
        ({"time": np.arange(100.0)}, ["steps by 1", "1 Hz in seconds", "1 kHz in milliseconds"]),
        ({"dof_pos": POS * 1e160}, ["dof_pos is", "e+159", "knee"]),
        ({"time_origin": "yesterday"}, ["time_origin", "'yesterday'"]),
        ({"time_origin": [1.0, 2.0]}, ["time_origin is [1.0, 2.0]"]),
        ({"time_origin": 3.0, "time": NOON + fields_of()["time"]}, ["time_origin", "Unix time already"]),
    ],
)  # fmt: skip
def test_each_fault_of_commands_has_its_message(tmp_path, changes, words):
    with pytest.raises(ValueError, match=says(*words)):
        load_recording(written(tmp_path, **changes))


@pytest.mark.parametrize(
    "stamps",
    [
        lambda t: NOON + t,
        lambda t: np.round((NOON + t) * 1e3, 1),
        lambda t: int(NOON) * 1_000_000_000 + np.round(t * 1e9).astype(np.int64),
        lambda t: int(NOON) * 1_000_000 + np.round(t * 1e6).astype(np.int64),
        lambda t: [str(np.datetime64(int(NOON * 1e9 + round(x * 1e9)), "ns")) + "+00:00" for x in t],
        lambda t: [str(np.datetime64(int((NOON + 5400) * 1e9 + round(x * 1e9)), "ns")) + "+01:30" for x in t],
        lambda t: [str(np.datetime64(int(NOON * 1e6 + round(x * 1e6)), "us")).replace("T", " ") for x in t],
    ],
    ids=["s", "ms", "ns", "us", "text", "text of another zone", "text with a blank"],
)
def test_absolute_stamps_of_any_kind_are_understood(tmp_path, stamps):
    time = CONTROL_DT * np.arange(40)
    columns = ["time", "dof_pos/hip", "des_dof_pos/hip"]
    rows = [f"{stamp},{0.1 * k},{0.1 * k}" for k, stamp in enumerate(list(stamps(time)))]
    (path := tmp_path / "leg.csv").write_text("\n".join([",".join(columns), *rows]))
    loaded = load_recording(path)
    assert np.allclose(loaded.time, time, atol=3e-5) and loaded.start_stamp == pytest.approx(NOON, abs=1e-3)
    assert conform_recording(loaded, joint_order=("hip",), control_dt=CONTROL_DT).start_stamp == loaded.start_stamp


def test_text_that_is_no_date_is_refused(tmp_path):
    (path := tmp_path / "leg.csv").write_text("time,dof_pos/a,des_dof_pos/a\n2026-11-41T10:00:00,1,1\n")
    with pytest.raises(ValueError, match=says("time", "2026-11-41T10:00:00")):
        load_recording(path)


def starts(*began, **facts):
    recordings = [conform(recording(EVEN + at, **facts)) for at in began]
    return make_dataset(recordings).session_start.tolist()


EVEN = CONTROL_DT * np.arange(400)
SPAN = EVEN[-1]


def test_stamps_place_recordings_in_their_session_whatever_their_order():
    assert starts(0.0, 0.0, 0.0) == pytest.approx([0.0, SPAN, 2 * SPAN])
    assert starts(40.0, 0.0, 20.0) == pytest.approx([40.0, 0.0, 20.0])
    assert starts(NOON + 30, NOON, NOON + 10) == pytest.approx([30.0, 0.0, 10.0])
    assert starts(3.1, 3.1) == pytest.approx([0.0, SPAN])  # a clock that starts anew with each file
    assert starts(0.0, NOON) == pytest.approx([0.0, SPAN])  # two clocks
    assert starts(NOON) == [0.0]


def test_another_day_is_another_session():
    assert starts(NOON + DAY + 50, NOON, NOON + DAY, NOON + 7) == pytest.approx([50.0, 0.0, 0.0, 7.0])
    data = make_dataset([conform(recording(EVEN + NOON + DAY)), conform(recording(EVEN + NOON))])
    assert [note for r in data.recordings for note in r.notes if "session" in note] == [
        "Began 0 s after the first recording of session 2 of 2, by its time stamps.",
        "Began 0 s after the first recording of session 1 of 2, by its time stamps.",
    ]


def test_the_start_may_be_a_fact_beside_a_file_that_begins_at_zero(tmp_path):
    path = save_recording(tmp_path / "leg.csv", recording())
    path.with_suffix(".json").write_text(json.dumps({"time_origin": "2025-11-24T16:00:00Z"}))
    assert load_recording(path).start_stamp == NOON
    assert load_recording(path).joint_names == JOINTS


def test_a_timer_that_runs_late_is_put_on_the_grid():
    time = 0.0502 * np.arange(200)
    conformed = conform(recording(time, dof_pos=position(0.3 * time)))
    assert conformed.sample_stride == 20
    inner = np.s_[2:-2]  # cubics have no neighbours at the ends
    assert np.abs(conformed.dof_pos - position(0.3 * conformed.time))[inner].max() < 5e-4
