"""Logs of other programs: the same motion written in many ways is read as the same recording."""
# ruff: noqa: E501

import csv
import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from log_reading import load_recordings, understood
from places import SHARED
from recordings import says

from pace_optim.commands import import_log
from pace_optim.recording import load_recording, save_recording
from pace_optim.recording.logs import LogReader, Robot, paired_files, read_map, rosbag, tables, write_map
from pace_optim.recording.logs.column_map import ColumnMap, Source
from pace_optim.recording.logs.rosbag import rows_of
from pace_optim.recording.logs.words import meaning
from pace_optim.terminal.cli import run_cli

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="the readers of logs are not installed")
rosbag1 = pytest.importorskip("rosbags.rosbag1")
parquet = pytest.importorskip("pyarrow.parquet")
import pyarrow as pa  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

LOGS = SHARED / "cases" / "logs"
JOINTS = ("hip", "knee")
LIMITS = np.array([[-1.5, 1.5], [-2.5, 0.0]])
ROBOT = Robot(joint_names=JOINTS, limits=LIMITS)
NOON = 1_764_000_000_000_000_000
STEP, COUNT = 4_000_000, 400  # ns
STAMPS = STEP * np.arange(COUNT)
COMMANDS = 10_000_000 * np.arange(160)  # on their own clock


def motion(ns, lag=0.0):
    time = ns * 1e-9 - lag
    return np.stack([0.5 + 0.3 * np.sin(6 * time), -1.0 - 0.4 * np.sin(5 * time)], axis=1)


POS, DES = motion(STAMPS, 0.02), motion(COMMANDS)
VEL = np.gradient(POS, STAMPS * 1e-9, axis=0)


