"""What is exported holds what was identified."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from command_lines import run_script
from torque_sequence import DT, ENVS, JOINTS, sequence, write_result

from pace_actuators import ActuatorActions, IdentifiedDrives, PaceDCMotor, PaceDCMotorCfg
from pace_actuators.drive_result import CommandTiming
from pace_envs import load_env_cfg
from pace_optim.export import FORMATS, export
from pace_optim.export.configs import drive_groups
from pace_optim.export.mjlab_native import mjlab_actuator
from pace_optim.export.plain_drive import PlainDrive


@pytest.fixture
def result(tmp_path):
    return write_result(tmp_path / "result.json")


def with_effects(path: Path, effects: list[str], parameters: dict[str, dict[str, float]]) -> Path:
    content = json.loads(path.read_text())
    content["effects"] += effects
    content["parameters"] |= parameters
    path.write_text(json.dumps(content))
    return path


def torques(cfg: PaceDCMotorCfg) -> np.ndarray:
    motor, data = PaceDCMotor(cfg, JOINTS, slice(None), ENVS, physics_dt=DT, dtype=torch.float64), sequence()
    return np.stack(
        [
            motor.compute(ActuatorActions(torch.tensor(c)), torch.tensor(p), torch.tensor(v)).joint_efforts.numpy()
            for c, p, v in zip(data["command"], data["position"], data["velocity"], strict=True)
        ]
    )


def test_the_mjcf_loads_and_its_joints_hold_the_values(result):
    exported, drives = export(result, "mjcf"), IdentifiedDrives.load(result)
    model = mujoco.MjModel.from_xml_string(exported.text)
    original = mujoco.MjModel.from_xml_path(str(load_env_cfg("Pace-AnymalD-v0").scene.robot.mjcf_path))
    assert (model.nv, model.nbody) == (original.nv, original.nbody)
    fields = {"armature": "dof_armature", "viscous_friction": "dof_damping", "friction": "dof_frictionloss"}
    for name, field in fields.items():
        for joint, value in drives.values(name, JOINTS).items():
            assert getattr(model, field)[model.joint(joint).dofadr[0]] == pytest.approx(value, rel=1e-5), (name, joint)
    assert np.allclose(model.dof_solref[6:], [2 * DT, 1.0])
    assert np.allclose(model.body_mass, original.body_mass) and np.allclose(model.body_inertia, original.body_inertia)


def test_limits_stay_where_one_joint_has_none(result):
    """The log of a Fetch states 14 limits, and none of its base: all were gone in every format but JSON."""
    content = json.loads(result.read_text())
    first, second, *_ = JOINTS
    del content["drive"]["effort_limit"][first]
    result.write_text(json.dumps(content))
    (limits,) = {
        str(each.effort_limit): each.effort_limit for each in drive_groups(IdentifiedDrives.load(result)).values()
    }.values()
    found = {joint: value for pattern, value in limits.items() for joint in JOINTS if re.fullmatch(pattern, joint)}
    assert found[first] == math.inf and found[second] == 89.0


def test_a_continuous_loop_of_the_robots_configuration_gets_its_event(result, monkeypatch):
    """Of a result without facts of the drive: the page had implicit=True, and neither the event nor the note."""
    content = json.loads(result.read_text())
    content["drive"], content["effects"] = {}, []
    result.write_text(json.dumps(content))

    def continuous(drives):
        cfg = load_env_cfg("Pace-AnymalD-v0")
        for drive in cfg.scene.robot.actuators.values():
            drive.implicit, drive.drive_dt = True, None
        return cfg

    for known in (False, True):
        text = export(result, "mjlab").text
        found = [word in text for word in ("implicit=True", "EVENTS", "runs continuously")]
        assert found == [known] * 3
        monkeypatch.setattr("pace_optim.export.configs.load_identified_cfg", continuous)


def test_a_result_is_used_where_some_joints_have_no_torque_speed_line(result):
    """A stall torque of inf, which stands for no line, was refused in training and in the exported page."""
    whole, content = torques(PaceDCMotorCfg.from_result(result)), json.loads(result.read_text())
    content["drive"]["saturation_effort"].pop(JOINTS[0])
    content["drive"]["velocity_limit"].pop(JOINTS[0])
    result.write_text(json.dumps(content))
    exec(export(result, "cfg").text, space := {})
    (cfg,) = space["ACTUATORS"].values()
    found = torques(cfg)
    assert np.abs(found - torques(PaceDCMotorCfg.from_result(result))).max() < 1e-6
    differs = np.abs(found - whole).max(axis=(0, 1))
    assert differs[0] > 1.0 and (differs[1:] < 1e-6).all()


def test_an_export_of_a_fit_that_is_not_to_be_trusted_says_so(result):
    assert export(result, "json").warnings == []
    content = json.loads(result.read_text()) | {"times_noise": 171.0, "at_bound": [f"friction/{JOINTS[0]}"]}
    result.write_text(json.dumps(content))
    far, bound = export(result, "json").warnings
    assert "171 times the measurement noise" in far and far.endswith("[W22]")
    assert f"friction of {JOINTS[0]} ended at a bound" in bound and bound.endswith("[W23]")
    done = run_script("export", result, "--format", "json")
    assert done.stderr.count("warning: ") == 2, done.stderr


def test_an_export_of_a_fit_with_a_short_step_names_the_step_to_train_at(result):
    """A diagnosis ended at 0.125 ms: 40 of its steps make one of Isaac Lab's."""
    assert not any("slow in training" in note for note in export(result, "isaaclab").notes)
    content = json.loads(result.read_text()) | {"physics_dt": 0.000125}
    result.write_text(json.dumps(content))
    assert any(
        "0.125 ms is slow" in note and "--physics_dt 0.0025" in note for note in export(result, "isaaclab").notes
    )


