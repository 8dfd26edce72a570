"""A configuration from a model file alone."""

import dataclasses
import importlib.util
import json
import re
import sys
from pathlib import Path

import mujoco
import pytest
import torch

from pace_actuators.base_parameters import CARRIED
from pace_envs import ManagerBasedRLEnv, load_env_cfg
from pace_envs.from_model import cfg_from_model
from pace_envs.from_model.robot import read_robot
from pace_envs.model_file import read, read_model_file
from pace_envs.task_source import EnvironmentRecord
from pace_optim.commands.new_robot import main as new_robot
from pace_optim.problem.parameter_space import ParameterSpace

ARM = """
<mujoco model="two link arm">
  <compiler angle="radian"/>
  <option gravity="0 0 -3.7"/>
  <default>
    <default class="big"><position kp="120" kv="6" forcerange="-60 60"/></default>
    <geom type="capsule" size="0.02"/>
  </default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="base" pos="0 0 1"><freejoint/><geom size="0.05" type="sphere"/>
      <body name="upper"><joint name="arm/shoulder" axis="0 1 0" range="-2 1" armature="0.05" damping="0.4"
          frictionloss="0.3"/><geom fromto="0 0 0 0.3 0 0"/>
        <body name="fore" pos="0.3 0 0"><joint name="elbow (left)" axis="0 1 0" actuatorfrcrange="-9 9"/>
          <geom fromto="0 0 0 0.2 0 0"/>
          <body name="tool" pos="0.2 0 0"><joint name="rail" type="slide" axis="1 0 0" range="0 0.1"/>
            <geom fromto="0 0 0 0.1 0 0"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="e" joint="elbow (left)" gear="2" gainprm="0.5" biastype="affine" biasprm="0.2 -10 -1"
      ctrlrange="0 255"/>
    <position class="big" name="s" joint="arm/shoulder" ctrlrange="-1.5 0.9"/>
    <motor name="r" joint="rail" gear="50" ctrlrange="-1 1"/>
  </actuator>
  <keyframe><key name="other" qpos="0 0 2 1 0 0 0 0 0 0"/>
    <key name="home" qpos="0 0 1.5 0.7071067811865476 0.7071067811865476 0 0 -0.7 0.4 0.02"/></keyframe>
</mujoco>
"""


def cfg_of(tmp_path, text, name="robot.xml"):
    path = tmp_path / name
    path.write_text(text)
    return cfg_from_model(path)


def drive_of(cfg):
    return cfg.scene.robot.actuators["drives"]


def made(cfg):
    cfg.scene.num_envs = 2
    return ManagerBasedRLEnv(cfg)


def test_drives_are_those_of_the_actuators_in_the_joints_own_coordinates(tmp_path):
    drive = drive_of(cfg := cfg_of(tmp_path, ARM))
    assert cfg.sim2real.joint_order == ("arm/shoulder", "elbow (left)", "rail")
    assert drive.stiffness[:2] == [120, 40]  # kp G²
    assert drive.damping[:2] == [6, 4]
    assert cfg.sim2real.assumed_gains == ("rail",)  # whose motor says nothing of them
    assert drive.effort_limit == [60, 9, 50]  # forcerange, actuatorfrcrange, gear x ctrlrange


def test_an_affine_servo_gives_the_force_that_mujoco_computes(tmp_path):
    cfg = cfg_of(tmp_path, ARM)
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    q, v, u = 0.3, 0.2, 17.0
    data.joint("elbow (left)").qpos, data.joint("elbow (left)").qvel, data.actuator("e").ctrl = q, v, u
    mujoco.mj_forward(model, data)
    target = (0.5 * u + 0.2) / (10 * 2)
    kp, kd = drive_of(cfg).stiffness[1], drive_of(cfg).damping[1]
    assert kp * (target - q) - kd * v == pytest.approx(data.joint("elbow (left)").qfrc_actuator[0])


