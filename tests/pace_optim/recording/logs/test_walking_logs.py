"""Logs of robots that walk: an IMU and contacts are found by their names, or by a column map."""

from pathlib import Path

import numpy as np
import pytest
from log_reading import load_recordings
from recordings import says

from pace_optim.recording.logs import read_map
from pace_optim.recording.logs.base import BaseMap, Channels, base_fields, guess_base
from pace_optim.recording.logs.column_map import map_text
from pace_optim.recording.logs.log import Channel, Log

TIME = np.arange(200) * 0.0025


def log(**channels) -> Log:
    made = {
        key: Channel(key=key, table=key.partition(":")[0] if ":" in key else "", time=TIME, values=values)
        for key, values in channels.items()
    }
    return Log(name="walk", channels=made)


def ros_imu(topic="/imu/data"):
    keys = [f"angular_velocity.{a}" for a in "xyz"] + [f"linear_acceleration.{a}" for a in "xyz"]
    keys += [f"orientation.{a}" for a in "xyzw"]
    return {f"{topic}:{key}": i + np.sin(TIME) for i, key in enumerate(keys)}


def test_a_message_of_an_imu_is_one():
    base, notes = guess_base(log(**ros_imu(), **{"/feet:left.contact": (TIME > 0.2).astype(float)}))
    assert base.series["base_lin_acc"].names[2] == "/imu/data:linear_acceleration.z"
    assert base.series["base_quat"].names[0] == "/imu/data:orientation.w"
    assert base.contact == {"left": "/feet:left.contact"}
    assert "The base moves" in notes[0]


@pytest.mark.parametrize("names", [("gyro_{}", "acc_{}"), ("imu.angular_velocity.{}", "imu.accelerometer.{}")])
def test_columns_of_a_table_are_an_imu_by_their_names(names):
    columns = {name.format(axis): TIME + i for i, name in enumerate(names) for axis in "xyz"}
    base, _ = guess_base(log(**columns))
    assert set(base.series) == {"base_ang_vel", "base_lin_acc"}


@pytest.mark.parametrize(
    ("gyro", "of_gyro", "acc", "of_acc"),
    [
        ("gyro_{} [deg/s]", "deg/s", "acc_{} [g]", "g"),
        ("gyro_{} (dps)", "deg/s", "accel_{} [m/s^2]", "m/s²"),
        ("imu_gyro_{}_rad_s", "rad/s", "imu_acc_{}_mg", "mg"),
        ("gyro.{}", "", "acc_{}[m/s²]", "m/s²"),
    ],
)
def test_an_imu_whose_columns_carry_units_is_read_in_them(gyro, of_gyro, acc, of_acc):
    columns = {name.format(axis): TIME for name in (gyro, acc) for axis in "xyz"}
    base, notes = guess_base(log(**columns))
    assert base.series["base_ang_vel"].unit == of_gyro and base.series["base_lin_acc"].unit == of_acc
    assert base.series["base_ang_vel"].names == tuple(gyro.format(axis) for axis in "xyz")
    assert "The base moves" in notes[0]


def test_half_an_imu_is_none():
    base, notes = guess_base(log(**{f"gyro_{axis}": TIME for axis in "xyz"}))
    assert not base.series and all(word in notes[0] for word in ("gyro_x, gyro_y, gyro_z", "not used", "[base]"))


def test_an_imu_in_units_that_are_not_known_is_named():
    columns = {name.format(axis): TIME for name in ("gyro_{} [LSB]", "acc_{} [LSB]") for axis in "xyz"}
    base, notes = guess_base(log(**columns))
    assert not base.series and "acc_x [LSB]" in notes[0] and not guess_base(log(hip_acc=TIME))[1]