def test_the_mjcf_says_what_it_cannot_hold(result):
    exported = export(result, "mjcf", joints_only=True)
    said = " ".join(exported.notes)
    for word in ("encoder bias", "delay of 8.5 ms", "drive_bandwidth", "torque_gain", "stribeck_friction"):
        assert word in said and word in exported.text.split("-->")[0]


@pytest.mark.parametrize("fmt", [fmt for fmt in FORMATS if fmt != "json"])
def test_each_format_says_that_it_lacks_a_parameter_of_the_task_alone(result, fmt):
    exported = export(with_effects(result, [], {"torque_limit_at_rest": {"battery": 3.0}}), fmt)
    (note,) = (each for each in exported.notes if "torque_limit_at_rest" in each)
    assert "omitted" in note and "torque_limit_at_rest" in exported.text


def test_json_has_a_parameter_of_the_task_alone(result):
    content = json.loads(export(with_effects(result, [], {"torque_limit_at_rest": {"battery": 3.0}}), "json").text)
    assert content["parameters"]["torque_limit_at_rest"] == {"battery": 3.0}


def test_the_mjcf_holds_a_payload(result):
    share = {joint: 0.3 if joint == "LF_KFE" else 0.0 for joint in JOINTS}
    exported = export(with_effects(result, ["payload"], {"payload.ratio": share}), "mjcf")
    model = mujoco.MjModel.from_xml_string(exported.text)
    original = mujoco.MjModel.from_xml_path(str(load_env_cfg("Pace-AnymalD-v0").scene.robot.mjcf_path))
    body = int(original.joint("LF_KFE").bodyid[0])
    expected = np.where(np.arange(model.nbody) == body, 1.3, 1.0)
    assert np.allclose(model.body_mass, expected * original.body_mass, rtol=1e-5)
    assert np.allclose(model.body_inertia[body], 1.3 * original.body_inertia[body], rtol=1e-4)
    assert np.allclose(model.body_ipos, original.body_ipos, atol=1e-5)


def test_the_mjcf_holds_a_soft_friction(result):
    constants = {"LF_KFE": 0.02, "RF_KFE": 0.05, "LH_KFE": 0.0}
    changed = with_effects(
        result, ["soft_friction@.*KFE"], {"soft_friction.time_constant": {**dict.fromkeys(JOINTS, 0.0), **constants}}
    )
    exported = export(changed, "mjcf")
    model = mujoco.MjModel.from_xml_string(exported.text)
    for name, constant in constants.items():
        column = model.joint(name).dofadr[0]
        time, impedance = model.dof_solref[column, 0], model.dof_solimp[column, 0]
        if not constant:
            assert (time, impedance) == (pytest.approx(2 * DT), 0.999)
            continue
        rate = 2 / (0.95 * constant)  # which acts on the speed in the middle of a step: half a step after MuJoCo's
        assert 2 / (impedance * time) == pytest.approx(rate / (1 + rate * DT / 2), rel=1e-5)
        assert (1 - impedance) / impedance == pytest.approx(1 / 9 / (1 + rate * DT / 2), rel=1e-4)
    assert "soft_friction: in the file" in " ".join(exported.notes)


def test_the_cfg_gives_the_same_torque(result):
    space: dict = {}
    exec(compile(export(result, "cfg").text, "exported.py", "exec"), space)
    (cfg,) = space["ACTUATORS"].values()
    expected = torques(PaceDCMotorCfg.from_result(result))
    assert np.abs(expected).max() > 50 and np.abs(torques(cfg) - expected).max() < 1e-6