def test_gravity_and_home_are_the_files_and_the_base_does_not_lean_as_the_keyframe(tmp_path):
    cfg = cfg_of(tmp_path, ARM)
    assert cfg.sim.gravity == (0, 0, -3.7)
    env = made(cfg)
    robot = env.scene["robot"]
    assert robot.is_fixed_base
    assert robot.data.default_joint_pos[0].tolist() == [-0.7, 0.4, 0.02]
    assert env.sim.model.body("base").pos.tolist() == [0, 0, 1.5]
    assert env.sim.model.body("base").quat.tolist() == [1, 0, 0, 0]
    assert robot.actuators["drives"].armature[0].tolist() == [0.05, 0, 0]
    assert robot.actuators["drives"].friction[0].tolist() == [0.3, 0, 0]
    env.close()


def test_bounds_scale_with_each_joints_drive(tmp_path):
    cfg = cfg_of(tmp_path, ARM)
    upper = {name: own[:, 1].tolist() for name, own in cfg.sim2real.bounds.items()}
    assert upper["armature"][0] >= 10 * 0.05 > upper["armature"][1] and upper["friction"][0] > 5 * upper["friction"][1]
    assert upper["encoder_bias"] == pytest.approx([0.1, 0.1, 0.01])


def test_placeholders_for_limits_leave_room_for_a_small_drive_and_for_its_friction(tmp_path):
    urdf = URDF.replace('effort="23.7" velocity="30.1"', 'effort="1000" velocity="1000"')
    bounds = cfg_of(tmp_path, urdf, "leg.urdf").sim2real.bounds
    assert 0 < bounds["armature"][0, 0] < 1e-4  # 1e-3 of what the hip moves; 1e-5 of 1000 N m / (25 rad/s²) is 4e-4
    assert bounds["viscous_friction"][0, 1] == pytest.approx(1000 / 10)  # at 10 rad/s, not at 1000


def test_a_fit_begins_at_a_small_part_of_the_bounds(tmp_path):
    """In their middle a drive may have more friction than it moves against, and be late by a quarter of a period of
    its motion: either leads a descent astray."""
    sim2real = cfg_of(tmp_path, ARM).sim2real
    n, space = len(sim2real.joint_order), ParameterSpace.of(sim2real)
    expected = 0.1 * torch.cat([sim2real.bounds[name][:, 1] for name in CARRIED])
    start = space.to_physical(space.start)
    assert start[: 3 * n].tolist() == pytest.approx(expected.tolist())
    assert float(start[-1]) == pytest.approx(0.1 * float(sim2real.bounds["delay"][0, 1]))
    sim2real.bounds["armature"][0, 0] = 0.5 * sim2real.bounds["armature"][0, 1]  # such as where the loop is stable
    raised = ParameterSpace.of(sim2real)
    assert float(raised.to_physical(raised.start)[0]) == pytest.approx(float(sim2real.bounds["armature"][0, 0]))
    with pytest.raises(ValueError, match="start_params names mass"):
        dataclasses.replace(sim2real, start_params={"mass": 1.0}).prepare()


def test_the_excitation_stays_within_range_and_command_range(tmp_path):
    excitation = cfg_of(tmp_path, ARM).sim2real.excitation
    scale, bias = torch.tensor(excitation.scale), torch.tensor(excitation.bias)
    low, high = scale * (bias - 1), scale * (bias + 1)
    assert -1.5 < low[0] < high[0] < 0.9 and bias[0] * scale[0] == pytest.approx(-0.7, abs=0.1)
    assert 0 < low[2] < high[2] < 0.1


URDF = """<robot name="leg">
  <link name="base"/>
  <link name="thigh"><inertial><origin xyz="0 0 -0.1"/><mass value="1"/>
    <inertia ixx="0.006" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.001"/></inertial>
    <visual><geometry><mesh filename="package://not/there.dae"/></geometry></visual>
    <collision><geometry><mesh filename="package://not/there.stl"/></geometry></collision></link>
  <link name="shank"><inertial><origin xyz="0 0 -0.1"/><mass value="0.3"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.0003"/></inertial></link>
  <link name="foot"/>
  <link name="toe"><inertial><mass value="0.1"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <joint name="hip" type="revolute"><parent link="base"/><child link="thigh"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" effort="23.7" velocity="30.1"/><dynamics damping="0.1" friction="0.2"/></joint>
  <joint name="knee" type="revolute"><parent link="thigh"/><child link="shank"/><origin xyz="0 0 -0.2"/>
    <axis xyz="0 1 0"/><limit lower="-2.5" upper="0" effort="35.5" velocity="20.1"/></joint>
  <joint name="sole" type="fixed"><parent link="shank"/><child link="foot"/></joint>
  <joint name="toe" type="revolute"><parent link="foot"/><child link="toe"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="knee" multiplier="-0.5" offset="0.1"/></joint>
</robot>
"""