def test_units_of_a_map_count_and_contacts_keep_to_the_nearest_value():
    columns = {f"g{axis}": 180.0 * TIME for axis in "xyz"} | {f"a{axis}": np.ones(200) for axis in "xyz"}
    base = BaseMap(
        series={
            "base_ang_vel": Channels(names=("gx", "gy", "gz"), unit="deg/s"),
            "base_lin_acc": Channels(names=("ax", "ay", "az"), unit="g"),
        },
        contact={"left": "c"},
        foot_force={},
    )
    fields = base_fields(log(**columns, c=(TIME >= 0.2).astype(float)), base, np.array([0.1, 0.1989, 0.3]))
    assert fields["base_ang_vel"][:, 0] == pytest.approx(np.pi * np.array([0.1, 0.1989, 0.3]))
    assert (fields["base_lin_acc"] == 9.81).all() and fields["contact"][:, 0].tolist() == [0, 1, 1]
    assert fields["feet"] == ["left"]


def test_a_log_with_an_imu_is_a_recording_of_a_base_that_moves(tmp_path):
    path = csv_log(tmp_path)
    (recording,) = load_recordings(path)
    assert recording.base_ang_vel is not None and recording.feet == ("left",) and recording.contact[:, 0].sum() == 100
    (tmp_path / "map.toml").write_text(
        '[joints.hip]\ndof_pos = "hip_position"\ndes_dof_pos = "hip_command"\n'
        '[base]\nbase_ang_vel = {from = ["gyro_x", "gyro_y", "gyro_z"], unit = "deg/s"}\n'
        'base_lin_acc = {from = ["acc_x", "acc_y", "acc_z"], unit = "g"}\n'
        '[foot_force]\nLF = "left_contact"\n'
    )
    columns = read_map(tmp_path / "map.toml")
    (mapped,) = load_recordings(path, columns=columns)
    assert mapped.base_lin_acc == pytest.approx(9.81 * recording.base_lin_acc)
    assert mapped.feet == ("LF",) and mapped.foot_force.shape == (200, 1)
    (tmp_path / "again.toml").write_text(map_text(columns))
    assert read_map(tmp_path / "again.toml") == columns


def test_an_imu_that_a_map_gives_is_not_called_unused(tmp_path):
    path = csv_log(tmp_path, "gyro_{} [dps]", "acc_{} [LSB]")
    (tmp_path / "map.toml").write_text(
        '[base]\nbase_ang_vel = {from = ["gyro_x [dps]", "gyro_y [dps]", "gyro_z [dps]"], unit = "deg/s"}\n'
        'base_lin_acc = {from = ["acc_x [LSB]", "acc_y [LSB]", "acc_z [LSB]"], unit = "mg"}\n'
    )
    for columns, used in ((None, False), (read_map(tmp_path / "map.toml"), True)):
        lines: list[str] = []
        (recording,) = load_recordings(path, columns=columns, tell=lines.append)
        assert (recording.base_lin_acc is not None) == used
        assert any("like an IMU's, but not used" in line for line in lines) != used


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('base_gyro = "x"', ("base has the unknown key 'base_gyro'",)),
        ('base_ang_vel = ["x", "y"]', ("base.base_ang_vel", "[3 columns]")),
        ('base_ang_vel = {from = ["x", "y", "z"], unit = "rpm"}', ("unit is 'rpm'", "deg/s")),
    ],
)
def test_a_wrong_table_of_the_base_is_named(tmp_path, text, words):
    (path := tmp_path / "map.toml").write_text(f"[base]\n{text}\n")
    with pytest.raises(ValueError, match=says(*words)):
        read_map(path)


def csv_log(folder: Path, gyro: str = "gyro_{}", acc: str = "acc_{}") -> Path:
    names = ["t", "hip_position", "hip_command", *(kind.format(axis) for kind in (gyro, acc) for axis in "xyz")]
    rows = np.stack([TIME, 0.3 * np.sin(9 * TIME), 0.3 * np.sin(9 * TIME + 0.1), *[TIME] * 6, TIME >= 0.25], axis=1)
    path = folder / "walk.csv"
    np.savetxt(path, rows, delimiter=",", header=",".join([*names, "left_contact"]), comments="")
    return path
