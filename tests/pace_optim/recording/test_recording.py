"""Recordings: what is read is what was written, every fault has its message, and the grid does not lie."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED
from recordings import CONTROL_DT, JOINTS, conform, fields_of, position, recording, says, written

from pace_optim.recording import (
    Drive,
    ImuPose,
    Load,
    Recording,
    load_recording,
    save_recording,
    validation_start,
)
from pace_optim.recording.time_base import hold_on_grid, interpolate_smooth


def full_recording() -> Recording:
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.004, 0.006, 60)) + 0.123456789
    return recording(
        time,
        dof_vel=rng.standard_normal((60, 3)),
        dof_effort=rng.standard_normal((60, 3)) * 1e-7,
        torque_enable=np.arange(60) < 30,
        drive=Drive(stiffness=np.array([20.0, 21.0, 1 / 3]), velocity_limit=np.full(3, np.inf)),
        load=Load(added_mass={"shank": 0.1}, load_mass=1 / 7, arm_mass=0.0),
    )


def walking_recording(**changes) -> Recording:
    """Of a robot whose base moves."""
    rng = np.random.default_rng(1)
    series = {
        "base_ang_vel": rng.standard_normal((400, 3)),
        "base_lin_acc": rng.standard_normal((400, 3)) + [0, 0, 9.81],
        "base_quat": np.tile([1.0, 0.0, 0.0, 0.0], (400, 1)),
        "contact": rng.random((400, 2)) < 0.5,
        "foot_force": rng.standard_normal((400, 2, 3)),
        "feet": ("left", "right"),
        "imu": ImuPose(body="base", pos=(0.1, 0.0, 0.02), quat=(0.0, 1.0, 0.0, 0.0)),
    }
    return recording(**{**series, **changes})


def assert_same(one, other, ignore=()):
    for field in fields(one):
        if field.name in ignore:
            continue
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, (Drive, Load)):
            assert_same(a, b)
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and np.array_equal(a, b), field.name
        else:
            assert a == b, field.name


# Files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".pt", ".npz", ".csv", ".NPZ"])
@pytest.mark.parametrize("make", [recording, full_recording, walking_recording])
def test_a_recording_survives_a_round_trip_bit_for_bit(tmp_path, suffix, make):
    saved = make()
    path = save_recording(tmp_path / f"other{suffix}", saved)
    assert_same(saved, load_recording(path), ignore=("source",))
    assert not list(tmp_path.glob("*.tmp"))


@pytest.mark.parametrize("suffix", [".pt", ".npz", ".csv"])
def test_a_failed_write_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = save_recording(tmp_path / f"leg{suffix}", recording())
    before = path.read_bytes()

    def full_disk(*_):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(OSError, match="disk full"):
        save_recording(path, full_recording())
    assert path.read_bytes() == before and not list(tmp_path.glob(".*.tmp"))


def test_float32_samples_and_one_joint_without_columns_are_read_exactly(tmp_path):
    time = (CONTROL_DT * np.arange(100)).astype(np.float32)
    pos = position(time, 1)[:, 0].astype(np.float32)
    path = written(tmp_path, time=time, dof_pos=pos, des_dof_pos=pos, joint_names=None)
    loaded = load_recording(path)
    assert loaded.dof_pos.shape == (100, 1) and loaded.joint_names == () and loaded.name == "leg"
    assert np.array_equal(loaded.dof_pos[:, 0], pos.astype(np.float64))


def test_facts_may_be_a_number_a_list_or_a_dict_by_joint(tmp_path):
    path = written(
        tmp_path, stiffness=20, damping=[1.0, 2.0, 3.0], effort_limit={"ankle": 3.0, "hip": 1.0, "knee": 2.0}
    )
    drive = load_recording(path).drive
    assert drive.stiffness.tolist() == [20.0, 20.0, 20.0]
    assert drive.damping.tolist() == drive.effort_limit.tolist() == [1.0, 2.0, 3.0]
    assert drive.velocity_limit is None


@pytest.mark.parametrize("suffix", [".pt", ".npz", ".csv"])
def test_facts_may_lie_in_a_json_beside_any_format(tmp_path, suffix):
    path = save_recording(tmp_path / f"leg{suffix}", recording())
    facts = {
        "name": "leg",
        "stiffness": {"hip": 1, "knee": 2, "ankle": 3},
        "added_mass": {"foot": 0.5},
        "comment": "x",
    }
    path.with_suffix(".json").write_text(json.dumps(facts))
    loaded = load_recording(path)
    assert loaded.drive.stiffness.tolist() == [1.0, 2.0, 3.0] and loaded.load.added_mass == {"foot": 0.5}


def test_unknown_columns_are_noted_and_columns_may_come_in_any_order(tmp_path):
    rows = ["torque_enable/b,des_dof_pos/b,torsion/b,time,dof_pos/a,dof_pos/b,des_dof_pos/a,torque_enable/a"]
    rows += [f"{i % 2},{i + 0.5},7.3,{i * 0.0025},{i},{-i},{i + 0.25},{i % 2}" for i in range(30)]
    (path := tmp_path / "leg.csv").write_text("\ufeff" + "\n".join(rows) + "\n")
    loaded = load_recording(path)
    assert loaded.joint_names == ("a", "b")
    assert loaded.des_dof_pos[3].tolist() == [3.25, 3.5] and loaded.dof_pos[3].tolist() == [3.0, -3.0]
    assert loaded.torque_enable.tolist() == [bool(i % 2) for i in range(30)]
    assert any("torsion" in note for note in loaded.notes)


def test_feet_of_one_force_each_are_columns_of_their_names(tmp_path):
    saved = walking_recording(contact=None, foot_force=np.arange(800.0).reshape(400, 2))
    path = save_recording(tmp_path / "walk.csv", saved)
    path.with_suffix(".json").unlink()
    loaded = load_recording(path)
    assert loaded.feet == ("left", "right") and np.array_equal(loaded.foot_force, saved.foot_force)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"base_ang_vel": np.zeros((100, 3))}, ("base_ang_vel without base_lin_acc", "Add it")),
        ({"base_lin_acc": np.zeros((100, 2))}, ("(100, 2)", "(100, 3)")),
        ({"gyroscope": np.zeros((100, 3))}, ("gyroscope", "base_ang_vel")),
        ({"contact": np.zeros((100, 2))}, ("without feet", "2 columns")),
        ({"contact": np.full((100, 2), 3.0), "feet": ["a", "b"]}, ("0 and 1", "foot_force")),
        ({"contact": np.zeros((100, 2)), "feet": ["a"]}, ("expected 2 different names",)),
        ({"contact": np.zeros((100, 2)), "feet": ["a", "b"]}, ("without base_ang_vel and base_lin_acc",)),
        ({"imu": {"body": "base", "pos": [1, 2]}}, ("imu.pos", "expected 3 numbers")),
        ({"imu": {"site": "imu"}}, ("the name of a site", "{body, pos, quat}")),
        ({"imu": {"body": "base", "quat": [1, 1, 0, 0]}}, ("imu.quat", "length 1")),
    ],
)
def test_what_is_wrong_with_a_base_that_moves_is_said(tmp_path, changes, words):
    with pytest.raises(ValueError, match=says(*words)):
        load_recording(written(tmp_path, **changes))


def test_contacts_keep_to_the_nearest_sample_and_an_imu_is_interpolated():
    time = np.arange(400) * 0.003
    walk = walking_recording(time=time, dof_pos=position(time), des_dof_pos=position(time))
    walk = replace(walk, base_ang_vel=np.stack([time, -time, 2 * time], axis=1))
    conformed = conform(walk)
    assert conformed.base_ang_vel == pytest.approx(np.outer(conformed.time, [1, -1, 2]), abs=1e-12)
    at = conformed.time / 0.003
    clear = np.abs(at % 1 - 0.5) > 1e-6
    assert np.array_equal(conformed.contact[clear], walk.contact[np.round(at[clear]).astype(int)])


# Faults of files --------------------------------------------------------------------------------------------


def test_a_missing_file_is_named_with_its_neighbours(tmp_path):
    save_recording(tmp_path / "there.npz", recording())
    with pytest.raises(ValueError, match=says("leg.pt", "no such file", "there.npz")):
        load_recording(tmp_path / "leg.pt")


@pytest.mark.parametrize("call", [load_recording, lambda path: save_recording(path, recording())])
def test_an_unsupported_suffix_is_refused(tmp_path, call):
    with pytest.raises(ValueError, match=says("leg.mat", "'.mat'", ".pt, .npz, .csv")):
        call(tmp_path / "leg.mat")


@pytest.mark.parametrize("suffix", [".pt", ".npz"])
@pytest.mark.parametrize("damage", ["cut", "text", "empty"])
def test_a_damaged_file_is_said_to_be_unreadable(tmp_path, suffix, damage):
    path = save_recording(tmp_path / f"leg{suffix}", recording())
    content = path.read_bytes()
    path.write_bytes({"cut": content[: len(content) // 2], "text": b"hello world", "empty": b""}[damage])
    with pytest.raises(ValueError, match=says(str(path), "cannot be read")):
        load_recording(path)


def test_files_with_python_objects_are_refused(tmp_path):
    torch.save({"time": np.zeros(3)}, tmp_path / "leg.pt")
    with pytest.raises(ValueError, match=says("leg.pt", "Python objects", "torch.save(")):
        load_recording(tmp_path / "leg.pt")
    np.savez(tmp_path / "leg.npz", time=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=says("leg.npz", "Python objects")):
        load_recording(tmp_path / "leg.npz")
    torch.save(torch.zeros(3), tmp_path / "leg.pt")
    with pytest.raises(ValueError, match=says("holds a Tensor", "expected a dict")):
        load_recording(tmp_path / "leg.pt")


HEADER = "time,dof_pos/hip,des_dof_pos/hip\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["is empty"]),
        (HEADER.replace(",", ";") + "0;1;2\n", ["one column", "commas"]),
        (HEADER + "0,1,2\n0.1,1\n", ["row 3", "2 cells", "3"]),
        (HEADER + "0,1,2\n0.1,abc,2\n", ["row 3", "dof_pos/hip", "'abc'", "number"]),
        (HEADER + "0,1,2\n0.1,,2\n", ["row 3", "dof_pos/hip", "''"]),
        ("time,dof_pos,des_dof_pos/hip\n0,1,2\n", ["names no joint", "'dof_pos/<joint>'"]),
        ("time,dof_pos/hip,dof_pos/hip\n0,1,2\n", ["dof_pos/hip", "twice"]),
        ("time,dof_pos/hip,des_dof_pos/knee\n0,1,2\n", ["knee", "hip", "same joints"]),
        ("stamp,dof_pos/hip,des_dof_pos/hip\n0,1,2\n", ["'stamp'", "did you mean 'time'?"]),
        ("time,angle/hip,goal/hip\n0,1,2\n", ["dof_pos, des_dof_pos missing", "angle/hip, goal/hip"]),
        ("time,des_dof_pos/hip,goal/hip\n0,1,2\n", ["dof_pos missing", "goal/hip"]),
    ],
)
def test_each_fault_of_a_csv_has_its_message(tmp_path, text, words):
    (path := tmp_path / "leg.csv").write_text(text)
    with pytest.raises(ValueError, match=says(str(path), *words)):
        load_recording(path)


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ("{", ["leg.json", "is not JSON", "leg.pt"]),
        ("[1]", ["leg.json", "holds a list"]),
        ('{"stifness": 20}', ["unknown fact 'stifness'", "did you mean 'stiffness'?"]),
        ('{"dampign": 20}', ["unknown fact 'dampign'", "did you mean 'damping'?"]),
        ('{"weather": "rain"}', ["unknown fact 'weather'", "stiffness", "'comment'"]),
        ('{"joint_names": ["a", "b", "c"]}', ["joint_names differs", "leg.pt"]),
    ],
)
def test_each_fault_of_the_json_has_its_message(tmp_path, facts, words):
    path = written(tmp_path)
    path.with_suffix(".json").write_text(facts)
    with pytest.raises(ValueError, match=says(*words)):
        load_recording(path)


# Faults of content ------------------------------------------------------------------------------------------

T = 100
FINE = fields_of()


def changed(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"des_dof_pos": None}, ["des_dof_pos missing", "Found: time, dof_pos, joint_names"]),
        ({"dof_poss": FINE["dof_pos"], "dof_pos": None}, ["'dof_poss'", "did you mean 'dof_pos'?"]),
        ({"kp": 20.0}, ["'kp'", "did you mean 'stiffness'?"]),
        ({"time": FINE["time"][:, None]}, ["time has shape (100, 1)", "(T,)"]),
        ({"dof_pos": FINE["dof_pos"].T}, ["dof_pos has shape (3, 100)", "100 samples", "Transpose"]),
        ({"dof_vel": FINE["dof_pos"][:99]}, ["dof_vel has shape (99, 3)", "100 samples", "same length"]),
        ({"dof_pos": FINE["dof_pos"][None]}, ["dof_pos has shape (1, 100, 3)", "(T, n)"]),
        ({"des_dof_pos": FINE["dof_pos"][:, :2]}, ["des_dof_pos has 2 columns", "dof_pos has 3"]),
        ({"dof_pos": ["a"] * T}, ["dof_pos holds", "not numbers"]),
        (
            {"dof_pos": changed(FINE["dof_pos"], (7, 1), np.nan)},
            ["dof_pos has 1 values", "sample 7, joint knee"],
        ),
        ({"time": changed(FINE["time"], 9, np.inf)}, ["time has 1 values", "sample 9"]),
        ({k: FINE[k][:5] for k in ("time", "dof_pos", "des_dof_pos")}, ["found 5 samples", "at least 20"]),
        ({"time": changed(FINE["time"], 9, FINE["time"][8])}, ["does not increase at sample 9", "repeated"]),
        ({"time": (1.7e9 + FINE["time"]).astype(np.float32)}, ["does not increase", "float32"]),
        ({"time": FINE["time"] * 1e3}, ["looks like milliseconds", "Divide time by 1000"]),
        ({"time": FINE["time"] * 1e6}, ["looks like microseconds"]),
        ({"time": np.arange(T) * 2_500_000}, ["looks like nanoseconds"]),
        ({"torque_enable": FINE["time"]}, ["torque_enable", "true and false"]),
        ({"torque_enable": np.ones(99, bool)}, ["torque_enable has shape (99,)", "(100,)"]),
        ({"torque_enable": FINE["dof_pos"] > 0}, ["torque_enable has shape (100, 3)", "some joints are off"]),
        ({"joint_names": "hip"}, ["joint_names is 'hip'", "list"]),
        ({"joint_names": ["hip", "knee"]}, ["joint_names has 2 names", "3 columns"]),
        ({"joint_names": ["hip", "knee", "hip"]}, ["joint_names repeats hip"]),
        ({"name": 3}, ["name is 3", "expected text"]),
        ({"stiffness": [1.0, -2.0, 3.0]}, ["stiffness of knee is -2", "zero or more"]),
        ({"stiffness": float("inf")}, ["stiffness of hip is inf", "finite"]),
        ({"velocity_limit": 0.0}, ["velocity_limit of hip is 0", "more than zero"]),
        ({"damping": [1.0, 2.0]}, ["damping has shape (2,)", "3"]),
        ({"damping": "soft"}, ["damping is 'soft'", "a number"]),
        ({"damping": {"hip": 1.0, "kne": 2.0}}, ["'kne'", "did you mean 'knee'?"]),
        ({"damping": {"hip": 1.0}}, ["damping has no value for knee, ankle"]),
        ({"damping": {"hip": 1.0}, "joint_names": None}, ["no joint_names", "list"]),
        ({"added_mass": 3.0}, ["added_mass is 3.0", "{body: kg}"]),
        ({"added_mass": "foot"}, ["added_mass is 'foot'", "JSON"]),
        ({"added_mass": {"foot": -1.0}}, ["added_mass of foot is -1"]),
        ({"load_length": 0.0}, ["load_length is 0", "more than zero"]),
        ({"load_mass": [1.0, 2.0]}, ["load_mass is [1.0, 2.0]", "one number"]),
    ],
)
def test_each_fault_of_the_content_has_its_message(tmp_path, changes, words):
    path = written(tmp_path, **changes)
    with pytest.raises(ValueError, match=says(str(path), *words)):
        load_recording(path)


def test_keys_that_are_not_ours_are_noted(tmp_path):
    assert "humidity" in load_recording(written(tmp_path, humidity=30.0)).notes[0]


# Against the robot ------------------------------------------------------------------------------------------


LIMITS = np.array([[-1.0, 1.0], [-1.0, 1.0], [-np.inf, np.inf]])
DEGREES = 180.0 / np.pi


@pytest.mark.parametrize(
    ("changes", "arguments", "words"),
    [
        ({}, {"joint_order": ("hip", "knie", "ankle")}, ["unknown joint 'knee', did you mean 'knie'?"]),
        (
            {},
            {"joint_order": ("hip", "ankle"), "undriven": {"knee"}},
            ["the joint 'knee' has no drive in the model: give it a transmission (URDF) or an actuator (MJCF)."],
        ),
        ({}, {"joint_order": ("hip", "knee")}, ["'ankle'", "3 joints", "the robot has 2"]),
        ({}, {"joint_order": (*JOINTS, "toe")}, ["no column for toe", "3 joints", "the robot has 4"]),
        ({"notes": ("Not used: to_pos.",)}, {"joint_order": (*JOINTS, "toe")}, ["for toe.", "Not used: to_pos."]),
        ({"joint_names": ()}, {"joint_order": ("hip", "knee")}, ["3 joints", "2 (hip, knee)"]),
        ({"des_dof_pos": recording().des_dof_pos * [1, np.nan, 1]}, {}, ["knee: no command", "--joints"]),
        ({}, {"joint_order": ("hip", "hip", "knee")}, ["joint_order names a joint twice"]),
        ({}, {"control_dt": 0.0}, ["control_dt is 0.0"]),
        ({"dof_pos": recording().dof_pos + 1.0}, {}, ["dof_pos of", "limits", "column order"]),
        ({"dof_pos": recording().dof_pos * DEGREES}, {}, ["dof_pos of", "degrees", "pi/180"]),
        ({"des_dof_pos": recording().dof_pos * DEGREES}, {}, ["des_dof_pos of", "degrees"]),
        ({}, {"joint_pos_limits": LIMITS[:2]}, ["joint_pos_limits has shape (2, 2)", "(3, 2)"]),
        (
            {"dof_pos": np.angle(np.exp(1j * 20 * recording().time[:, None])) * [0, 0, 1]},
            {},
            ["dof_pos of ankle jumps", "wraps", "unwrap"],
        ),
        (
            {"load": Load(added_mass={"fot": 1.0})},
            {"load_bodies": ("foot",)},
            ["'fot'", "did you mean 'foot'?"],
        ),
        ({"load": Load(added_mass={"foot": 1.0})}, {}, ["'foot'", "take a mass: none"]),
        ({"load": Load(load_mass=1.0)}, {}, ["load_mass", "test bench"]),
        ({"time": np.linspace(0.0, 30.0, 400)}, {}, ["75.2 ms", "at least 20 Hz"]),
        (
            {"time": recording().time + 0.6 * (np.arange(400) > 99)},
            {},
            ["gap of 0.60", "sample 99", "two recordings"],
        ),
    ],
)
def test_each_misfit_with_the_robot_has_its_message(changes, arguments, words):
    words = [word.replace("75.2 ms", "0.0752 s") for word in words]
    with pytest.raises(ValueError, match=says(*words)):
        conform(recording(**changes), **{"joint_pos_limits": LIMITS, **arguments})


def test_what_is_odd_but_possible_is_noted():
    odd = recording(joint_names=())
    pos, des = odd.dof_pos.copy(), odd.des_dof_pos.copy()
    pos[:, 0], des[:, 1], des[:, 2] = 0.0, 0.0, des[:, 2] + 1.0
    conformed = conform(
        replace(odd, dof_pos=pos, des_dof_pos=des, torque_enable=np.arange(400) >= 100),
        joint_pos_limits=np.array([[-1.0, 1.0]] * 3),
    )
    for words in (
        "no joint_names: its columns were taken to be hip, knee, ankle",
        "hip: moves less than",
        "knee: moves although its command never changes",
        "ankle: starts more than 0.5 rad from its target",
        "ankle: commanded beyond the joint limits",
        "off in 25% of the samples",
    ):
        assert any(words in note for note in conformed.notes), (words, conformed.notes)


@pytest.mark.parametrize("sample", [150, 250])
def test_a_joint_that_swings_beyond_its_limit_is_kept_with_a_warning(sample):
    pos = recording().dof_pos.copy()
    swing = 3.0 * np.exp(-0.5 * ((np.arange(400) - sample) / 20) ** 2)
    pos[:, 1] += swing
    (note,) = (note for note in conform(recording(dof_pos=pos), joint_pos_limits=LIMITS).notes if "[W2]" in note)
    assert note.startswith(f"knee reaches {pos[:, 1].max():.3f}, beyond its limit of {LIMITS[1, 1]:.3f} rad")
    assert "Correct the limit in the model file" in note


def test_a_stated_unit_keeps_one_joint_beyond_its_limit_and_not_all(tmp_path):
    beyond = recording(dof_pos=recording().dof_pos + [0, 3.0, 0], des_dof_pos=recording().des_dof_pos + [0, 3.0, 0])
    with pytest.raises(ValueError, match="dof_pos of knee goes from"):
        conform(beyond, joint_pos_limits=LIMITS)
    stated = replace(beyond, unit_stated=tuple(JOINTS))
    assert any("knee reaches" in note for note in conform(stated, joint_pos_limits=LIMITS).notes)
    with pytest.raises(ValueError, match="dof_pos of"):
        conform(replace(stated, dof_pos=recording().dof_pos + 3.0), joint_pos_limits=LIMITS)


@pytest.mark.parametrize("joint_type", ["hinge", "slide"])
def test_a_slide_may_pass_its_limit_by_a_tenth_of_what_a_hinge_may(joint_type):
    limits = np.stack([recording().dof_pos.min(axis=0), recording().dof_pos.max(axis=0)], axis=1)
    moved = recording(dof_pos=recording().dof_pos + 0.05, des_dof_pos=recording().des_dof_pos + 0.05)
    arguments = {"joint_pos_limits": limits, "joint_types": (joint_type,) * 3}
    if joint_type == "hinge":
        conform(moved, **arguments)
    else:
        with pytest.raises(ValueError, match=r"the joint's limits \(and at most 0.02 beyond\)"):
            conform(moved, **arguments)


def test_a_multi_turn_joint_without_limits_is_noted_not_refused():
    notes = conform(recording(dof_pos=recording().dof_pos * DEGREES)).notes
    assert any("If they look like degrees" in note for note in notes)


def test_columns_and_facts_follow_the_joint_order():
    drive = Drive(stiffness=np.array([1.0, 2.0, 3.0]))
    vel = recording().dof_pos * 2.0
    conformed = conform(recording(drive=drive, dof_vel=vel), joint_order=("ankle", "hip", "knee"))
    assert conformed.joint_names == ("ankle", "hip", "knee")
    for key in ("dof_pos", "des_dof_pos"):
        assert np.array_equal(getattr(conformed, key), getattr(recording(), key)[:, [2, 0, 1]])
    assert np.array_equal(conformed.dof_vel, vel[:, [2, 0, 1]])
    assert np.array_equal(conformed.command, conformed.des_dof_pos)
    assert conformed.drive.stiffness.tolist() == [3.0, 1.0, 2.0]


def test_loads_that_the_robot_takes_are_kept():
    load = Load(added_mass={"foot": 0.5}, load_mass=1.0)
    assert conform(recording(load=load), load_bodies=("foot",), accepts_load=True).load is load


# The time base ----------------------------------------------------------------------------------------------

EVEN = CONTROL_DT * np.arange(400)


@pytest.mark.parametrize(
    "time",
    [
        EVEN,
        EVEN + 1.7e9,
        EVEN.astype(np.float32).astype(np.float64),
        (EVEN + 3000.0).astype(np.float32).astype(np.float64),
        np.round(EVEN, 3),
        np.round(EVEN + 0.0317, 3),
        EVEN + 1e-5 * np.sin(np.arange(400.0) ** 2),
        EVEN * (1.0 + 2e-4),
        np.linspace(0.0, 1.0, 400),
    ],
    ids=[
        "grid",
        "epoch",
        "float32",
        "late float32",
        "ms",
        "offset ms",
        "1 % jitter",
        "slow clock",
        "linspace",
    ],
)
def test_an_even_recording_is_kept_bit_for_bit(time):
    saved = recording(time, dof_pos=position(EVEN), des_dof_pos=position(EVEN + 0.01))
    conformed = conform(saved)
    assert conformed.sample_stride == 1
    assert np.array_equal(conformed.time, EVEN)
    for key in ("dof_pos", "des_dof_pos"):
        assert np.array_equal(getattr(conformed, key), getattr(saved, key))
    assert np.array_equal(conformed.command, saved.des_dof_pos)
    assert not any("Resampled" in note for note in conformed.notes)
    assert any("400" in note and "ms" in note for note in conformed.notes)


@pytest.mark.parametrize(
    "time",
    [
        EVEN * 1.002,
        EVEN * (1.0 - 5e-4),
        EVEN + 5e-4 * np.sin(np.arange(400.0) ** 2),
        EVEN + 0.01 * (EVEN > 0.5),
    ],
    ids=["wrong rate", "drift", "jitter", "gap"],
)
def test_an_uneven_recording_is_resampled_and_says_so(time):
    conformed = conform(recording(time))
    assert any("Resampled to 2.5 ms" in note for note in conformed.notes)
    assert np.array_equal(conformed.time, CONTROL_DT * np.arange(conformed.num_samples))
    assert conformed.duration <= time[-1] - time[0] + 1e-12
    assert np.abs(conformed.dof_pos - position(conformed.time)).max() < 3e-3


def test_a_gap_is_noted():
    notes = conform(recording(EVEN + 0.1 * (EVEN > 0.5))).notes
    assert any("1 gap(s)" in note and "102.5 ms" in note and "0.500 s" in note for note in notes)


def test_resampling_a_jittered_chirp_stays_below_encoder_noise():
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.0045, 0.0062, 3000))
    time -= time[0]

    def chirp(t):
        return 0.5 * np.sin(2 * np.pi * (0.1 * t + 0.15 * t**2))[:, None] * np.ones(3)

    conformed = conform(recording(time, dof_pos=chirp(time), dof_vel=chirp(time), dof_effort=chirp(time)))
    assert conformed.sample_stride == 2
    assert np.sqrt(np.mean((conformed.dof_pos - chirp(conformed.time)) ** 2)) < 1e-4
    assert np.array_equal(conformed.dof_pos, conformed.dof_vel)
    measured = conformed.time + conformed.effort_offset * CONTROL_DT  # each torque is the one that was measured next
    assert np.allclose(conformed.dof_effort, chirp(measured), atol=1e-3) and conformed.effort_offset.min() >= 0


def test_a_smooth_interpolation_is_exact_for_parabolas_and_does_not_amplify_noise():
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.5, 1.5, 200))
    at = rng.uniform(time[1], time[-2], 1000)
    parabola = interpolate_smooth(time, (time**2 - 7.0 * time)[:, None], at)
    assert np.allclose(parabola[:, 0], at**2 - 7.0 * at, atol=1e-9)
    pairs = np.sort(np.concatenate([np.arange(100.0), np.arange(100.0) + 1e-4]))  # samples that nearly coincide
    noise = rng.uniform(-1.0, 1.0, (200, 1))
    assert np.abs(interpolate_smooth(pairs, noise, rng.uniform(0.0, 99.0, 5000))).max() < 1.5


def test_half_the_control_rate_gives_stride_two_and_held_commands():
    saved = recording(0.005 * np.arange(200), torque_enable=np.arange(200) % 3 > 0)
    conformed = conform(saved)
    assert conformed.sample_stride == 2 and np.array_equal(conformed.dof_pos, saved.dof_pos)
    assert conformed.command.shape == (399, 3) and conformed.command_torque_enable.shape == (399,)
    assert np.array_equal(conformed.command[::2], saved.des_dof_pos)
    assert np.array_equal(conformed.command[1::2], saved.des_dof_pos[:-1])
    assert np.array_equal(conformed.command_torque_enable[1::2], saved.torque_enable[:-1])


@pytest.mark.parametrize("period", [0.0502, 0.0111, 1 / 22.3])
def test_a_timer_of_another_rate_keeps_its_samples_beside_the_grid(period):
    saved = recording(period * np.arange(100), torque_enable=np.arange(100) % 3 > 0)
    conformed = conform(saved)
    assert np.array_equal(conformed.dof_pos, saved.dof_pos) and np.allclose(conformed.time, saved.time, atol=1e-12)
    assert np.array_equal(conformed.des_dof_pos, saved.des_dof_pos)
    assert np.abs(conformed.sample_offset).max() <= 0.5
    assert np.allclose((conformed.sample_steps + conformed.sample_offset) * CONTROL_DT, saved.time)
    assert conformed.command.shape == (conformed.sample_steps[-1] + 1, 3)
    assert np.array_equal(conform(conformed).command, conformed.command)
    assert any("keep their instants" in note for note in conformed.notes)


def test_torques_of_a_timer_of_another_rate_are_resampled():
    """What they say of the drive is read from even samples."""
    saved = recording(0.0502 * np.arange(100), dof_effort=np.ones((100, 3)))
    assert conform(saved).sample_at is None


def test_a_finer_recording_is_thinned_and_says_what_is_lost():
    time = 0.001 * np.arange(1001)
    conformed = conform(recording(time))
    assert conformed.sample_stride == 1 and conformed.num_samples == 401
    assert any("finer than the control step" in note for note in conformed.notes)
    assert np.abs(conformed.dof_pos - position(conformed.time)).max() < 1e-5
    kept = conform(recording(time), control_dt=0.001)
    assert np.array_equal(kept.dof_pos, position(time))


def test_commands_hold_between_uneven_samples():
    time = np.concatenate([[0.0, 0.0051, 0.0109], 0.0175 + 0.005 * np.arange(40)])
    values = np.arange(43.0)[:, None] * np.ones(3)
    conformed = conform(recording(time, des_dof_pos=values, torque_enable=np.arange(43) % 2 == 0))
    assert conformed.sample_stride == 2
    expected = [0.0, 0.0, 0.96, 1.0, 1.64, 2.0, 2.0, 3.0]  # 1 comes 4 % into step 2, 2 comes 36 % into step 4
    assert np.allclose(conformed.command[:8, 0], expected)
    assert conformed.command_torque_enable[:8].tolist() == [True, True, False, False, True, True, True, False]
    assert np.array_equal(conformed.command[::2], conformed.des_dof_pos)
    assert np.array_equal(conformed.command_torque_enable[::2], conformed.torque_enable)


def test_a_hold_on_the_grid_keeps_the_area_of_the_hold():
    rng = np.random.default_rng(3)
    time = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 2.0, 100))])
    values = rng.standard_normal((101, 2))
    count = int(time[-1] / 0.3)
    held = hold_on_grid(time, values, 0.3, count)
    until = np.append(np.minimum(time[1:], count * 0.3), count * 0.3)
    assert np.allclose(held.sum(axis=0) * 0.3, (values * np.maximum(until - time, 0.0)[:, None]).sum(axis=0))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    rate=st.floats(60.0, 900.0),
    jitter=st.floats(0.0, 0.4),
    start=st.floats(-10.0, 1e4),
    seed=st.integers(0, 1000),
)
def test_conforming_twice_changes_nothing(rate, jitter, start, seed):
    rng = np.random.default_rng(seed)
    time = start + (np.arange(100) + jitter * rng.uniform(-1.0, 1.0, 100)) / rate
    once = conform(recording(time, torque_enable=rng.uniform(size=100) > 0.2))
    assert len(once.command) == once.sample_steps[-1] + 1
    if once.sample_at is None:  # else commands arrive within a step
        assert len(once.command) == (once.num_samples - 1) * once.sample_stride + 1
        assert np.array_equal(once.command[:: once.sample_stride], once.des_dof_pos)
    assert once.command.min() >= recording(time).des_dof_pos.min() - 1e-9
    assert once.command.max() <= recording(time).des_dof_pos.max() + 1e-9
    assert_same(once, conform(once), ignore=("notes",))
    with pytest.raises(ValueError, match=says("already on a control step", "Conform the loaded")):
        conform(once, control_dt=0.7 * CONTROL_DT)


@pytest.mark.parametrize("suffix", [".pt", ".npz", ".csv"])
def test_a_conformed_recording_can_be_saved_and_conformed_again(tmp_path, suffix):
    conformed = conform(recording())
    again = conform(load_recording(save_recording(tmp_path / f"leg{suffix}", conformed)))
    assert_same(conformed, again, ignore=("source", "notes"))


def test_validation_starts_at_the_given_share_of_the_samples():
    assert validation_start(recording()) == 280
    assert validation_start(recording(), 0.999999) == 399
    for fraction in (0.0, 1.0, 70):
        with pytest.raises(ValueError, match=says("leg", f"{fraction}", "between 0 and 1")):
            validation_start(recording(), fraction)


# Real recordings --------------------------------------------------------------------------------------------

needs_measurements = pytest.mark.skipif(not (SHARED / "measurements").is_dir(), reason="shared/measurements is absent")
GO2_JOINTS = [f"{leg}_{joint}_joint" for leg in ("FL", "FR", "RL", "RR") for joint in ("hip", "thigh", "calf")]


@needs_measurements
def test_the_go2_recording_is_kept_exactly_at_half_the_control_rate():
    loaded = load_recording(SHARED / "measurements/go2/traj_0.pt")
    conformed = conform(loaded, joint_order=GO2_JOINTS)
    assert conformed.sample_stride == 2 and conformed.num_samples == 4698
    assert np.array_equal(conformed.dof_pos, loaded.dof_pos)
    assert any("one step too many" in note for note in conformed.notes)
    assert any("no joint_names" in note for note in conformed.notes)


@needs_measurements
@pytest.mark.parametrize(
    ("path", "stride"),
    [("xl330/kp400_sin_sin.csv", 2), ("sts3250/kp32_sin_sin.csv", 8)],
)
def test_uneven_real_recordings_are_resampled(path, stride):
    loaded = load_recording(SHARED / "measurements" / path)
    conformed = conform(loaded, joint_order=loaded.joint_names)
    assert conformed.sample_stride == stride
    assert any("Resampled" in note for note in conformed.notes)
    assert abs(conformed.duration - loaded.duration) < 2 * stride * CONTROL_DT