def test_limits_and_dynamics_of_a_urdf_are_read_and_its_meshes_are_not_needed(tmp_path):
    cfg = cfg_of(tmp_path, URDF, "leg.urdf")
    drive = drive_of(cfg)
    assert cfg.sim2real.joint_order == ("hip", "knee")  # the toe follows the knee
    assert drive.effort_limit == [23.7, 35.5] and drive.velocity_limit == [30.1, 20.1]
    assert any("meshes are not loaded" in note for note in cfg.sim2real.notes)
    assert any(note.startswith("gains: the file has none") for note in cfg.sim2real.notes)
    assert any(note.startswith("effort limit: 23.7 to 35.5 N m") for note in cfg.sim2real.notes)
    env = made(cfg)
    robot = env.scene["robot"]
    assert robot.data.joint_pos_limits.tolist() == [[-1.5, 1.5], [-2.5, 0]]
    assert robot.actuators["drives"].viscous_friction[0].tolist() == [0.1, 0]
    assert robot.actuators["drives"].friction[0].tolist() == [0.2, 0]
    assert "foot" in robot.body_names  # a load can be bolted to a fixed link
    knee = float(robot.data.joint_pos[0, 1])
    assert env.sim.qpos[0, 2] == pytest.approx(0.1 - 0.5 * knee)  # the mimic joint starts where it must be
    assert env.sim.model.neq == 1  # MuJoCo's own reading of mimic joints is not added to ours
    env.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<motor", "<muscle"), "muscle"),
        (("-10 -1", "10 -1"), "pushes away"),
        (('axis="0 1 0"', 'axis="0 1'), "cannot read"),
    ],
)
def test_what_no_drive_can_follow_is_refused_in_one_line(tmp_path, change, message):
    text = ARM.replace(*change)
    if "muscle" in message:
        text = text.replace('<muscle name="r" joint="rail" gear="50" ctrlrange="-1 1"/>', '<muscle joint="rail"/>')
    with pytest.raises(ValueError, match=message):
        cfg_of(tmp_path, text)


THIGH_INERTIA = 'ixx="0.006" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.001"'


@pytest.mark.parametrize(
    ("stated", "nearest", "note"),
    [
        ((1e-3, 1e-3, 3e-3), (1.5e-3, 1.5e-3, 3e-3), "changed by 16.7 % at most"),  # Σ = 1.5, 1.5, -0.5 -> 0
        ((-1e-3, 2e-3, 2e-3), (0, 2.5e-3, 2.5e-3), "changed by 50.1 % at most"),  # Σ = 2.5, -0.5, -0.5 -> 0
        ((0, 0, 0), (0, 0, 0), "The inertia of thigh is zero"),
    ],
)
def test_an_inertia_that_no_body_can_have_becomes_the_nearest_possible_one(tmp_path, stated, nearest, note):
    wrong = " ".join(f'i{axis}{axis}="{value}"' for axis, value in zip("xyz", stated, strict=True))
    base = f'<link name="base"><inertial><mass value="1"/><inertia {wrong}/></inertial></link>'
    urdf = URDF.replace(THIGH_INERTIA, wrong).replace('<link name="base"/>', base)
    cfg = cfg_of(tmp_path, urdf, "leg.urdf")
    told = [text for text in cfg.sim2real.notes if note in text]
    assert told and "thigh" in told[0] and "base" not in told[0]  # the base is held: its inertia does not matter
    env = made(cfg)
    assert sorted(env.sim.model.body("thigh").inertia) == pytest.approx(sorted(nearest), abs=2e-6)
    env.close()


def test_of_elements_that_stand_twice_the_first_is_used(tmp_path):
    """As ROS does; MuJoCo refuses such files."""
    thigh = re.search(r"<inertial><origin.*?</inertial>", URDF, re.DOTALL)[0]
    cfg = cfg_of(tmp_path, URDF.replace(thigh, thigh + '<inertial><mass value="90"/></inertial>'), "twice.urdf")
    assert "Stated twice, the first is used: <inertial> of thigh." in cfg.sim2real.notes
    env, once = made(cfg), made(cfg_of(tmp_path, URDF, "once.urdf"))
    assert env.sim.model.body("thigh").mass == once.sim.model.body("thigh").mass
    env.close()
    once.close()