class Bag:
    """Writes messages of a ROS distribution."""

    def __init__(self, path, kind="mcap"):
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
        self.ros1 = kind == "bag"
        if self.ros1:
            self.writer = rosbag1.Writer(path)
        else:
            storage = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
        self.topics = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def type(self, name):
        return self.store.types[name]

    def header(self, ns):
        extra = {"seq": 0} if self.ros1 else {}
        stamp = self.type("builtin_interfaces/msg/Time")(sec=int(ns // 10**9), nanosec=int(ns % 10**9))
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id="", **extra)

    def write(self, topic, kind, at, message):
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        raw = self.store.serialize_ros1(message, kind) if self.ros1 else self.store.serialize_cdr(message, kind)
        self.writer.write(self.topics[topic], int(at), raw)

    def state(self, topic, at, names, position, velocity=(), effort=(), stamp=None, received=0):
        kind = "sensor_msgs/msg/JointState"
        arrays = [np.asarray(x, dtype=np.float64) for x in (position, velocity, effort)]
        header = self.header(at if stamp is None else stamp)
        message = self.type(kind)(
            header=header, name=list(names), position=arrays[0], velocity=arrays[1], effort=arrays[2]
        )
        self.write(topic, kind, at + received, message)

    def array(self, topic, at, values):
        kind, layout = (
            "std_msgs/msg/Float64MultiArray",
            self.type("std_msgs/msg/MultiArrayLayout")(dim=[], data_offset=0),
        )
        self.write(topic, kind, at, self.type(kind)(layout=layout, data=np.ascontiguousarray(values, dtype=np.float64)))

    def point(self, positions=(), velocities=(), effort=(), after=0):
        since = self.type("builtin_interfaces/msg/Duration")(sec=int(after // 10**9), nanosec=int(after % 10**9))
        arrays = {k: np.asarray(v, dtype=np.float64) for k, v in (("positions", positions), ("velocities", velocities))}
        kind = self.type("trajectory_msgs/msg/JointTrajectoryPoint")
        return kind(**arrays, accelerations=np.zeros(0), effort=np.asarray(effort, float), time_from_start=since)


def check(recording, atol=1e-9, pos=POS, des=DES, absolute=True):
    """The motion, the commands at their instants, and where in time it lies."""
    assert recording.joint_names == JOINTS
    kept = len(recording.time)
    assert np.allclose(recording.dof_pos, pos[-kept:], atol=atol)
    instants = recording.time if recording.des_time is None else recording.des_time
    at = np.rint(instants * 1e9 + (len(pos) - kept) * STEP).astype(np.int64)
    expected = des[np.clip(np.searchsorted(COMMANDS, at + 1000, side="right") - 1, 0, None)]
    assert np.allclose(recording.des_dof_pos, expected, atol=max(atol, 1e-9))
    assert not absolute or recording.start_stamp == pytest.approx(NOON * 1e-9, abs=0.1)


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_bags_of_every_kind_with_prefixes_other_joints_and_another_order(tmp_path, kind):
    path = tmp_path / ("leg.bag" if kind == "bag" else "leg")
    with Bag(path, kind) as bag:
        for k, ns in enumerate(STAMPS):
            values = [POS[k, 1], 0.0, POS[k, 0]]
            bag.state("/joint_states", NOON + ns, ["leg/KNEE_J", "gripper", "leg/HIP_J"], values, received=700_000)
        for k, ns in enumerate(COMMANDS):
            bag.state("/leg/joint_commands", NOON + ns, ["leg/HIP_J", "leg/KNEE_J"], DES[k], received=300_000)
    (recording,) = load_recordings(path, ROBOT)
    check(recording)
    assert any("headers" in note for note in recording.notes) and any("gripper" in note for note in recording.notes)
    if kind != "bag":
        (inner,) = [p for p in path.iterdir() if p.suffix != ".yaml"]
        check(load_recordings(inner, ROBOT)[0])


def test_header_stamps_of_another_clock_are_not_used(tmp_path):
    with Bag(tmp_path / "leg") as bag:
        for k, ns in enumerate(STAMPS):
            bag.state("/joint_states", NOON + ns, JOINTS, POS[k], stamp=ns + 1)
        for k, ns in enumerate(COMMANDS):
            bag.array("/position_controller/commands", NOON + ns, DES[k, ::-1])  # in no order that the log tells
    (recording,) = load_recordings(tmp_path / "leg", ROBOT)
    check(recording)
    assert any("another clock" in note for note in recording.notes)
    assert any("by the motions that follow them they are knee, hip" in note for note in recording.notes)


def test_states_of_some_joints_at_a_time_and_a_topic_for_each_command(tmp_path):
    with Bag(tmp_path / "leg") as bag:
        kind = "std_msgs/msg/Float64"
        for k, ns in enumerate(STAMPS):
            bag.state("/joint_states", NOON + ns, ["hip"], POS[k, :1])
            bag.state("/joint_states", NOON + ns, ["knee"], POS[k, 1:])
        for k, ns in enumerate(COMMANDS):
            for j, name in enumerate(JOINTS):
                bag.write(f"/{name}_position_controller/command", kind, NOON + ns, bag.type(kind)(data=DES[k, j]))
    check(load_recordings(tmp_path / "leg", ROBOT)[0])


@pytest.mark.parametrize("newer", [False, True])
def test_states_of_a_trajectory_controller_in_both_wordings(tmp_path, newer):
    names = ("reference", "feedback", "error", "output") if newer else ("desired", "actual", "error")
    kind = "control_msgs/msg/JointTrajectoryControllerState"
    text = "std_msgs/Header header\nstring[] joint_names\n"
    text += "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in names)
    with Bag(tmp_path / "leg") as bag:
        bag.store.register(get_types_from_msg(text, kind))
        for k, ns in enumerate(STAMPS):
            des = motion(np.array([ns - ns % 10_000_000]))[0]
            points = [bag.point(des, VEL[k]), bag.point(POS[k], VEL[k]), bag.point(des - POS[k])]
            points += [bag.point()] if newer else []
            message = bag.type(kind)(
                header=bag.header(NOON + ns), joint_names=list(JOINTS), **dict(zip(names, points, strict=True))
            )
            bag.write("/leg_controller/state", kind, NOON + ns, message)
    (recording,) = load_recordings(tmp_path / "leg", ROBOT)
    check(recording)
    assert recording.des_dof_vel is None and any("plan" in note for note in recording.notes)
    assert np.allclose(recording.dof_vel, VEL)


def test_a_trajectory_of_several_points_is_followed(tmp_path):
    with Bag(tmp_path / "leg") as bag:
        kind = "trajectory_msgs/msg/JointTrajectory"
        for k, ns in enumerate(STAMPS):
            bag.state("/joint_states", NOON + ns, JOINTS, POS[k])
        points = [bag.point(DES[k], after=ns) for k, ns in enumerate(COMMANDS)]
        bag.write(
            "/leg/joint_trajectory",
            kind,
            NOON,
            bag.type(kind)(header=bag.header(0), joint_names=list(JOINTS), points=points),
        )
    (recording,) = load_recordings(tmp_path / "leg", ROBOT)
    line = np.stack([np.interp(recording.des_time * 1e9, COMMANDS, column) for column in DES.T], axis=1)
    assert np.allclose(recording.des_dof_pos, line, atol=1e-6) and len(recording.des_time) > len(COMMANDS)


def test_a_trajectory_ends_where_the_next_message_replaces_it(tmp_path):
    kind, second = "trajectory_msgs/msg/JointTrajectory", 10**9
    with Bag(tmp_path / "leg") as bag:
        for k, ns in enumerate(STAMPS):
            bag.state("/joint_states", NOON + ns, JOINTS, POS[k])
        for begin, targets in ((0.0, (0.0, 1.0)), (0.5013, (0.5, 0.0)), (0.9, (0.1, 0.3))):
            points = [bag.point([x, -x], after=at) for x, at in zip(targets, (0, second), strict=True)]
            message = bag.type(kind)(header=bag.header(0), joint_names=list(JOINTS), points=points)
            bag.write("/leg/joint_trajectory", kind, NOON + int(begin * second), message)
    (recording,) = load_recordings(tmp_path / "leg", ROBOT)
    at = recording.des_time
    first, then, last = at, 0.5 - 0.5 * (at - 0.5013), 0.1 + 0.2 * (at - 0.9)
    expected = np.where(at < 0.5013 - 1e-9, first, np.where(at < 0.9 - 1e-9, then, last))
    assert np.allclose(recording.des_dof_pos, np.stack([expected, -expected], axis=1), atol=1e-9)


def test_the_last_point_of_a_trajectory_is_commanded_whatever_its_span():
    def point(nanosec, at):
        time_from_start = SimpleNamespace(sec=0, nanosec=nanosec)
        return SimpleNamespace(positions=[at], velocities=[], effort=[], time_from_start=time_from_start)

    message = SimpleNamespace(joint_names=["hip"], points=[point(0, 0.0), point(7_000_000, 0.7)])
    rows = [(at, float(values[0])) for at, _, values in rows_of(message, "/plan")]
    assert rows == [(0, 0.0), (5_000_000, pytest.approx(0.5)), (7_000_000, 0.7)]


def test_torque_in_and_motion_out_is_a_recording(tmp_path):
    with Bag(tmp_path / "leg") as bag:
        for k, ns in enumerate(STAMPS):
            bag.state("/joint_states", NOON + ns, JOINTS, POS[k], VEL[k], 3.0 * DES[k // 3])
    (recording,) = load_recordings(tmp_path / "leg", ROBOT)
    assert recording.des_dof_pos is None and recording.dof_effort is None  # which would say nothing of the drive
    at = np.searchsorted(recording.des_time, recording.time - 1e-9)
    assert recording.des_dof_effort[at] == pytest.approx(3.0 * DES[np.arange(len(POS)) // 3])
    assert any("no commands" in note for note in recording.notes)


def test_an_unknown_message_type_is_read_by_its_fields(tmp_path):
    motor, kinds = "float32 q\nfloat32 dq\nfloat32 tau_est\nint8 temperature\n", {}
    for name, part in (("LowState", "motor_state"), ("LowCmd", "motor_cmd")):
        kinds |= get_types_from_msg(f"{name}Motor[2] {part}\n", f"my_msgs/msg/{name}")
        kinds |= get_types_from_msg(motor, f"my_msgs/msg/{name}Motor")
    with Bag(tmp_path / "leg") as bag:
        bag.store.register(kinds)

        def write(name, part, ns, q):
            each = bag.type(f"my_msgs/msg/{name}Motor")
            motors = [each(q=float(x), dq=0.0, tau_est=0.0, temperature=30) for x in q]
            bag.write(
                f"/{name.lower()}", f"my_msgs/msg/{name}", NOON + ns, bag.type(f"my_msgs/msg/{name}")(**{part: motors})
            )

        for k, ns in enumerate(STAMPS):
            write("LowState", "motor_state", ns, POS[k])
        for k, ns in enumerate(COMMANDS):
            write("LowCmd", "motor_cmd", ns, DES[k])
    (recording,) = load_recordings(tmp_path / "leg", ROBOT)
    check(recording, atol=1e-6)
    assert np.all(recording.temperature == 30.0)


def test_a_damaged_bag_and_one_without_joints_have_their_messages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\nnonsense")
    with pytest.raises(ValueError, match=says("cut.mcap", "cannot be read as a bag")):
        load_recordings(tmp_path / "cut.mcap", ROBOT)
    with Bag(tmp_path / "leg") as bag:
        for k, ns in enumerate(STAMPS):
            bag.state("/joint_states", NOON + ns, ["hip", "ankle"], POS[k])
    with pytest.raises(
        ValueError, match=says("positions (dof_pos) of knee", "commands", "of hip, knee", "leg_map.toml")
    ):
        load_recordings(tmp_path / "leg", ROBOT)
    text = (tmp_path / "leg_map.toml").read_text()
    assert read_map(tmp_path / "leg_map.toml").joints["hip"]["dof_pos"].channel == "/joint_states:position[hip]"
    assert "/joint_states:position[ankle]" in text and "Missing" in text


def rows(header, columns, path, mark=","):
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter=mark)
        writer.writerow(header)
        writer.writerows(zip(*columns, strict=True))
    return path


HELD = DES[STAMPS // 10_000_000]


@pytest.mark.parametrize(
    ("header", "stamp", "scale", "absolute"),
    [
        (["t_ms", "HIP_J pos deg", "KNEE_J pos deg", "HIP_J cmd deg", "KNEE_J cmd deg"], STAMPS / 1e6, 180 / np.pi, False),
        (["timestamp", "q_hip", "q_knee", "q_des_hip", "q_des_knee"], NOON + STAMPS, 1.0, True),
        (["time [s]", "hip.actual", "knee.actual", "hip.target", "knee.target"], STAMPS / 1e9, 1.0, False),
        (["stamp", "leftLeg/hipPosition", "leftLeg/kneePosition", "leftLeg/hipCommand", "leftLeg/kneeCommand"], NOON // 1000 + STAMPS // 1000, 1.0, True),
        (["Time", "present_position_hip", "present_position_knee", "goal_position_hip", "goal_position_knee"], STAMPS / 1e9, 180 / np.pi, False),
        (["t", "joint_pos[0]", "joint_pos[1]", "joint_pos_target[0]", "joint_pos_target[1]"], STAMPS / 1e9, 1.0, False),
    ],
)  # fmt: skip
def test_csv_of_any_names_units_and_stamps(tmp_path, header, stamp, scale, absolute):
    columns = [stamp.tolist(), *(scale * POS).T.tolist(), *(scale * HELD).T.tolist()]
    if "[0]" not in header[1] and "hip.actual" not in header:
        (recording,) = load_recordings(rows(header, columns, tmp_path / "leg.csv"), ROBOT)
    else:  # names that say little: semicolons, a repeated row and an empty line at the end
        columns = [[*column[:5], column[4], *column[5:]] for column in columns]
        path = rows(header, columns, tmp_path / "leg.csv", ";")
        path.write_text(path.read_text() + "\n1;2\n")
        if header[1] == "hip.actual":
            path.write_text(path.read_text().replace("actual", "actual pos").replace("target", "target pos"))
        (recording,) = load_recordings(path, ROBOT)
    check(recording, atol=1e-6, absolute=absolute)
    assert recording.des_time is None


def test_temperatures_of_motors_and_the_voltage_of_a_battery_are_read(tmp_path):
    names = [
        "time",
        "hip pos",
        "knee pos",
        "hip cmd",
        "knee cmd",
        "hip temp [°C]",
        "knee temperature",
        "imu temp",
        "battery_voltage",
    ]
    columns = [STAMPS / 1e9, *POS.T, *HELD.T, *(40.0 + POS).T, 0.0 * STAMPS, 24.0 - POS[:, 0]]
    rows(names, columns, tmp_path / "log.csv")
    (recording,) = load_recordings(tmp_path / "log.csv", ROBOT)
    assert recording.temperature == pytest.approx(40.0 + POS)
    assert recording.voltage == pytest.approx(24.0 - POS[:, [0, 0]])
    saved = load_recording(save_recording(tmp_path / "saved.csv", recording))
    assert np.array_equal(saved.temperature, recording.temperature)


def test_empty_cells_give_columns_clocks_of_their_own(tmp_path):
    every = np.union1d(STAMPS, COMMANDS)
    cells = {name: dict(zip(ns.tolist(), values.tolist(), strict=True))
             for name, ns, values in (("hip pos", STAMPS, POS[:, 0]), ("knee pos", STAMPS, POS[:, 1]),
                                      ("hip cmd pos", COMMANDS, DES[:, 0]), ("knee cmd pos", COMMANDS, DES[:, 1]))}  # fmt: skip
    columns = [(every / 1e9).tolist(), *([by.get(ns, "") for ns in every.tolist()] for by in cells.values())]
    (recording,) = load_recordings(rows(["time", *cells], columns, tmp_path / "leg.csv"), ROBOT)
    check(recording, absolute=False)
    assert recording.des_time is not None
    (note,) = [note for note in recording.notes if "empty cells" in note]
    assert note[0].isdigit()  # a table without a name is not told as one


def test_two_files_that_are_halves_of_one_log_are_joined(tmp_path):
    states = rows(["time", "dof_pos/hip", "dof_pos/knee"], [STAMPS / 1e9, *POS.T], tmp_path / "b.csv")
    commands = rows(["time", "des_dof_pos/hip", "des_dof_pos/knee"], [COMMANDS / 1e9, *DES.T], tmp_path / "a.csv")
    whole = rows(["time", "dof_pos/x", "des_dof_pos/x"], [STAMPS / 1e9, *POS.T], tmp_path / "c.csv")
    for order in ([states, commands], [commands, whole, states]):
        names = paired_files([str(path) for path in order])
        joined = [name for name in names if "+" in name]
        assert len(joined) == 1 and len(names) == len(order) - 1
        check(load_recordings(joined[0], ROBOT)[0], absolute=False)


@pytest.mark.parametrize("nested", [False, True])
def test_lerobot_datasets_give_a_recording_for_each_episode(tmp_path, nested):
    names = {"motors": ["hip.pos", "knee.pos"]} if nested else ["hip.pos", "knee.pos"]
    features = {key: {"dtype": "float32", "shape": [2], "names": names} for key in ("observation.state", "action")}
    root = tmp_path / "set"
    for folder in ("meta", "data/chunk-000"):
        (root / folder).mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps({"codebase_version": "v2.1", "fps": 250, "features": features}))
    frame = np.arange(COUNT)

    def table(episodes):
        count = len(episodes)
        return pa.table({
            "observation.state": pa.array([row for _ in range(count) for row in (POS * 180 / np.pi).tolist()]),
            "action": pa.array([row for _ in range(count) for row in (HELD * 180 / np.pi).tolist()]),
            "timestamp": pa.array(np.tile(frame / 250, count).astype(np.float32)),
            "frame_index": pa.array(np.tile(frame, count)),
            "episode_index": pa.array(np.repeat(episodes, COUNT)),
            "next.done": pa.array(np.zeros(count * COUNT, dtype=bool)),
        })  # fmt: skip

    if nested:
        for i in range(2):
            parquet.write_table(table([i]), root / f"data/chunk-000/episode_{i:06d}.parquet")
    else:
        parquet.write_table(table([0, 1]), root / "data/chunk-000/file-000.parquet")
    recordings = load_recordings(root, ROBOT)
    assert [recording.name for recording in recordings] == ["set episode 0", "set episode 1"]
    for recording in recordings:
        check(recording, absolute=False, atol=1e-6)
    one = next((root / "data/chunk-000").iterdir())
    check(load_recordings(one, ROBOT)[0], absolute=False, atol=1e-6)


MAP = """
[time]
column = "clock"
unit = "ms"
[facts]
stiffness = 40.0
damping = {hip = 1.0, knee = 2.0}
[joints.hip]
dof_pos = {from = "m1", unit = "deg", sign = -1, gear_ratio = 9.0, offset = 0.1}
des_dof_pos = "c1"
dof_effort = {from = "i1", unit = "mA", factor = 0.5, gear_ratio = 9.0, sign = -1}
[joints.knee]
dof_pos = {from = "m2"}
des_dof_pos = "c2"
"""


def write_episodes(folder, *episodes):
    """A data set of parquet files, one for each episode's columns."""
    (folder / "set/meta").mkdir(parents=True)
    (folder / "set/data").mkdir()
    (folder / "set/meta/info.json").write_text(json.dumps({"fps": 250}))
    for i, columns in enumerate(episodes):
        count = len(next(iter(columns.values())))
        columns |= {"timestamp": np.arange(count) / 250, "episode_index": np.full(count, i)}
        parquet.write_table(pa.table(columns), folder / f"set/data/{i}.parquet")
    return str(folder / "set")


def test_bad_episodes_write_no_map_where_others_are_good_and_one_where_none_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    half, whole = {"hip_pos": POS[:, 0]}, {"hip_pos": POS[:, 0], "hip_cmd": HELD[:, 0]}
    path = write_episodes(tmp_path / "good", dict(half), dict(whole), dict(half))
    reader = LogReader([path])
    assert len(reader.recordings(path, Robot())) == 1 and not list(tmp_path.glob("*.toml"))
    lines = [line for line in reader.lines() if "[W20]" in line]
    assert len(lines) == 2 and "missing commands" in lines[0] and "toml" not in lines[0]
    path = write_episodes(tmp_path / "bad", dict(half), dict(half))
    with pytest.raises(ValueError, match=r"What was guessed is in set_episode_0_map\.toml"):
        LogReader([path]).recordings(path, Robot())
    assert [each.name for each in tmp_path.glob("*.toml")] == ["set_episode_0_map.toml"]


def test_a_log_is_described_by_an_episode_that_is_used(tmp_path):
    path = write_episodes(
        tmp_path,
        {"hip_pos": POS[:5, 0], "hip_cmd": HELD[:5, 0], "left\x1b": POS[:5, 0]},
        {"hip_pos": POS[:, 0], "hip_cmd": HELD[:, 0]},
    )
    reader = LogReader([path])
    assert len(reader.recordings(path, Robot())) == 1
    assert "400 values" in reader.lines()[1] and not any("\x1b" in line for line in reader.lines())


def test_a_bad_episode_of_a_dataset_is_set_aside(tmp_path):
    episodes = ({"hip_pos": POS[:count, 0], "hip_cmd": HELD[:count, 0]} for count in (5, COUNT))
    write_episodes(tmp_path, *episodes)
    reader = LogReader([str(tmp_path / "set")])
    (recording,) = reader.recordings(str(tmp_path / "set"), Robot())
    assert recording.name == "set episode 1"
    assert "warning: set episode 0 is set aside (--strict refuses it)" in reader.lines()[-1]
    assert "[W20]" in reader.lines()[-1]
    with pytest.raises(ValueError, match="found 5 samples"):
        LogReader([], strict=True).recordings(str(tmp_path / "set"), Robot())


def test_a_map_gives_units_signs_offsets_gear_ratios_currents_and_facts(tmp_path):
    (tmp_path / "map.toml").write_text(MAP)
    motor = (POS[:, 0] - 0.1) * 9.0 * -180 / np.pi
    header, columns = (
        ["clock", "m1", "m2", "c1", "c2", "i1"],
        [STAMPS / 1e6, motor, POS[:, 1], *HELD.T, np.full(COUNT, 2000.0)],
    )
    path = rows(header, columns, tmp_path / "leg.csv")
    chosen = read_map(tmp_path / "map.toml")
    (recording,) = load_recordings(path, ROBOT, chosen)
    check(recording, absolute=False)
    assert recording.dof_effort[0, 0] == pytest.approx(-9.0) and np.isnan(recording.dof_effort[:, 1]).all()
    assert recording.drive.stiffness.tolist() == [40.0, 40.0] and recording.drive.damping.tolist() == [1.0, 2.0]
    write_map(tmp_path / "again.toml", chosen)
    assert read_map(tmp_path / "again.toml") == chosen


def test_a_map_with_an_infinite_limit_and_a_long_rate_reads_back_the_same(tmp_path):
    source = Source(channel="q", unit="rad")
    facts = {"effort_limit": {"hip": np.inf, "knee": 3.0}, "velocity_limit": [np.inf, 2.0], "comment": "two"}
    columns = ColumnMap(joints={"hip": {"dof_pos": source}}, facts=facts, rate=1234.56789)
    write_map(tmp_path / "map.toml", columns)
    assert read_map(tmp_path / "map.toml") == columns


def test_a_list_column_whose_first_row_is_empty_is_read(tmp_path):
    rows_of_lists = [None, *POS[1:].tolist()]
    columns = {"q": pa.array(rows_of_lists), "cmd": pa.array(HELD.tolist()), "time": STAMPS / 1e9}
    parquet.write_table(pa.table(columns), tmp_path / "leg.parquet")
    (recording,) = load_recordings(tmp_path / "leg.parquet", ROBOT)
    assert recording.dof_pos == pytest.approx(POS[1:])


def test_a_map_may_have_a_joint_that_robot_and_log_lack(tmp_path):
    path = rows(["time", "hip pos", "hip cmd"], [STAMPS / 1e9, POS[:, 0], HELD[:, 0]], tmp_path / "leg.csv")
    entries = [f'[joints.{joint}]\ndof_pos = "{joint} pos"\ndes_dof_pos = "{joint} cmd"\n' for joint in ("hip", "grip")]
    (tmp_path / "map.toml").write_text("".join(entries))
    reader = LogReader([str(path)], read_map(tmp_path / "map.toml"))
    (recording,) = reader.recordings(str(path), Robot(joint_names=("hip",), wanted=("hip",)))
    assert recording.joint_names == ("hip",) and not any("grip" in line for line in reader.lines())


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("= 40.0", "= -1"), "stiffness of hip is -1"),
        (("[joints.knee]", "[joints.ankle]"), "has no dof_pos of knee"),
    ],
)
def test_what_is_wrong_with_a_map_is_told_with_its_name(tmp_path, change, expected):
    (tmp_path / "map.toml").write_text(MAP.replace(*change))
    header = ["clock", "m1", "m2", "c1", "c2", "i1"]
    path = rows(header, [STAMPS / 1e6, POS[:, 0], POS[:, 1], *HELD.T, np.zeros(COUNT)], tmp_path / "leg.csv")
    with pytest.raises(ValueError, match=rf"leg\.csv.*{expected}.*map\.toml"):
        load_recordings(path, ROBOT, read_map(tmp_path / "map.toml"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('unit = "deg"', 'unit = "degrees"'), ["joints.hip.dof_pos.unit is 'degrees'", "deg"]),
        (("sign = -1, gear", "sign = 2, gear"), ["sign", "1 or -1"]),
        (("factor = 0.5, ", ""), ["joints.hip.dof_effort", "current", "factor"]),
        (('dof_pos = {from = "m2"}', 'dof_poss = {from = "m2"}'), ["'dof_poss'", "did you mean 'dof_pos'"]),
        (('from = "m2"', 'unit = "rad"'), ["names no column"]),
        (('"c2"', '"c3"'), ["names 'c3'", "which the log has not", "c2"]),
        (("[joints.knee]", "[joints.kneee]"), ["no dof_pos of knee"]),
        (("stiffness = 40.0", "kp = 40.0"), ["'kp'", "did you mean 'stiffness'"]),
        (("[facts]", "[facts"), ["is not TOML"]),
    ],
)
def test_each_fault_of_a_map_has_its_message(tmp_path, change, words):
    (tmp_path / "map.toml").write_text(MAP.replace(*change))
    path = rows(
        ["clock", "m1", "m2", "c1", "c2", "i1"], [STAMPS / 1e6, *[POS[:, 1]] * 2, *HELD.T, STAMPS], tmp_path / "leg.csv"
    )
    with pytest.raises(ValueError, match=says(*words)):
        load_recordings(path, ROBOT, read_map(tmp_path / "map.toml"))


def test_axes_called_by_a_letter_and_a_slide_in_millimetres_are_told_apart(tmp_path):
    axes = Robot(joint_names=("A1 shoulder", "A2 elbow", "A3 z"))
    header = ["stamp_ns", "ref/A1", "ref/A2", "ref/A3_mm", "enc/A1_deg", "enc/A2_deg", "enc/A3_mm", "iq/A1", "iq/A2"]
    columns = [STAMPS, *HELD.T, 1e3 * HELD[:, 0], *(POS * 180 / np.pi).T, 1e3 * POS[:, 0], *POS.T]
    [found] = load_recordings(rows(header, columns, tmp_path / "scara.csv"), axes)
    np.testing.assert_allclose(found.dof_pos, np.column_stack([POS, POS[:, 0]]), atol=1e-6)
    np.testing.assert_allclose(found.des_dof_pos[:, 2], found.des_dof_pos[:, 0], atol=1e-6)
    [bare] = load_recordings(
        rows(["time", "A1_act", "A1_set"], [STAMPS / 1e9, POS[:, 0], HELD[:, 0]], tmp_path / "bare.csv"),
        Robot(joint_names=("A1",)),
    )
    np.testing.assert_allclose(bare.dof_pos[:, 0], POS[:, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "unit", "joint"),
    [
        ("slide_vel_m_s", "m/s", ("slide",)),
        ("speed mm/s", "mm/s", ()),
        ("M1_pos", "", ("m", "1")),
        ("tau_N_m_j1", "N m", ("j", "1")),
        ("motor_current_A_2", "A", ("motor", "2")),
        ("q_s1 [cm]", "cm", ("s", "1")),
    ],
)
def test_a_letter_is_a_unit_only_where_it_stands_as_one(name, unit, joint):
    said = meaning(name)
    assert (said.unit, said.joint) == (unit, joint)


def test_time_that_may_be_seconds_or_milliseconds_is_not_guessed(tmp_path):
    path = rows(["t", "hip pos", "hip cmd pos"], [np.arange(COUNT), POS[:, 0], HELD[:, 0]], tmp_path / "leg.csv")
    with pytest.raises(ValueError, match=says("steps by 1", "1 Hz, too slow", 'unit = "ms"')):
        load_recordings(path, Robot(joint_names=("hip",)))


def test_what_names_say_nothing_about_is_said_all_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = rows(["time", "a\x1b[31m", "b"], [STAMPS / 1e9, *POS.T], tmp_path / "leg.csv")
    with pytest.raises(ValueError, match=says("positions", "commands", "The log holds")) as error:
        load_recordings(path, ROBOT)
    assert "\x1b" not in str(error.value)
    template = (tmp_path / "leg_map.toml").read_text()  # nothing was guessed: what is wanted of each joint is shown
    assert template.count('# dof_pos = {from = "COLUMN"') == template.count("# des_dof_pos = ") == 2
    (tmp_path / "leg_map.toml").write_text(
        template.replace("# dof_pos", "dof_pos").replace("# des_dof_pos", "des_dof_pos").replace("COLUMN", "b")
    )
    assert read_map(tmp_path / "leg_map.toml").joints.keys() == set(ROBOT.joint_names)
    (tmp_path / "leg.csv").write_text("time,,b\n0,1,2\n")
    with pytest.raises(ValueError, match=says("column 2 has no name")):
        load_recordings(path, ROBOT)


def test_import_writes_what_it_understood_and_the_map_reproduces_the_guess(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    header = ["t_ms", "hip pos deg", "knee pos deg", "hip cmd deg", "knee cmd deg", "hip current A"]
    columns = [STAMPS / 1e6, *(POS * 180 / np.pi).T, *(HELD * 180 / np.pi).T, STAMPS]
    rows(header, columns, tmp_path / "log.csv")

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["import_log.py", *words])
        return run_cli(import_log.main), capsys.readouterr()

    status, said = call("log.csv", "--output", "leg.csv", "--write_map", "map.toml")
    assert status == 0 and "hip current A: a current" in said.out and "400 values at 250 Hz" in said.out
    first = load_recording("leg.csv")
    status, said = call("log.csv", "--output", "leg.csv", "--columns", "map.toml")
    assert status == 2 and "leg.csv, leg.json exist, and may be yours" in said.err
    status, _ = call("log.csv", "--output", "leg.csv", "--columns", "map.toml", "--overwrite")
    again = load_recording("leg.csv")
    assert status == 0 and np.array_equal(first.dof_pos, again.dof_pos)
    assert np.array_equal(first.des_dof_pos, again.des_dof_pos) and re.search("recording: leg.csv", said.out) is None
    status, said = call("leg.csv")
    assert status == 0 and "is a recording already" in said.out


@pytest.mark.skipif(not LOGS.is_dir(), reason="shared/cases is absent")
def test_one_leg_four_ways_is_one_recording():
    every = {
        name: understood(LOGS / name, ROBOT)[0].recording
        for name in ("leg_mcap", "leg_sqlite3", "odd_names.csv", "lerobot_leg")
    }
    bag = every.pop("leg_mcap")
    for recording in every.values():
        at = np.arange(0.1, 5.9, 0.02)
        for series in ("dof_pos", "des_dof_pos"):
            one, other = (
                np.stack([np.interp(at, r.time if r.des_time is None or series == "dof_pos" else r.des_time, c)
                          for c in getattr(r, series).T], axis=1) for r in (bag, recording)
            )  # fmt: skip
            assert np.abs(one - other).max() < (0.005 if series == "dof_pos" else 0.1)


def test_a_parquet_file_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    """4 MB of a constant took 5 GB and went on."""
    parquet.write_table(pa.table({"t": pa.nulls(10**6, pa.float64())}), tmp_path / "long.parquet")
    monkeypatch.setattr(tables, "_MOST_ROWS", 10**5)
    with pytest.raises(ValueError, match=r"long\.parquet: holds 1e\+06 rows; expected at most 1e\+05"):
        load_recordings(tmp_path / "long.parquet")
    monkeypatch.setattr(tables, "_MOST_ROWS", 10**8)
    monkeypatch.setattr("pace_actuators.memory.available_memory", lambda: 5e7)
    with pytest.raises(ValueError, match=r"long\.parquet: reading its 1e\+06 values would take 0\.064 GB of memory"):
        load_recordings(tmp_path / "long.parquet")


def test_a_long_trajectory_is_followed_in_parts(monkeypatch):
    spans = []

    def seen(time, values, at):
        spans.append(len(at))
        return np.interp(at, time, values[:, 0])[:, None]

    monkeypatch.setattr(rosbag, "interpolate_linear", seen)
    ends = [SimpleNamespace(sec=second, nanosec=0) for second in (0, 86_400)]
    points = [
        SimpleNamespace(positions=[float(k)], velocities=[], effort=[], time_from_start=end)
        for k, end in enumerate(ends)
    ]
    rows = rows_of(SimpleNamespace(joint_names=["hip"], points=points), "/plan")
    assert next(rows)[0] == 0 and sum(spans) <= 100_000  # memory is checked between parts


def test_a_trajectory_without_an_end_is_refused():
    def point(seconds):
        return SimpleNamespace(
            positions=[0.0], velocities=[], effort=[], time_from_start=SimpleNamespace(sec=seconds, nanosec=0)
        )

    message = SimpleNamespace(joint_names=["hip"], points=[point(0), point(10**9)])
    with pytest.raises(ValueError, match=r"/plan: a trajectory lasts 1e\+09 s, expected at most a day"):
        list(rows_of(message, "/plan"))


def test_arrays_of_any_names_take_their_joints_from_an_array_of_texts(tmp_path):
    time, joints = np.arange(400) / 200, ["hip", "knee"]
    position = 0.3 * np.sin(2 * time)[:, None] * [1.0, 0.5]
    arrays = {"t": time, "q": position, "q_des": position + 0.01, "joints": np.array(joints), "more": np.zeros(7)}
    np.savez(tmp_path / "log.npz", **arrays)
    (found,) = load_recordings(tmp_path / "log.npz")
    assert found.joint_names == tuple(joints) and np.allclose(found.dof_pos, position)
    assert np.allclose(found.des_dof_pos, position + 0.01)
    np.savez(tmp_path / "unnamed.npz", **{key: arrays[key] for key in ("t", "q", "q_des")})
    (found,) = load_recordings(tmp_path / "unnamed.npz", Robot(joint_names=joints))
    assert found.joint_names == tuple(joints) and np.allclose(found.dof_pos, position)


def test_german_names_are_read(tmp_path):
    time = np.arange(0, 4000, 20)
    rows = [f"{t};{30 * np.sin(0.002 * t):.3f};{30 * np.sin(0.002 * t):.3f}" for t in time]
    (tmp_path / "log.csv").write_text("\n".join(["Zeit [ms];Knie Ist [deg];Knie Soll [deg]", *rows]))
    (found,) = load_recordings(tmp_path / "log.csv")
    assert found.joint_names == ("Knie",) and found.time[1] == pytest.approx(0.02)
    assert np.allclose(found.des_dof_pos[:, 0], np.radians(30) * np.sin(0.002 * time), atol=1e-4)
