"""Joints keep their names, whatever words these have: an index finger, a wheel's current, a state."""

import json
import re

import numpy as np
import pytest
from log_reading import understood
from places import ROOT, SHARED

from pace_optim.recording.logs import Robot, read_map, write_map

TIME = np.arange(400) / 200
WORDS = (
    "index_q1", "thumb_q1", "ring_q1", "left_index", "index", "motor_3", "state_joint", "wheel_current", "target_pan",
    "id_joint", "count_wheel", "time_joint", "load_arm", "foot_left", "frame_tilt", "last_link", "task_axis", "q1",
    "j1",
    "A1", "rev_joint", "joint_a", "leftHip", "l_hip", "shoulder.pan", "angle_joint", "pos_joint", "head_pos",
    "speed_wheel", "limit_switch_arm", "min_arm", "pose_3", "tcp", "enable_arm", "kp_joint", "volt_wheel",
)  # fmt: skip
ONLY_WORDS = ("state", "current", "target", "position", "force", "input")
"""Which a log without a robot cannot show to be names."""


def names_of_models() -> list[str]:
    """The joints of the robots of this project and of the shared ones."""
    of_assets = [
        name
        for path in sorted((ROOT / "assets").glob("*/*.xml"))
        for name in re.findall(r'<joint [^>]*?name="([^"]+)"', path.read_text())
    ]
    of_shared = []
    for path in sorted((SHARED / "robots").glob("*.json")) if (SHARED / "robots").is_dir() else []:
        of_shared += [joint["name"] for joint in json.loads(path.read_text()).get("joints", [])]
    return list(dict.fromkeys([*of_assets, *of_shared]))


def log_of(path, names, position="{}_pos", command="{}_cmd", **more):
    columns = {"time": TIME}
    for k, name in enumerate(names):
        columns[position.format(name)] = 0.5 * np.sin((3 + 0.1 * k) * TIME)
    for k, name in enumerate(names):
        columns[command.format(name)] = 0.5 * np.sin((3 + 0.1 * k) * TIME + 0.1)
    columns |= more
    rows = [",".join(f"{cell:.6f}" for cell in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]))
    return path


def read_back(path, names, robot):
    (found,) = understood(path, robot)
    assert found.recording.joint_names == tuple(names)
    assert found.recording.des_dof_pos.shape[1] == len(names)
    assert not any("Not used" in line for line in found.lines)
    for k in range(len(names)):
        assert found.recording.dof_pos[:, k] == pytest.approx(0.5 * np.sin((3 + 0.1 * k) * TIME), abs=1e-5)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("with_robot", [False, True])
@pytest.mark.parametrize("form", [("{}_pos", "{}_cmd"), ("observation.state[{}.pos]", "action[{}.pos]")])
def test_columns_of_a_joint_are_read_under_its_name(tmp_path, monkeypatch, form, with_robot):
    monkeypatch.chdir(tmp_path)
    names = [*names_of_models(), *WORDS, *(ONLY_WORDS if with_robot else ())]
    assert len(names) > 40
    for name in names:
        path = log_of(tmp_path / "log.csv", [name], *form)
        read_back(path, [name], Robot(joint_names=(name,)) if with_robot else Robot())


@pytest.mark.slow
@pytest.mark.parametrize("with_robot", [False, True])
def test_columns_of_all_joints_of_a_log_are_read_under_their_names(tmp_path, monkeypatch, with_robot):
    monkeypatch.chdir(tmp_path)
    for names in (names_of_models(), list(WORDS)):
        path = log_of(tmp_path / "log.csv", names)
        found = read_back(path, names, Robot(joint_names=tuple(names)) if with_robot else Robot())
        write_map(tmp_path / "map.toml", found.columns)
        assert list(read_map(tmp_path / "map.toml").joints) == names


def test_other_columns_of_such_joints_are_theirs_too(tmp_path):
    names, speed = ("index_q1", "ring_q1"), 0.5 * 3 * np.cos(3 * TIME)
    path = log_of(tmp_path / "log.csv", names, index_q1_vel=speed, index_q1_tau=speed, ring_q1_pos_error=speed)
    (found,) = understood(path, Robot())
    assert found.columns.joints["index_q1"].keys() == {"dof_pos", "des_dof_pos", "dof_vel", "dof_effort"}
    assert "Not used: ring_q1_pos_error." in found.lines[-1]


def test_words_of_a_series_are_no_names_of_joints(tmp_path):
    forms = [
        ("{}_q", "{}_q_cmd"), ("actual_position_{}", "target_position_{}"), ("present_pos_{}", "goal_pos_{}"),
        ("{}_state_q", "{}_q_des"), ("{} pos [rad]", "{} cmd [rad]"), ("{}_pos_meas", "{}_pos_cmd"),
    ]  # fmt: skip
    for form in forms:
        (found,) = understood(log_of(tmp_path / "log.csv", ["hip", "knee"], *form), Robot())
        assert found.recording.joint_names == ("hip", "knee"), form


def test_a_last_command_is_no_joint(tmp_path):
    path = log_of(tmp_path / "log.csv", ["hip"], hip_last_pos=TIME, hip_last_cmd=TIME, index=TIME, motor_index=TIME)
    (found,) = understood(path, Robot())
    assert found.recording.joint_names == ("hip",)
    assert "Not used: hip_last_pos, hip_last_cmd, index, motor_index." in found.lines[-1]


def test_a_foot_with_commands_is_no_misspelt_joint(tmp_path):
    path = log_of(tmp_path / "log.csv", ["hip", "foot_x"])
    (found,) = understood(path, Robot(joint_names=("hip", "knee")))
    assert found.recording.joint_names == ("hip",)
    assert "Not used: foot_x_pos, foot_x_cmd." in found.lines[-1]