def test_a_link_without_mass_between_joints_is_a_point_and_a_robot_without_any_is_refused(tmp_path):
    thigh = re.search(r"<inertial><origin.*?</inertial>", URDF, re.DOTALL)[0]
    cfg = cfg_of(tmp_path, URDF.replace(thigh, ""), "a.urdf")
    assert any("No mass is stated for thigh" in note for note in cfg.sim2real.notes)
    massless = re.sub(r"<inertial>.*?</inertial>", "", URDF, flags=re.DOTALL)
    with pytest.raises(ValueError, match=r"leg\.urdf states no mass of any link that a joint moves"):
        cfg_of(tmp_path, massless, "leg.urdf")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<robot", '\n\n<?xml version="1.0"?>\n<robot'),
        ('effort="23.7"', 'effort="23.7" drake:acceleration="2"'),
        ("</robot>", '<drake:declare name="a"/></robot>'),
        ("</robot>", "</robot>\n\0"),
        (
            "</robot>",
            '<link name="world"/><joint name="float" type="floating"><parent link="world"/><child link="base"/></joint>'
            "</robot>",
        ),
        ('joint name="sole" type="fixed">', 'joint name="sole" type="fixed"><mimic joint="hip"/>'),
    ],
)
def test_what_other_readers_of_urdf_take_is_taken(tmp_path, old, new):
    assert cfg_of(tmp_path, URDF.replace(old, new), "leg.urdf").sim2real.joint_order == ("hip", "knee")


def test_a_joint_that_follows_one_that_is_fixed_stays_where_it_is(tmp_path):
    urdf = URDF.replace('<mimic joint="knee"', '<mimic joint="sole"')
    cfg = cfg_of(tmp_path, urdf, "leg.urdf")
    assert cfg.sim2real.joint_order == ("hip", "knee")
    env = made(cfg)
    assert env.sim.qpos[0, 2] == pytest.approx(0.1)
    env.close()


@pytest.mark.parametrize("key", ["damping", "frictionloss", "armature"])
def test_a_value_that_is_no_number_is_told_with_its_file(tmp_path, key):
    text = re.sub(f'{key}="[^"]*"', f'{key}="nan"', ARM)
    with pytest.raises(ValueError, match=rf"robot\.xml has a value that is not a number .*dof_{key}"):
        cfg_of(tmp_path, text)


def test_a_file_that_has_become_unusable_is_named_where_a_robot_is_made(tmp_path):
    cfg = cfg_of(tmp_path, ARM)
    path = Path(cfg.scene.robot.mjcf_path)
    path.write_text(ARM.replace('<geom fromto="0 0 0 0.2 0 0"/>', ""))
    with pytest.raises(ValueError, match=f"MuJoCo cannot compile {re.escape(str(path))}: .*mass"):
        made(cfg)


@pytest.mark.parametrize("text", ["nan", "fast"])
@pytest.mark.parametrize("key", ["lower", "effort", "velocity"])
def test_a_urdfs_limit_that_is_no_number_is_told_with_its_joint(tmp_path, key, text):
    limit = " ".join(f'{k}="{text if k == key else 1}"' for k in ("lower", "upper", "effort", "velocity"))
    urdf = f'<robot name="a"><joint name="elbow" type="revolute"><limit {limit}/></joint></robot>'
    with pytest.raises(ValueError, match=rf"robot\.urdf: <limit {key}='{text}'> of joint 'elbow' is not a number"):
        cfg_of(tmp_path, urdf, "robot.urdf")


def test_the_gains_around_motors_are_somebody_elses(tmp_path):
    actuators = "".join(f'<motor joint="{name}"/>' for name in ("arm/shoulder", "elbow (left)", "rail"))
    motors = re.sub("<actuator>.*</actuator>", f"<actuator>{actuators}</actuator>", ARM, flags=re.DOTALL)
    cfg = cfg_of(tmp_path, motors)
    assert cfg.sim2real.assumed_gains == cfg.sim2real.joint_order
    assert min(drive_of(cfg).stiffness) > 0.0 and min(drive_of(cfg).damping) > 0.0
    assert any("has none gets kp = effort limit" in note for note in cfg.sim2real.notes)
    assert not drive_of(cfg).implicit and cfg.sim.integrator == "leapfrog"