def test_groups_of_drives_stay_groups(tmp_path):
    """Go2 has two types of drive."""
    cfg = load_env_cfg("Pace-Go2-v0")
    joints = cfg.sim2real.joint_order
    content = json.loads(write_result(tmp_path / "result.json").read_text())
    content |= {"task": "Pace-Go2-v0", "joint_names": list(joints), "effects": [], "drive": {}}
    for name, values in content["parameters"].items():
        if name != "delay":
            content["parameters"][name] = dict(zip(joints, values.values(), strict=True))
    (tmp_path / "result.json").write_text(json.dumps(content))
    space: dict = {}
    exec(export(tmp_path / "result.json", "cfg").text, space)
    groups = space["ACTUATORS"]
    assert set(groups) == {"hip_thigh", "calf"}
    assert (groups["calf"].effort_limit, groups["hip_thigh"].effort_limit) == (45.43, 23.7)
    assert len(groups["calf"].armature) == 4 and len(groups["hip_thigh"].armature) == 8


def test_the_json_is_plain_and_complete(result):
    content, drives = json.loads(export(result, "json").text), IdentifiedDrives.load(result)
    assert content["delay_s"] == drives.delay_s and "delay" not in content["parameters"]
    for name in content["parameters"]:
        assert set(content["parameters"][name]) == set(JOINTS)
    assert content["parameters"]["armature"]["LF_HAA"] == drives.parameters["armature"]["LF_HAA"]


@pytest.mark.parametrize(
    ("changes", "kind", "left_out"),
    [
        ({"saturation_effort": 140.0, "velocity_limit": 8.5}, "DcMotorActuatorCfg", ()),
        ({}, "IdealPdActuatorCfg", ()),
        ({"effort_limit": np.inf}, "IdealPdActuatorCfg", ("effort_limit",)),
        ({"stiffness": 0.0}, "IdealPdActuatorCfg", ()),
        ({"run_dt": 0.0}, "BuiltinPositionActuatorCfg", ()),
        ({"run_dt": 0.0, "stiffness": 0.0}, "BuiltinVelocityActuatorCfg", ("stiffness",)),
    ],
)
def test_mjlab_s_own_class_is_that_of_the_drive(result, changes, kind, left_out):
    no_line = {"saturation_effort": np.inf, "velocity_limit": np.inf}
    drive = {"stiffness": 85.0, "damping": 0.6, "effort_limit": 89.0, "run_dt": DT} | no_line | changes
    plain = PlainDrive(**drive, encoder_bias=0.01, delay_s=3.4 * DT)
    call = mjlab_actuator(IdentifiedDrives.load(result), "LF_HFE", plain, 0.055)
    assert call.name == kind
    given = {name: value for name, value in drive.items() if np.isfinite(value) and name != "run_dt"}
    joint = {"armature": 0.055, "frictionloss": 0.32, "viscous_damping": 0.45}
    expected = {name: value for name, value in (given | joint).items() if name not in left_out}
    names, delay = {"target_names_expr": ("LF_HFE",)}, {"delay_min_lag": 3, "delay_max_lag": 3}
    assert call.values == expected | names | delay
    timing = CommandTiming(interval_s=8 * DT, early_s=0.6 * DT, late_s=2.2 * DT, lost=0.01)
    call = mjlab_actuator(replace(IdentifiedDrives.load(result), command_timing=timing), "LF_HFE", plain, 0.055)
    jitter = {"delay_min_lag": 3, "delay_max_lag": 6, "delay_update_period": 8, "delay_per_env_phase": False}
    assert call.values == expected | names | jitter


@pytest.mark.parametrize("fmt", FORMATS)
def test_the_command_line_writes_every_format(result, tmp_path, fmt):
    done = run_script("export", result, "--format", fmt, "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out").read_text() == export(result, fmt).text
    assert done.stdout.splitlines()[-1] == f"written: {tmp_path / 'out'}"
    assert done.stdout.count("note: ") == len(export(result, fmt).notes)


def test_bad_input_is_one_line_and_exit_code_2(result, tmp_path):
    unknown = with_effects(write_result(tmp_path / "unknown.json"), ["warp_drive"], {})
    for args, said in (
        ((tmp_path / "missing.json", "--format", "json"), "does not exist"),
        ((result, "--format", "urdf"), "invalid choice"),
        ((unknown, "--format", "json"), "There is no effect 'warp_drive'"),
    ):
        done = run_script("export", *args)
        assert done.returncode == 2 and said in done.stderr, done.stderr
        assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr
