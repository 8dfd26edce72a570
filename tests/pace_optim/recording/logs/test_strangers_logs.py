"""Logs of strangers: names, units by joint, clocks, switches and gains are read right, or refused with the reason."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from log_reading import load_recordings, understood
from places import SHARED

from pace_optim.recording import Recording, load_recording
from pace_optim.recording.data import notes_by_kind
from pace_optim.recording.dataset import start_speed
from pace_optim.recording.gaps import split_at_gaps
from pace_optim.recording.logs import ColumnMap, Robot, read_map, with_rate
from pace_optim.recording.logs.words import meaning
from pace_optim.recording.time_base import set_back, unrounded

TIME = np.arange(800) / 200
MOTION = 0.8 * np.sin(3 * TIME) + 1e-4 * np.random.default_rng(0).normal(size=len(TIME))
TARGET = 0.8 * np.sin(3 * TIME + 0.1)
ARM = Robot(joint_names=("shoulder", "elbow"), limits=np.array([[-3.0, 3.0], [-3.0, 3.0]]))
WHEEL = Robot(joint_names=("motor",), limits=np.array([[-np.inf, np.inf]]))
STRANGERS = SHARED / "cases/strangers"


def table(path: Path, form: str = "%.6f", **columns: np.ndarray) -> Path:
    names = ",".join(name.replace("__", " ") for name in columns)
    rows = [
        ",".join("" if np.isnan(cell) else form % cell for cell in row) for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join([names, *rows]))
    return path


def read(path: Path, robot: Robot = ARM, columns: ColumnMap | None = None):
    (one,) = understood(path, robot, columns)
    return one


def arm(**more: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "time": TIME,
        "q_shoulder": MOTION,
        "q_elbow": 0.5 * MOTION,
        "des_shoulder": TARGET,
        "des_elbow": TARGET,
    } | more


def recording(time: np.ndarray, position: np.ndarray, command: np.ndarray) -> Recording:
    return Recording(
        name="r", joint_names=("j",), time=time, dof_pos=position[:, None], des_dof_pos=command[:, None], notes=()
    )


def test_rows_of_one_instant_complete_each_other(tmp_path):
    none = np.full(len(TIME), np.nan)
    both = {
        "time": np.repeat(TIME, 2),
        "q_j": np.stack([MOTION, none], 1).ravel(),
        "des_j": np.stack([none, TARGET], 1).ravel(),
    }
    found = read(table(tmp_path / "long.csv", **both), Robot())
    assert found.recording.dof_pos[:, 0] == pytest.approx(MOTION, abs=1e-6)
    assert found.recording.des_dof_pos[:, 0] == pytest.approx(TARGET, abs=1e-6)


def test_of_two_values_of_one_instant_the_last_counts_and_it_is_said(tmp_path):
    rows = {"time": np.insert(TIME, 5, TIME[5]), "q_j": np.insert(MOTION, 5, 9.0), "des_j": np.insert(TARGET, 5, 9.0)}
    found = read(table(tmp_path / "twice.csv", **rows), Robot())
    assert found.recording.dof_pos[5, 0] == pytest.approx(MOTION[5], abs=1e-6)
    assert any("come again" in line for line in found.lines)


def test_a_switch_and_constant_gains_are_read_and_every_other_column_is_listed(tmp_path):
    more = {
        "torque_enable": TIME < 2,
        "kp_shoulder": 0 * TIME + 30,
        "kp_elbow": 0 * TIME + 20,
        "battery": TIME,
        "led": TIME,
    }
    found = read(table(tmp_path / "log.csv", **arm(**more)))
    assert found.recording.torque_enable.tolist() == (TIME < 2).tolist()
    assert found.recording.drive.stiffness.tolist() == [30, 20]
    assert "Not used: battery, led." in found.lines[-1]


def test_gains_beside_the_log_come_before_its_columns(tmp_path):
    path = table(tmp_path / "log.csv", **arm(kp_shoulder=0 * TIME + 30, kp_elbow=0 * TIME + 20))
    path.with_suffix(".json").write_text(json.dumps({"stiffness": 25.0}))
    found = read(path)
    assert found.recording.drive.stiffness.tolist() == [25, 25] and any("JSON file" in line for line in found.lines)


def test_a_gain_that_changes_is_not_used_and_it_is_said(tmp_path):
    found = read(table(tmp_path / "log.csv", **arm(kp_shoulder=20 + TIME, kp_elbow=20 + TIME)))
    assert found.recording.drive.stiffness is None and any("the gain changes" in line for line in found.lines)


@pytest.mark.parametrize(
    ("names", "words"),
    [(("q0", "q2", "des0", "des2"), "leave some out"), (("q0", "q1", "des_shoulder", "des_elbow"), "in other columns")],
)
def test_joints_are_not_taken_by_place_where_that_could_mislead(tmp_path, monkeypatch, names, words):
    monkeypatch.chdir(tmp_path)
    columns = dict(zip(("time", *names), (TIME, MOTION, 0.5 * MOTION, TARGET, TARGET), strict=True))
    with pytest.raises(ValueError, match=words):
        read(table(tmp_path / "log.csv", **columns))


@pytest.mark.parametrize(
    "stamps",
    [
        {"secs": TIME}, {"seconds": TIME}, {"t": TIME}, {"time_from_start": TIME}, {"elapsed": TIME},
        {"sec": np.floor(TIME), "nsec": np.round(TIME % 1 * 1e9)},
        {"header.stamp.sec": 1.7e9 + np.floor(TIME), "header.stamp.nanosec": np.round(TIME % 1 * 1e9)},
        {"ts_sec": np.floor(TIME), "ts_usec": np.round(TIME % 1 * 1e6)},
    ],
)  # fmt: skip
def test_columns_of_time_go_by_many_names(tmp_path, stamps):
    found = read(table(tmp_path / "log.csv", q_j=MOTION, des_j=TARGET, **stamps), Robot())
    assert found.recording.time == pytest.approx(TIME, abs=1e-6)


def test_a_log_without_time_is_read_at_a_stated_rate(tmp_path):
    path = table(tmp_path / "log.csv", q_j=MOTION, des_j=TARGET)
    with pytest.raises(ValueError, match="--rate"):
        read(path, Robot())
    assert read(path, Robot(), with_rate(None, 200.0)).recording.time == pytest.approx(TIME)
    np.savez(tmp_path / "own.npz", dof_pos=MOTION[:, None], des_dof_pos=TARGET[:, None])
    (own,) = load_recordings(tmp_path / "own.npz", columns=with_rate(None, 200.0))
    assert own.time == pytest.approx(TIME)


def test_a_rate_that_a_log_with_time_does_not_need_is_named(tmp_path):
    found = read(table(tmp_path / "log.csv", **arm()), columns=with_rate(None, 100.0))
    assert found.recording.duration == pytest.approx(TIME[-1])
    assert any("The rate of 100 Hz is not used" in line for line in found.lines)
    own = {"time": TIME, "dof_pos/j": MOTION, "des_dof_pos/j": TARGET}
    recording = load_recording(table(tmp_path / "own.csv", **own), rate=100.0)
    assert any("The rate of 100 Hz is not used" in note for note in recording.notes)


def test_one_column_of_two_joints_is_named(tmp_path):
    (tmp_path / "map.toml").write_text(
        "".join(f'[joints.{j}]\ndof_pos = "q_elbow"\ndes_dof_pos = "des_{j}"\n' for j in ARM.joint_names)
    )
    found = read(table(tmp_path / "log.csv", **arm()), columns=read_map(tmp_path / "map.toml"))
    assert any("several joints: q_elbow (shoulder, elbow)" in note for note in found.recording.notes)


def test_rows_without_a_date_are_left_out(tmp_path):
    stamps = (np.datetime64("2026-11-25T10:00:00") + (1e9 * TIME).astype("timedelta64[ns]")).astype(str)
    for empty in (0, 5, len(TIME) - 1):
        cells = ["" if k == empty else f"{stamp}+01:00" for k, stamp in enumerate(stamps)]
        rows = [f"{cell},{q:.6f},{target:.6f}" for cell, q, target in zip(cells, MOTION, TARGET, strict=True)]
        (tmp_path / "log.csv").write_text("\n".join(["date,q_j,des_j", *rows]))
        found = read(tmp_path / "log.csv", Robot()).recording
        assert found.num_samples == len(TIME) - 1 and found.duration < TIME[-1] + 1e-6
    time = stamps.astype("datetime64[ns]")
    time[5] = np.datetime64("NaT")
    np.savez(tmp_path / "own.npz", time=time, dof_pos=MOTION[:, None], des_dof_pos=TARGET[:, None])
    with pytest.raises(ValueError, match="time has 1 values that are NaN"):
        load_recording(tmp_path / "own.npz")


def test_a_map_may_say_the_time_alone(tmp_path):
    path = table(tmp_path / "log.csv", zeit=TIME, q_j=MOTION, des_j=TARGET)
    (tmp_path / "map.toml").write_text('[time]\ncolumn = "zeit"\nunit = "s"\n')
    assert read(path, Robot(), read_map(tmp_path / "map.toml")).recording.time == pytest.approx(TIME)


def test_all_joints_of_a_log_are_in_one_unit(tmp_path):
    degrees = 180 / np.pi
    small = {"q_elbow": degrees * 0.05 * MOTION, "des_elbow": degrees * 0.05 * TARGET}  # 2.3 degrees, within 3 rad
    columns = arm(q_shoulder=degrees * MOTION, des_shoulder=degrees * TARGET, **small)
    found = read(table(tmp_path / "log.csv", **columns))
    assert found.recording.dof_pos == pytest.approx(np.stack([MOTION, 0.05 * MOTION], 1), abs=1e-5)
    assert found.recording.des_dof_pos == pytest.approx(np.stack([TARGET, 0.05 * TARGET], 1), abs=1e-5)
    assert any("(shoulder): all are read as degrees" in line for line in found.lines)


@pytest.mark.parametrize("reach", [3.9, 7.0, 12.0])
def test_a_swing_beyond_a_limit_changes_no_unit(tmp_path, reach):
    columns = arm(q_shoulder=reach / 0.8 * MOTION, des_shoulder=3.5 * TARGET)  # 2.8 rad are commanded, 3 are possible
    found = read(table(tmp_path / "log.csv", **columns)).recording
    assert found.dof_pos == pytest.approx(np.stack([reach / 0.8 * MOTION, 0.5 * MOTION], 1), abs=1e-5)
    assert found.des_dof_pos == pytest.approx(np.stack([3.5 * TARGET, TARGET], 1), abs=1e-5)


def test_one_impossible_joint_of_many_changes_no_unit(tmp_path):
    names = [f"j{i}" for i in range(5)]
    robot = Robot(joint_names=tuple(names), limits=np.full((5, 2), [-3.0, 3.0]))
    columns = {f"{name}_pos": MOTION * (60 if name == "j2" else 1) for name in names}
    columns |= {f"{name}_cmd": TARGET * (60 if name == "j2" else 1) for name in names}
    found = read(table(tmp_path / "log.csv", time=TIME, **columns), robot).recording
    assert found.dof_pos[:, 0] == pytest.approx(MOTION, abs=1e-5)


def test_a_wheel_that_is_told_speeds_turns_in_rad(tmp_path):
    path = table(
        tmp_path / "log.csv", time=TIME, position=12 * TIME, velocity=12 + 0 * TIME, velocity_cmd=12 + 0 * TIME
    )
    found = read(path, WHEEL).recording
    assert found.dof_pos[:, 0] == pytest.approx(12 * TIME, abs=1e-5)


def test_speeds_whose_unit_is_stated_tell_that_of_positions(tmp_path):
    path = table(
        tmp_path / "log.csv",
        time=TIME,
        position=57.3 * MOTION,
        velocity_rad_s=2.4 * np.cos(3 * TIME),
        cmd=57.3 * TARGET,
    )
    assert read(path, WHEEL).recording.dof_pos[:, 0] == pytest.approx(MOTION, rel=1e-3, abs=1e-4)


def test_a_torque_tells_the_unit_by_the_gain(tmp_path):
    speed = np.gradient(MOTION, TIME)
    torque = 40 * (TARGET - MOTION) - 0.01 * speed
    columns = {"time": TIME, "position": 20 * MOTION, "cmd": 20 * TARGET}
    rad = read(table(tmp_path / "log.csv", **columns, torque=20 * torque), replace(WHEEL, stiffness=np.array([40.0])))
    assert np.ptp(rad.recording.dof_pos) == pytest.approx(np.ptp(20 * MOTION), rel=1e-3)
    degrees = read(
        table(tmp_path / "log.csv", **columns, torque=20 * torque * np.pi / 180),
        replace(WHEEL, stiffness=np.array([40.0])),
    )
    assert np.ptp(degrees.recording.dof_pos) == pytest.approx(np.ptp(20 * MOTION) * np.pi / 180, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("vel [mrad/s]", "mrad/s"),
        ("vel_mrad_s", "mrad/s"),
        ("vel [mdeg/s]", "mdeg/s"),
        ("speed_deg_per_s", "deg/s"),
        ("kneeVelRad/s", "rad/s"),
        ("pos [mdeg]", "mdeg"),
        ("tau [Ncm]", "N cm"),
        ("tau_nmm", "N mm"),
        ("tau [kN·m]", "kN m"),
        ("tau [N-m]", "N m"),
        ("tau (kg.cm)", "kgf cm"),
        ("force [kN]", "kN"),
    ],
)
def test_a_prefix_of_a_unit_is_part_of_it(name, unit):
    said = meaning(f"knee_{name}" if "knee" not in name else name)
    assert (said.unit, said.unknown_unit) == (unit, "") and said.joint == ("knee",)


@pytest.mark.parametrize(
    ("name", "unit"), [("torque_j [lbf in]", "lbf in"), ("temp_j [F]", "F"), ("dq_j [rad/s^2]", "rad/s^2")]
)
def test_a_series_in_a_unit_that_is_not_known_is_left_out_with_a_note(tmp_path, name, unit):
    found = read(table(tmp_path / "log.csv", time=TIME, q_j=MOTION, des_j=TARGET, **{name: 10 * TARGET}), Robot())
    one = found.recording
    assert one.joint_names == ("j",) and one.dof_effort is None and one.temperature is None and one.dof_vel is None
    assert any(f"{name}: the unit is not known" in line for line in found.lines)


def test_positions_in_an_unknown_unit_are_not_taken_for_radians(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = table(tmp_path / "log.csv", **{"time": TIME, "q_j [0.01 deg]": MOTION, "des_j [0.01 deg]": TARGET})
    with pytest.raises(ValueError, match=r"q_j \[0.01 deg\], des_j \[0.01 deg\]: the unit is not known"):
        read(path, Robot())


def test_brackets_that_hold_a_joint_hold_no_unit():
    named = {"pos[hip]": ("hip",), "q[0]": ("0",), "pos (left knee)": ("left", "knee"), "q[jaw]": ("jaw",)}
    named |= {"pos[j1]": ("j", "1"), "position[m2]": ("m", "2"), "q[k]": ("k",), "q[can]": ("can",)}
    for name, joint in named.items():
        assert meaning(name).joint == joint and not meaning(name).unknown_unit


@pytest.mark.parametrize("scale", [1.0, 1e-3, 180 / np.pi])
def test_a_speed_that_contradicts_its_position_is_left_out(tmp_path, scale):
    speed = scale * 2.4 * np.cos(3 * TIME)
    found = read(table(tmp_path / "log.csv", time=TIME, q_rad=MOTION, dq_rad_s=speed, des_rad=TARGET), WHEEL)
    assert (found.recording.dof_vel is None) == (scale != 1.0)
    assert any("so one of the two units is wrong" in line for line in found.lines) == (scale != 1.0)


@pytest.mark.parametrize("name", ["Present_Load", "load_percent", "torque_pct", "effort_permille"])
def test_a_load_register_is_no_torque(tmp_path, name):
    found = read(table(tmp_path / "log.csv", time=TIME, q_j=MOTION, des_j=TARGET, **{name: 10 * TARGET}), Robot())
    assert found.recording.dof_effort is None and any("no torque" in line for line in found.lines)


def test_whole_numbers_beyond_the_drive_are_a_register(tmp_path):
    robot = Robot(joint_names=("j",), limits=np.array([[-3.0, 3.0]]), effort_limit=np.array([3.0]))
    path = table(tmp_path / "log.csv", time=TIME, q_j=MOTION, des_j=TARGET, torque_j=np.round(300 * TARGET))
    assert read(path, robot).recording.dof_effort is None
    path = table(tmp_path / "log.csv", time=TIME, q_j=MOTION, des_j=TARGET, torque_j=3 * TARGET)
    assert read(path, robot).recording.dof_effort is not None


def test_stamps_that_are_rounded_to_more_than_a_step_are_even_again():
    fine = np.arange(3200) / 400
    found, note = unrounded(np.floor(fine / 0.01 + 1e-9) * 0.01)
    assert np.ptp(found - fine) < 1e-3 and "rounded to 10 ms" in note and "400 Hz" in note
    assert unrounded(fine)[1] == "" and unrounded(np.insert(fine, 5, fine[5]))[1] == ""


def test_a_clock_that_was_set_back_is_found_and_late_rows_are_not():
    fine = np.arange(3200) / 400
    assert set_back(np.concatenate([fine[:1600], fine[1600:] - 0.3])).tolist() == [1600]
    late = fine.copy()
    late[[100, 101]] = late[[101, 100]]
    assert not len(set_back(late)) and not len(set_back(fine[::-1])) and not len(set_back(fine))


def test_rows_without_time_hide_no_clock_that_was_set_back_and_no_second_clock(tmp_path):
    time = np.concatenate([TIME, TIME]) + 0.0
    time[[398, 799, 801]] = np.nan
    columns = {"q_j": np.tile(MOTION, 2), "des_j": np.tile(TARGET, 2)}
    assert len(understood(table(tmp_path / "log.csv", time=time, **columns), Robot())) == 2
    for rate in (1.0, 1.1):
        other = rate * TIME
        other[[0, 5]] = np.nan
        path = table(tmp_path / "two.csv", time=TIME, host_time=other, q_j=MOTION, des_j=TARGET)
        said = any(f"spans {rate:.3g} times as long" in line for line in read(path, Robot()).lines)
        assert said == (rate != 1.0) and ("nan" not in " ".join(read(path, Robot()).lines))


def test_a_log_whose_clock_was_set_back_is_two_recordings(tmp_path):
    jumped = np.where(np.arange(len(TIME)) < 400, TIME, TIME - 0.3)
    first, second = understood(table(tmp_path / "log.csv", **arm(time=jumped)), ARM, None)
    assert (first.recording.num_samples, second.recording.num_samples) == (400, 400)
    assert any("goes back by 0.295 s" in line for line in first.lines)
    np.savez(tmp_path / "own.npz", time=jumped, dof_pos=MOTION[:, None], des_dof_pos=TARGET[:, None])
    with pytest.raises(ValueError, match="clock was set back there"):
        load_recording(tmp_path / "own.npz")


def test_a_clock_that_is_set_back_in_its_first_rows_costs_these_rows_alone(tmp_path):
    time = np.concatenate([5.0 + TIME[:10], TIME[10:]])
    found = read(table(tmp_path / "back.csv", time=time, q_j=MOTION, des_j=TARGET), Robot())
    assert found.recording.num_samples == len(TIME) - 10 and found.recording.name == "back"
    assert any("Parts of fewer than 20 rows are left out" in line for line in found.lines)


@pytest.mark.parametrize("gap", [0.3, 0.05])
def test_a_gap_splits_and_a_clock_that_jumps_is_told_from_lost_samples(gap):
    fine = np.arange(1600) / 400
    q, c = np.sin(4 * fine), np.sin(4 * fine + 0.2)
    lost = np.abs(fine - 2.0 - gap / 2) > gap / 2
    for time, keep, words in ((fine, lost, "no samples for"), (fine + gap * (fine >= 2), lost | True, "jumps ahead")):
        one, two = split_at_gaps(recording(time[keep], q[keep], c[keep]))
        assert words in one.notes[-1] and "at 1.998 s" in one.notes[-1] and two.time[0] == 0 and not two.notes
        assert one.num_samples + two.num_samples == keep.sum() and two.time_origin == pytest.approx(2 + gap, abs=0.006)


def test_a_gap_in_which_nothing_happens_or_that_cubics_bridge_does_not_split():
    fine = np.arange(1600) / 400
    moving = np.sin(4 * fine)
    still = np.abs(fine - 2) > 0.2
    whole = recording(fine[still], np.zeros(still.sum()), np.zeros(still.sum()))
    assert split_at_gaps(whole) == [whole]
    short = np.abs(fine - 2) > 0.01
    whole = recording(fine[short], moving[short], moving[short])
    assert split_at_gaps(whole) == [whole]


def test_a_gap_before_the_first_command_is_left_out_with_what_comes_before():
    time = TIME + np.where(np.arange(len(TIME)) >= 100, 0.2, 0.0)
    late = replace(recording(time, MOTION, TARGET), des_time=time[150:], des_dof_pos=TARGET[150:, None])
    (whole,) = split_at_gaps(late)
    assert whole.num_samples == len(TIME) - 150 and any("no command is known" in note for note in whole.notes)


def test_a_gap_of_a_standstill_splits_where_it_is_too_long_to_bridge():
    still = np.zeros_like(TIME)
    still[:300], still[500:] = np.sin(TIME[:300] - TIME[300]), np.sin(TIME[500:] - TIME[500])
    time = TIME + np.where(np.arange(len(TIME)) >= 400, 0.7, 0.0)
    parts = split_at_gaps(recording(time, still, still))
    assert [part.num_samples for part in parts] == [400, 400] and "no samples for 0.705 s" in parts[0].notes[0]


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 5e-4])
def test_a_recording_in_motion_begins_with_the_slope_of_its_positions(noise):
    fine = np.arange(1600) / 400
    q = np.sin(4 * fine) + noise * np.random.default_rng(0).normal(size=len(fine))
    assert start_speed(recording(fine, q, q))[0][0] == pytest.approx(4.0, rel=0.03)


@pytest.mark.parametrize("seed", range(10))
def test_a_recording_that_begins_at_rest_has_no_speed(seed):
    fine = np.arange(1600) / 400
    sets_in = np.where(fine > 0.007, 5 * (fine - 0.007) ** 2, 0.0)
    for motion in (sets_in, 0.5 * (1 - np.cos(6 * fine)), 0 * fine):
        q = motion + 1e-4 * np.random.default_rng(seed).normal(size=len(fine))
        assert start_speed(recording(fine, q, q))[0][0] == 0.0


def test_notes_come_once_for_each_kind():
    notes = [("a", "Rate 400 Hz."), ("b", "Rate 399 Hz."), ("a", "Wraps."), ("b", "Wraps.")]
    recordings = [
        replace(recording(TIME, MOTION, TARGET), name=name, notes=tuple(note for n, note in notes if n == name))
        for name in "ab"
    ]
    assert notes_by_kind(recordings) == ["a: Rate 400 Hz. (b: 399 Hz)", "a, b: Wraps."]


@pytest.mark.skipif(not STRANGERS.is_dir(), reason="needs ../shared/cases")
def test_names_in_a_list_in_a_list_are_names():
    pytest.importorskip("pyarrow")
    robot = Robot(joint_names=("left_shoulder_pitch_joint", "left_elbow_joint"))
    for name in ("dataset", "dataset_two"):
        columns = read(STRANGERS / "lerobot_nested_names" / name, robot).columns.joints
        assert columns["left_elbow_joint"]["dof_pos"].channel == "observation.state[kLeftElbow]"
        assert columns["left_shoulder_pitch_joint"]["dof_pos"].channel == "observation.state[kLeftShoulderPitch]"


@pytest.mark.skipif(not STRANGERS.is_dir(), reason="needs ../shared/cases")
@pytest.mark.parametrize(
    ("name", "words"),
    [("tiny_1e-06.npz", "in another unit"), ("meta.pt", "no plain numbers"), ("name_newline.npz", "one line")],
)
def test_damaged_files_are_refused_in_one_line(name, words):
    with pytest.raises(ValueError, match=words) as refused:
        load_recording(STRANGERS / "damaged" / name)
    assert "\n" not in str(refused.value)


# ------------------------------------------------------------------ tables as loggers write them


def written(path: Path, *head: str, columns: tuple[np.ndarray, ...] = (TIME, MOTION, TARGET), sep: str = ",") -> Path:
    rows = [sep.join(f"{cell:.6f}" for cell in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([*head, *rows]))
    return path


@pytest.mark.parametrize(
    ("name", "head", "sep"),
    [
        ("log.csv", ("# rig 3", "", '"# kp = 20, see notes"', "time,q_j,des_j"), ","),
        ("log.csv", ("# time,q_j,des_j",), ","),  # numpy.savetxt
        ("log.txt", ("% rig 3", "time q_j des_j"), " "),
        ("log.dat", ("time\tq_j\tdes_j",), "\t"),
    ],
)
def test_names_stand_after_comments_in_the_last_comment_and_between_any_marks(tmp_path, name, head, sep):
    found = read(written(tmp_path / name, *head, sep=sep), Robot())
    assert found.recording.dof_pos[:, 0] == pytest.approx(MOTION, abs=1e-5)


def test_a_file_without_names_says_so_and_is_read_with_a_map(tmp_path):
    path = written(tmp_path / "log.csv")
    with pytest.raises(ValueError, match="no line of names: its columns are called 'column 1' to 'column 3'"):
        read(path, Robot())
    (tmp_path / "map.toml").write_text(
        '[time]\ncolumn = "column 1"\nunit = "s"\n[joints.j]\ndof_pos = {from = "column 2", unit = "rad"}\n'
        'des_dof_pos = {from = "column 3", unit = "rad"}\n'
    )
    found = read(path, Robot(), read_map(tmp_path / "map.toml"))
    assert found.recording.des_dof_pos[:, 0] == pytest.approx(TARGET, abs=1e-5)


def test_columns_of_one_name_are_left_out_and_rows_that_are_series_are_noticed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    twice = written(tmp_path / "log.csv", "time,q_j,des_j,tau,tau", columns=(TIME, MOTION, TARGET, TIME, TIME))
    assert any("come more than once: tau" in line for line in read(twice, Robot()).lines)
    np.savetxt(tmp_path / "rows.csv", np.stack([TIME, MOTION]), delimiter=",")
    with pytest.raises(ValueError, match="800 columns and 2 rows: transpose it"):
        read(tmp_path / "rows.csv", Robot())


def test_a_plus_in_a_folder_joins_nothing_and_files_are_called_after_their_series(tmp_path):
    folder = tmp_path / "a+b"
    folder.mkdir()
    states = written(folder / "q.csv", "time,hip,knee", columns=(TIME, MOTION, 0.5 * MOTION))
    commands = written(folder / "q_cmd.csv", "time,hip,knee", columns=(TIME, TARGET, 0.5 * TARGET))
    found = read(Path(f"{states}+{commands}"), Robot(joint_names=("hip", "knee")))
    assert found.recording.dof_pos[:, 1] == pytest.approx(0.5 * MOTION, abs=1e-5)
    assert found.recording.des_dof_pos[:, 0] == pytest.approx(TARGET, abs=1e-5)


def test_a_series_in_two_units_is_taken_once_and_forces_are_no_positions(tmp_path):
    force = {"force_feedback": 9 * MOTION, "force_desired": 9 * TARGET, "force_last_desired": 9 * TARGET}
    both = {"position_degrees": np.degrees(MOTION), "position_radians": MOTION, "position_last": MOTION}
    found = read(table(tmp_path / "log.csv", "%.9f", time=TIME, **force, **both), Robot()).recording
    assert found.joint_names == ("joint",) and found.dof_pos[:, 0] == pytest.approx(MOTION, abs=1e-6)
    assert found.des_dof_effort[:, 0] == pytest.approx(9 * TARGET, abs=1e-6)


def test_an_index_finger_is_a_joint_and_an_index_is_none(tmp_path):
    columns = {"left_index_pos": MOTION, "left_index_cmd": TARGET, "index": TIME, "motor_index": TIME}
    found = read(table(tmp_path / "log.csv", time=TIME, **columns), Robot())
    assert found.recording.joint_names == ("left_index",) and "Not used: index, motor_index." in found.lines[-1]


def test_two_clocks_that_disagree_are_said(tmp_path):
    found = read(table(tmp_path / "log.csv", timestamp=TIME, real_time=2 * TIME, q_j=MOTION, des_j=TARGET), Robot())
    assert any("two clocks: 'real_time' spans 2 times as long as 'timestamp'" in line for line in found.lines)


def test_a_joint_without_limits_is_read_in_the_unit_of_the_others(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = {"q_elbow": np.degrees(0.1 * MOTION), "des_elbow": np.degrees(0.1 * TARGET)}
    small["q_elbow"] += np.degrees(1e-4) * np.random.default_rng(3).normal(size=len(TIME))
    columns = arm(q_shoulder=np.degrees(MOTION), des_shoulder=np.degrees(TARGET), **small)
    found = read(table(tmp_path / "log.csv", **columns), Robot()).recording
    assert found.dof_pos[:, 1] == pytest.approx(0.1 * MOTION, abs=1e-3)


def test_torques_of_some_joints_are_commands_and_the_rest_is_not_missing(tmp_path):
    three = Robot(joint_names=("shoulder", "elbow", "wrist"), limits=np.full((3, 2), [-3.0, 3.0]))
    columns = {"q_shoulder": MOTION, "q_elbow": MOTION, "tau_shoulder": TARGET, "tau_elbow": TARGET}
    found = read(table(tmp_path / "log.csv", time=TIME, **columns), three).recording
    assert found.joint_names == ("shoulder", "elbow") and found.des_dof_effort.shape[1] == 2