def test_ranges_that_seem_to_be_radians_read_as_degrees_are_noted(tmp_path):
    said = [note for note in cfg_of(tmp_path, ARM.replace(' angle="radian"', "")).sim2real.notes if "degrees" in note]
    assert said and said[0].startswith("ranges: 3 degrees wide") and '<compiler angle="radian"/>' in said[0]
    assert not any("degrees" in note for note in cfg_of(tmp_path, ARM).sim2real.notes)


XACRO = "http://www.ros.org/wiki/xacro"


def test_a_xacro_is_told_apart(tmp_path):
    with pytest.raises(ValueError, match=r"xacro robot\.xacro\.urdf > robot\.urdf"):
        cfg_of(tmp_path, f'<robot name="a" xmlns:xacro="{XACRO}"><xacro:arm/></robot>', "robot.xacro.urdf")


MISSING_MESH = """
<mujoco model="m">
  <asset><mesh name="a" file="gone.stl"/><texture name="t" type="2d" file="gone.png"/><material name="m" texture="t"/>
  </asset>
  <worldbody><body><joint name="j" axis="0 1 0"/><inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>
    <geom name="g" type="mesh" mesh="a" material="m"/><geom type="sphere" size="0.01" material="m"/>
    <body name="pad"><geom type="mesh" mesh="a"/></body></body></worldbody>
  <contact><pair geom1="g" geom2="g2"/></contact>
  <actuator><position joint="j" kp="1"/></actuator>
</mujoco>
""".replace('<pair geom1="g" geom2="g2"/>', "")


def test_missing_meshes_and_pictures_are_left_out_and_inertias_kept(tmp_path):
    cfg = cfg_of(tmp_path, MISSING_MESH)
    assert any("gone.stl" in note for note in cfg.sim2real.notes)
    assert any("The mass of pad" in note for note in cfg.sim2real.notes)
    env = made(cfg)
    assert env.sim.model.body(1).mass[0] == 0.3
    env.close()


def test_where_no_mass_is_left_the_missing_meshes_are_told(tmp_path):
    only = '<mujoco><asset><mesh name="arm" file="gone.stl"/></asset><worldbody><body><joint name="j"/>'
    only += '<geom type="mesh" mesh="arm"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match=r"(?s)cannot compile .*mass.*missing \(gone.stl\).*Put them"):
        cfg_of(tmp_path, only)


def test_commands_come_at_the_rate_that_is_asked_for(tmp_path):
    (tmp_path / "robot.xml").write_text(ARM)
    task = str(tmp_path / "robot.xml")
    usual, fast = load_env_cfg(task), load_env_cfg(task, 0.001)
    assert (usual.sim.dt, usual.decimation) == (0.0025, 1) and (fast.sim.dt, fast.decimation) == (0.001, 1)
    for cfg in (usual, fast):  # [control steps]
        assert float(cfg.sim2real.bounds["delay"][0, 1]) * cfg.sim.dt == pytest.approx(0.05)
        assert drive_of(cfg).max_delay * cfg.sim.dt == pytest.approx(0.05)
    assert "control rate: 1000 Hz" in " ".join(fast.sim2real.notes)
    record = EnvironmentRecord.read(json.loads(json.dumps(EnvironmentRecord.of(task, fast).to_dict())), task)
    assert record.load_cfg("settings.json").sim.dt == 0.001
    for wrong in (0.0, -0.001, 0.2):
        with pytest.raises(ValueError, match=r"control_dt is .* expected a time above 0 and up to 0.05 s"):
            load_env_cfg(task, wrong)
    with pytest.raises(ValueError, match=r"only a model file .* Omit --control_dt"):
        load_env_cfg("Pace-AnymalD-v0", 0.001)


def test_a_written_configuration_is_the_one_that_the_file_stands_for(tmp_path, monkeypatch, capsys):
    """With a placeholder of an effort limit too, of which a small drive's armature is a tiny part."""
    (tmp_path / "robot.xml").write_text(ARM.replace('actuatorfrcrange="-9 9"', 'actuatorfrcrange="-9000 9000"'))
    output = tmp_path / "conf" / "my_arm.py"
    words = [str(tmp_path / "robot.xml"), "--output", str(output), "--control_dt", "0.002"]
    monkeypatch.setattr(sys, "argv", ["new_robot", *words])
    new_robot()
    task = capsys.readouterr().out.split(f"{output}:")[1].split()[0]
    spec = importlib.util.spec_from_file_location("my_arm_of_a_test", output)
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    written, own = load_env_cfg(task), cfg_from_model(tmp_path / "robot.xml", 0.002)
    assert written.sim2real.joint_order == own.sim2real.joint_order
    assert written.sim2real.assumed_gains == own.sim2real.assumed_gains == ("rail",)
    torch.testing.assert_close(written.sim2real.bounds, own.sim2real.bounds, rtol=1e-4, atol=1e-9)
    starts = [ParameterSpace.of(sim2real).start for sim2real in (written.sim2real, own.sim2real)]
    torch.testing.assert_close(*starts, rtol=1e-4, atol=1e-9)
    for field in ("stiffness", "damping", "effort_limit", "implicit", "control_decimation"):
        assert getattr(drive_of(written), field) == pytest.approx(getattr(drive_of(own), field), rel=1e-4)
    assert (written.sim.dt, written.decimation, written.sim.gravity) == (own.sim.dt, own.decimation, own.sim.gravity)
    env = made(written)
    assert env.scene["robot"].data.default_joint_pos[0].tolist() == [-0.7, 0.4, 0.02]
    env.close()
    with pytest.raises(ValueError, match="exists"):
        new_robot()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("head", "body", "message"),
    [
        (
            "",
            '<replicate count="100000000"><geom size="0.1"/></replicate>',
            r"not read and compiled .*arm\.xml after 0\.5 s",
        ),
        ('<size nuserdata="2000000000"/>', "", r"arm\.xml does not fit into 4 GB of memory"),
        ('<size memory="500G"/>', "", r"arm\.xml does not fit into 4 GB of memory"),
        ('<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>', "", r"arm\.xml does not fit"),
    ],
)
def test_a_model_that_takes_too_long_or_too_much_memory_is_refused(head, body, message, tmp_path, monkeypatch):
    """They ran without end, and took what memory there was."""
    monkeypatch.setattr(read, "_LONGEST_S", 0.5)
    monkeypatch.setattr(read, "available_memory", lambda: 1e10)
    joint = '<body pos="0 0 1"><joint name="hinge"/><geom size="0.1"/></body>'
    path = tmp_path / "arm.xml"
    path.write_text(f"<mujoco>{head}<worldbody>{joint}{body}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=message):
        read_model_file(path)
    path.write_text(f"<mujoco><worldbody>{joint}</worldbody></mujoco>")
    assert read_model_file(path).spec.joint("hinge") is not None


BESIDE = """
<mujoco>
  <option density="1.2" wind="1 0 0"/>
  <worldbody>
    <body>
      <joint name="lift" axis="0 1 0" stiffness="3"/>
      <geom size=".1" mass="1"/>
      <body pos="0 0 .2"><joint name="flap" axis="0 1 0"/><geom size=".05" mass=".2"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="lift" gear="-9" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def test_what_acts_beside_the_drives_is_told(tmp_path):
    (tmp_path / "robot.xml").write_text(BESIDE)
    notes = "\n".join(read_robot(tmp_path / "robot.xml").notes)
    assert "no drive: flap" in notes and "free to move" in notes
    assert "stiffness lift 3" in notes
    assert "density 1.2, wind 1 0 0 m/s" in notes
    assert "gears: lift -9" in notes and "negative gear: lift" in notes


def test_an_mjcf_s_impossible_inertia_is_told_with_its_body_and_no_word_of_meshes(tmp_path):
    inertial = '<inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .5"/><geom type="mesh" mesh="m"/>'
    body = f'<body name="shin"><joint name="j" axis="0 1 0"/>{inertial}</body>'
    asset = '<asset><mesh name="m" file="nowhere.stl"/></asset>'
    (tmp_path / "robot.xml").write_text(f"<mujoco>{asset}<worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=r"stated inertia of shin.*balanceinertia") as refused:
        read_robot(tmp_path / "robot.xml")
    assert "mesh" not in str(refused.value)
