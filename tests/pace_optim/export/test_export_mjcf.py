"""A user of plain MuJoCo gets the identified drive with the exported file."""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from command_lines import run_script
from plain_mujoco import drive_of, fixed_in_the_air, replay
from torque_sequence import DT, GAINS, JOINTS, sequence, write_result

from pace_actuators import ActuatorActions, IdentifiedDrives, PaceDCMotor, PaceDCMotorCfg
from pace_envs import ManagerBasedRLEnv, set_physics_dt
from pace_envs.from_model import cfg_from_model
from pace_envs.identified import load_identified_cfg, use_identified
from pace_envs.task_source import EnvironmentRecord
from pace_optim.export import export
from pace_optim.export.mjcf import model_of
from pace_optim.export.mjcf_drives import write_drives
from pace_optim.export.plain_drive import PlainDrive, plain_drives
from pace_optim.problem.parameter_space import ParameterSpace

STEPS = 400


@pytest.fixture
def result(tmp_path):
    return write_result(tmp_path / "result.json")


def changed(path: Path, **changes) -> Path:
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | changes))
    return path


def without_effects(path: Path) -> Path:
    parameters = json.loads(path.read_text())["parameters"]
    return changed(path, effects=[], parameters={name: v for name, v in parameters.items() if "." not in name})


def chirp(joints: int) -> np.ndarray:
    """(STEPS, joints); one second, to 5 Hz, fast enough for the torque-speed line to matter."""
    time = np.arange(STEPS)[:, None] * DT
    return 0.5 * np.sin(2 * np.pi * (0.5 + 2.25 * time) * time + np.arange(joints)) + 0.1


def identified_motion(path: Path, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the encoders show, (STEPS, joints), as a fit simulates it; and the largest torque [N m]."""
    drives = IdentifiedDrives.load(path)
    cfg = load_identified_cfg(drives)
    cfg.scene.num_envs, cfg.sim.num_threads = 1, 1
    (drive,) = cfg.scene.robot.actuators.values()
    drive.stiffness, drive.damping = drives.drive["stiffness"], drives.drive["damping"]
    set_physics_dt(cfg, drives.at.physics_dt)
    cfg.set_effects([effect.label for effect in drives.effects])
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    space = ParameterSpace.of(cfg.sim2real)
    space.apply(env, space.from_dict(drives.parameters)[None])
    robot, bias = env.scene["robot"], drives.values("encoder_bias", drives.joint_names)
    shift = torch.tensor([list(bias.values())])
    robot.write_joint_state_to_sim(torch.tensor(targets[:1]) + shift, torch.zeros_like(shift))
    shown, most = [], 0.0
    for target in targets:
        shown.append((robot.data.joint_pos[0] - shift[0]).numpy().copy())
        env.step(torch.tensor(target[None]))
        most = max(most, float(robot.data.applied_torque.abs().max()))
    env.close()
    return np.array(shown), most


@pytest.mark.parametrize(
    ("delay", "size", "error"),
    [(3.0, 1.0, 3e-6), (3.4, 0.1, 3e-6), (3.4, 1.0, 5e-4)],
    ids=["limits", "fraction", "both"],
)
def test_plain_mujoco_replays_the_motion_of_the_identification(tmp_path, delay, size, error):
    """To 3 µrad, as the file has six digits; with bias, and a fractional delay or the torque-speed line in use.

    With both MuJoCo limits the mean of two commands, the fit each of them.
    """
    result = write_result(tmp_path / "result.json", delay=delay)
    targets = size * chirp(len(JOINTS))
    expected, most = identified_motion(without_effects(result), targets)
    exported = export(result, "mjcf")
    xml = exported.text
    model = fixed_in_the_air(xml)
    found = replay(model, JOINTS, targets, targets[0])
    assert (size < 1 or most > 0.4 * GAINS["effort_limit"]) and np.ptp(expected, axis=0).min() > 0.05
    assert np.abs(found - expected).max() < error
    assert ("limits the mean" in " ".join(exported.notes)) == (delay % 1 > 0)
    if error > 1e-5:
        return

    def worse(change) -> float:
        motion = replay(fixed_in_the_air(xml, change), JOINTS, targets, targets[0])
        return float(np.abs(motion - expected).max())

    def soft(spec):
        for joint in spec.joints:
            joint.solref_friction, joint.solimp_friction = [0.02, 1.0], [0.9, 0.95, 0.001, 0.5, 2.0]

    def undelayed(spec):
        for actuator in spec.actuators:
            actuator.delay = 0.0

    def implicit(spec):
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST

    assert min(worse(change) for change in (soft, undelayed, implicit)) > 3 * error  # each of them is needed


BESIDE = {
    "quadratic_friction": {"coefficient": 0.3},
    "parallel_spring": {"stiffness": 9.0, "rest": 0.4},
    "torque_offset": {"effort": -1.5},
    "payload": {"ratio": 0.2},
    "com_offset": {"angle": 0.1},
    "torque_speed_limit": {"effort": 140.0, "velocity": 8.5},
}


@pytest.mark.parametrize(
    ("names", "error"), [([*BESIDE][1:], 1e-6), (["quadratic_friction"], 4e-4)], ids=["exact", "within_a_step"]
)
def test_effects_that_a_joint_or_a_body_holds_move_the_model_as_in_the_identification(tmp_path, names, error):
    """On every other joint, with bias and delay. Steps of MuJoCo take the slope of a quadratic friction too."""
    result = without_effects(write_result(tmp_path / "result.json", delay=3.0))
    own, content = JOINTS[::2], json.loads(result.read_text())
    values = {f"{name}.{p}": dict.fromkeys(own, v) for name in names for p, v in BESIDE[name].items()}
    values["measurement_delay.delay"] = dict.fromkeys(JOINTS, 0.01)
    effects = [*(f"{name}@{'|'.join(own)}" for name in names), "measurement_delay"]
    changed(result, effects=effects, parameters=content["parameters"] | values)
    targets = 0.1 * chirp(len(JOINTS))
    expected, _ = identified_motion(result, targets)
    exported, newton = export(result, "mjcf"), export(result, "newton")
    found = replay(fixed_in_the_air(exported.text), JOINTS, targets, targets[0])
    bare = replay(fixed_in_the_air(export(without_effects(result), "mjcf").text), JOINTS, targets, targets[0])
    assert np.abs(found - expected).max() < error < 0.1 * np.abs(bare - expected).max()
    said = " ".join(exported.notes)
    assert all(f"{name}: in the file" in said for name in names) and "omitted" not in said
    assert "measurement_delay is about the recording's time stamps" in said
    page: dict = {}
    exec(newton.text, page)
    joint, drive = page["JOINTS"][own[0]], page["DRIVES"][own[0]]
    if "parallel_spring" in names:
        assert (joint["stiffness"], joint["rest_q"]) == (9.0, 0.4) and "parallel_spring: in the file" in " ".join(
            newton.notes
        )
        assert drive["const_effort"] == pytest.approx(85.0 * 0.08 - 1.5)
    else:
        assert "stiffness" not in joint and "quadratic_friction (τ - b2 v |v|): omitted" in " ".join(newton.notes)


def test_soft_friction_moves_the_model_as_in_the_identification(tmp_path):
    result = without_effects(write_result(tmp_path / "result.json", delay=3.0))
    content = json.loads(result.read_text())
    values = {"friction": dict.fromkeys(JOINTS, 3.0), "soft_friction.time_constant": {"all": 0.02}}
    changed(result, effects=["soft_friction"], parameters=content["parameters"] | values)
    targets = 0.1 * chirp(len(JOINTS))
    expected, _ = identified_motion(result, targets)
    found = replay(fixed_in_the_air(export(result, "mjcf").text), JOINTS, targets, targets[0])
    bare = replay(fixed_in_the_air(export(without_effects(result), "mjcf").text), JOINTS, targets, targets[0])
    assert np.abs(found - expected).max() < 3e-6 < 1e-3 < np.abs(bare - expected).max()


def test_the_actuators_give_the_drives_torque(result):
    """To 1e-5 of the root mean square torque, on one random sequence; gains and limits with the effects on them."""
    path = changed(result, effects=["torque_gain"], delay_s=0.0)
    drives = IdentifiedDrives.load(path)
    model, data = fixed_in_the_air(export(path, "mjcf").text), sequence()
    cfg = PaceDCMotorCfg.from_result(path, physics_dt=DT)
    motor = PaceDCMotor(cfg, JOINTS, slice(None), data["command"].shape[1], dtype=torch.float64)
    bias = np.array(list(drives.values("encoder_bias", JOINTS).values()))
    places = [int(model.joint(name).qposadr[0]) for name in JOINTS]
    speeds = [int(model.joint(name).dofadr[0]) for name in JOINTS]
    actuators, state = [drive_of(model, name) for name in JOINTS], mujoco.MjData(model)
    expected, found = [], []
    for command, position, velocity in zip(data["command"], data["position"], data["velocity"], strict=True):
        inputs = [torch.tensor(value) for value in (command, position, velocity)]
        expected.append(motor.compute(ActuatorActions(inputs[0]), *inputs[1:]).joint_efforts.numpy()[0].copy())
        state.qpos[places], state.qvel[speeds] = position[0] - bias, velocity[0]
        state.ctrl[actuators] = command[0]
        mujoco.mj_forward(model, state)
        found.append(state.qfrc_actuator[speeds].copy())
    scale = np.sqrt(np.square(expected).mean(axis=0))
    assert (np.abs(np.array(found) - np.array(expected)).max(axis=0) < 1e-5 * scale).all()


def test_a_delay_of_the_torque_is_not_made_one_of_the_command(tmp_path):
    exported = export(write_result(tmp_path / "result.json", "effort"), "mjcf")
    model = mujoco.MjModel.from_xml_string(exported.text)
    assert (model.actuator_delay == 0).all()
    assert "another physics" in " ".join(exported.notes) and "another" in exported.text.split("-->")[0]


def test_only_the_joints_are_written_on_demand(result, tmp_path):
    done = run_script("export", result, "--format", "mjcf", "--joints_only", "--output", tmp_path / "a.xml")
    assert done.returncode == 0, done.stderr
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "a.xml"))
    assert model.nu == 0 and "it is not in the model" in done.stdout
    refused = run_script("export", result, "--format", "json", "--joints_only")
    assert refused.returncode == 2 and "joints_only" in refused.stderr


def test_drives_of_a_model_file_run_as_they_did_there(tmp_path):
    """Loops that only a continuous law keeps stable (kd dt / inertia > 2): the same motion as the environment's."""
    path = tmp_path / "arm.xml"
    path.write_text(STIFF)
    cfg = cfg_from_model(path)
    cfg.scene.num_envs, cfg.sim.num_threads, cfg.sim.integrator = 1, 1, "implicitfast"
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    robot = env.scene["robot"]
    names, targets = robot.joint_names, 0.4 * chirp(2)
    robot.write_joint_state_to_sim(torch.tensor(targets[:1]), torch.zeros(1, 2))
    expected = []
    for target in targets:
        expected.append(robot.data.joint_pos[0].numpy().copy())
        env.step(torch.tensor(target[None]))
    fields = {name: env.sim.expand(name)[0].numpy().copy() for name in ("dof_armature", "dof_frictionloss")}
    env.close()
    spec = mujoco.MjSpec.from_string(STIFF)
    common = {"saturation_effort": np.inf, "velocity_limit": np.inf, "encoder_bias": 0.0, "delay_s": 0.0, "run_dt": 0.0}
    drives = {
        "shoulder": PlainDrive(stiffness=2000.0, damping=200.0, effort_limit=150.0, **common),
        "wrist": PlainDrive(stiffness=500.0, damping=50.0, effort_limit=28.0, **common),
    }
    notes = write_drives(spec, drives, DT)
    spec.compile()
    model = fixed_in_the_air(spec.to_xml())
    model.dof_armature[:], model.dof_frictionloss[:] = fields["dof_armature"], fields["dof_frictionloss"]
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST and "implicitfast" in " ".join(notes)
    assert np.abs(replay(model, names, targets, targets[0]) - np.array(expected)).max() < 3e-6


HELD = {"stiffness": {"shoulder": 300.0, "wrist": 15.0}, "damping": {"shoulder": 20.0, "wrist": 0.5}}


def result_of(folder: Path, model: Path, cfg, parameters: dict, drive: dict) -> Path:
    """A fit of a model file, four physics steps in a control step and a delay of 3.4 of them."""
    content = {
        "version": 1,
        "task": str(model),
        "environment": EnvironmentRecord.of(str(model), cfg).to_dict(),
        "joint_names": list(cfg.sim2real.joint_order),
        "effects": [],
        "delay_mode": "command",
        "physics_dt": DT / 4,
        "control_dt": DT,
        "parameters": {**parameters, "delay": {"all": 3.4}},
        "delay_s": 3.4 * DT,
        "std": {},
        "drive": drive,
    }
    path = folder / "result.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stiff", "gains", "soft", "error"),
    [(True, {}, 0.0, 2e-5), (False, HELD, 0.0, 1.5e-4), (True, {}, 0.02, 4e-5), (False, HELD, 0.02, 1.5e-4)],
    ids=["continuous", "held", "continuous, soft", "held, soft"],
)
def test_what_steps_of_second_order_identified_moves_so_in_plain_steps(tmp_path, stiff, gains, soft, error):
    """Four steps per control step, as fits of model files take; the held torques' error is what kd's jerk leaves."""
    path = tmp_path / "arm.xml"
    path.write_text(STIFF if stiff else STIFF[: STIFF.index("  <actuator>")] + MOTORS)
    cfg = cfg_from_model(path)
    drive, names = cfg.scene.robot.actuators["drives"], list(cfg.sim2real.joint_order)

    def of(*values):
        return dict(zip(names, values, strict=True))

    stated = {"stiffness": of(2000.0, 500.0), "damping": of(200.0, 50.0)} | gains
    flags = {"second_order": of(1.0, 1.0)} | ({"implicit": of(1.0, 1.0)} if drive.implicit else {})
    parameters = {
        "armature": of(0.1, 0.02),
        "viscous_friction": of(1.0, 0.05),
        "friction": of(0.5, 0.02),
        "encoder_bias": of(0.02, -0.03),
    }
    if soft:
        parameters |= {"friction": of(5.0, 0.5), "soft_friction.time_constant": {"all": soft}}
    result = result_of(tmp_path, path, cfg, parameters, {**stated, "effort_limit": of(150.0, 28.0), **flags})
    changed(result, effects=["soft_friction"] if soft else [])
    targets = 0.4 * chirp(2)
    expected, _ = identified_motion(result, targets)
    exported = export(result, "mjcf")
    found = replay(fixed_in_the_air(exported.text), names, targets.repeat(4, axis=0), targets[0])[::4]
    assert drive.implicit == stiff and "compensate for" in " ".join(exported.notes)
    assert np.ptp(expected, axis=0).min() > 0.2 and np.abs(found - expected).max() < error


@pytest.mark.parametrize("rate", [{"drive_dt": DT / 4}, {}], ids=["drive_dt", "held for a control step"])
def test_a_fits_loop_rate_replaces_that_of_a_model_file_with_gains(tmp_path, rate):
    """The file's loop is continuous: a stated or found rate was refused in training and exports, or left out."""
    path = tmp_path / "arm.xml"
    path.write_text(STIFF)
    cfg = cfg_from_model(path)
    names = list(cfg.sim2real.joint_order)
    parameters = {name: dict.fromkeys(names, 0.1) for name in ("armature", "viscous_friction", "friction")}
    parameters["encoder_bias"] = dict.fromkeys(names, 0.0)
    drive = {name: dict.fromkeys(names, value) for name, value in rate.items()}
    result = result_of(tmp_path, path, cfg, parameters, {**HELD, **drive})
    exec(export(result, "cfg").text, written := {})
    use_identified(cfg, result)
    for (each,) in (written["ACTUATORS"].values(), cfg.scene.robot.actuators.values()):
        assert not each.implicit and each.drive_dt == rate.get("drive_dt")
    plain = plain_drives(IdentifiedDrives.load(result))[0]
    assert {drive.run_dt for drive in plain.values()} == {rate.get("drive_dt", DT)}
    assert any("Euler" in note for note in export(result, "mjcf").notes)


WEIGHED = """
<mujoco>
  <compiler OPTIONS/>
  <worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0"/>
      <inertial pos="0.2 0 0" mass="4" diaginertia="0.02 0.06 0.06"/><geom size="0.05" mass="1"/>
      <body name="hand" pos="0.4 0 0"><joint name="wrist" axis="1 0 0"/><geom size="0.04" mass="1"/></body></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("options", "upper"),
    [('inertiafromgeom="true"', 1.0), ('settotalmass="10"', 8.0), ('inertiagrouprange="0 5"', 4.0)],
)
def test_an_identified_mass_holds_where_a_file_weighs_geoms_or_all_bodies_together(tmp_path, options, upper):
    """Gymnasium's models: the identified mass was the geoms' again, 1.0 of 1.8 kg, without a word."""
    path = tmp_path / "arm.xml"
    path.write_text(WEIGHED.replace("OPTIONS", options))
    cfg = cfg_from_model(path)
    names = list(cfg.sim2real.joint_order)
    parameters = {name: dict.fromkeys(names, 0.1) for name in ("armature", "viscous_friction", "friction")}
    result = result_of(tmp_path, path, cfg, parameters | {"encoder_bias": dict.fromkeys(names, 0.0)}, HELD)
    changed(result, links={"hand": {"mass": 1.8, "com": [0.01, 0.0, 0.02], "inertia": [0.002] * 3 + [0.0] * 3}})
    use_identified(cfg, result)
    env = ManagerBasedRLEnv(cfg)
    exported = mujoco.MjModel.from_xml_string(export(result, "mjcf").text)
    for model in (env.sim.model, exported):
        found = {name: float(model.body(name).mass[0]) for name in ("upper", "hand")}
        assert found == pytest.approx({"upper": upper, "hand": 1.8}) and model.body("hand").ipos[2] == 0.02
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("page", ["newton", "mjlab_native"])
def test_pages_for_other_simulators_move_so_in_plain_steps_too(tmp_path, page):
    """They had the identified armature and kd: at steps of 0.5 ms, an xArm 7 moved 2 mrad beside its fit."""
    path = tmp_path / "arm.xml"
    path.write_text(STIFF[: STIFF.index("  <actuator>")] + MOTORS)
    cfg = cfg_from_model(path)
    names = list(cfg.sim2real.joint_order)
    values = {"armature": (0.1, 0.02), "viscous_friction": (1.0, 0.05), "friction": (0.5, 0.02)}
    parameters = {name: dict(zip(names, each, strict=True)) for name, each in values.items()}
    flags = {"second_order": dict.fromkeys(names, 1.0), "effort_limit": dict.fromkeys(names, 1e3)}
    parameters["encoder_bias"] = dict.fromkeys(names, 0.0)
    result = changed(result_of(tmp_path, path, cfg, parameters, {**HELD, **flags}), delay_s=3.375 * DT)  # 14 steps
    content = json.loads(result.read_text())
    changed(result, parameters=content["parameters"] | {"delay": {"all": 3.375}})
    targets = 0.4 * chirp(2)
    expected, _ = identified_motion(result, targets)
    text = export(result, page).text

    rows: dict[str, dict] = {}
    if page == "newton":
        exec(text, written := {})
        rows = {name: written["JOINTS"][name] | written["DRIVES"][name] for name in names}
    else:
        for name in names:
            part = text[text.index(f"('{name}',)") :]
            rows[name] = {
                key: float(part.split(f"{field}=")[1].split(",")[0])
                for key, field in (("kp", "stiffness"), ("kd", " damping"), ("armature", "armature"))
            }
    model = mujoco.MjModel.from_xml_string(export(result, "mjcf", joints_only=True).text)
    model.opt.timestep, data = DT / 4, mujoco.MjData(model)
    model.dof_armature[:] = [rows[name]["armature"] for name in names]
    kp, kd = (np.array([rows[name][key] for name in names]) for key in ("kp", "kd"))
    data.qpos[:], found = targets[0], []
    late = [targets[0]] * 14 + list(targets.repeat(4, axis=0))
    for k, target in enumerate(late[: 4 * STEPS]):
        if k % 4 == 0:
            found.append(data.qpos.copy())
        data.qfrc_applied[:] = kp * (target - data.qpos) - kd * data.qvel
        mujoco.mj_step(model, data)
    assert np.ptp(expected, axis=0).min() > 0.2 and np.abs(np.array(found) - expected).max() < 1.5e-4


def test_a_model_whose_meshes_are_missing_is_written_without_them(tmp_path):
    path = tmp_path / "arm.xml"
    mesh = '<asset><mesh name="m" file="gone.stl"/><texture name="t" type="2d" file="gone.png"/></asset>'
    path.write_text(
        STIFF.replace("<worldbody>", mesh + "<worldbody>").replace(
            "</body></body>", '<geom type="mesh" mesh="m"/></body></body>'
        )
    )
    spec, notes = model_of(path)
    assert spec.compile().ngeom == 0
    assert notes == ["2 files of the model are missing (gone.stl, gone.png): left out."]
    path.write_text(STIFF)
    assert model_of(path)[1] == []


def test_gravity_and_held_joints_of_the_fit_are_in_the_file_or_in_a_note(tmp_path, monkeypatch):
    """A rig on a wall: its export hung down."""
    path = tmp_path / "arm.xml"
    path.write_text(STIFF)
    cfg = cfg_from_model(path).holding({"wrist": 0.3})
    parameters = {name: {"shoulder": 0.1} for name in ("armature", "viscous_friction", "friction", "encoder_bias")}
    exported = export(result_of(tmp_path, path, cfg, parameters, {}), "mjcf")
    assert mujoco.MjModel.from_xml_string(exported.text).opt.gravity.tolist() == [0.0, 0.0, -9.81]
    assert "free here: wrist at 0.3" in " ".join(exported.notes) and "gravity" not in " ".join(exported.notes)

    def on_a_wall(drives):
        cfg = load_identified_cfg(drives)
        cfg.sim.gravity = (0.0, 9.81, 0.0)
        return cfg

    monkeypatch.setattr(sys.modules["pace_optim.export.mjcf"], "load_identified_cfg", on_a_wall)
    exported = export(tmp_path / "result.json", "mjcf")
    assert mujoco.MjModel.from_xml_string(exported.text).opt.gravity.tolist() == [0.0, 9.81, 0.0]
    assert "gravity is that of the fit" in " ".join(exported.notes)


def test_joints_without_drives_rub_as_in_the_fit(tmp_path):
    path = tmp_path / "arm.xml"
    inertial = '<inertial pos="0 0 0.01" mass="0.1" diaginertia="1 1 1"/>'
    flap = f'<body><joint name="flap" frictionloss="0.01"/>{inertial}</body>'
    path.write_text(STIFF.replace("</body></body>", f"{flap}</body></body>"))
    cfg = cfg_from_model(path)
    value = dict.fromkeys(cfg.sim2real.joint_order, 0.1)
    parameters = dict.fromkeys(("armature", "viscous_friction", "friction", "encoder_bias"), value)
    gains = dict.fromkeys(("stiffness", "damping"), value)
    exported = export(result_of(tmp_path, path, cfg, parameters, gains), "mjcf")
    model = mujoco.MjModel.from_xml_string(exported.text)
    assert list(value) == ["shoulder", "wrist"] and model.dof_frictionloss.tolist() == [0.1, 0.1, 0.01]
    assert np.ptp(model.dof_solref, axis=0).max() == 0.0 == np.ptp(model.dof_solimp, axis=0).max()


def test_a_urdf_keeps_its_shapes_and_has_the_identified_limits_alone(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(WITH_SHAPES)
    (tmp_path / "arm.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    cfg = cfg_from_model(path)
    parameters = {name: {"hinge": 0.1} for name in ("armature", "viscous_friction", "friction", "encoder_bias")}
    drive = {"stiffness": {"hinge": 50.0}, "damping": {"hinge": 1.0}, "effort_limit": {"hinge": 150.0}}
    exported = export(result_of(tmp_path, path, cfg, parameters, drive), "mjcf")
    model = mujoco.MjModel.from_xml_string(exported.text)
    assert model.ngeom == 2 and model.nmesh == 1
    assert not model.jnt_actfrclimited.any() and model.actuator_forcerange.tolist() == [[-150.0, 150.0]]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0 and "base and arm" in " ".join(exported.notes)


WITH_SHAPES = """
<robot name="arm">
  <link name="root"/>
  <link name="base"><inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="1 1 1"/></geometry></collision></link>
  <link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="arm.obj"/></geometry></collision></link>
  <joint name="table" type="fixed"><parent link="root"/><child link="base"/></joint>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit effort="1" lower="-1" upper="1" velocity="1"/></joint>
</robot>
"""

STIFF = """
<mujoco>
  <worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0" armature="0.1"/>
      <inertial pos="0.2 0 0" mass="4" diaginertia="0.02 0.06 0.06"/>
      <body name="hand" pos="0.4 0 0"><joint name="wrist" axis="1 0 0" armature="0.02"/>
        <inertial pos="0.03 0 0.01" mass="0.4" diaginertia="0.0003 0.0003 0.0003"/></body></body>
  </worldbody>
  <actuator>
    <position name="a" joint="shoulder" kp="2000" kv="200" forcerange="-150 150"/>
    <position name="b" joint="wrist" kp="500" kv="50" forcerange="-28 28"/>
  </actuator>
</mujoco>
"""

MOTORS = """
  <actuator>
    <motor name="a" joint="shoulder" ctrlrange="-150 150"/>
    <motor name="b" joint="wrist" ctrlrange="-28 28"/>
  </actuator>
</mujoco>
"""

FOREIGN = """
<mujoco>
  <compiler angle="degree"/>
  <option timestep="0.002"/>
  <default><position kp="7" forcerange="-3 3"/></default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="arm/shoulder" axis="0 1 0" range="-90 90" damping="0.1" armature="0.01"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="arm/elbow" axis="0 1 0" ref="10"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.5"/>
        <body name="finger" pos="0 0 -0.2"><joint name="finger" axis="1 0 0"/><geom size="0.02" mass="0.1"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="last" joint="finger" kp="2"/>
    <position name="servo" joint="arm/shoulder" gear="3" kv="1" ctrlrange="-30 30"/>
    <damper name="brake" joint="arm/shoulder" kv="2" ctrlrange="0 1"/>
  </actuator>
  <sensor><actuatorfrc name="force" actuator="servo"/></sensor>
  <keyframe><key name="home" qpos="0.3 0.2 0.1" ctrl="1 2 0"/></keyframe>
</mujoco>
"""


def test_another_robots_actuators_are_updated_by_joint(tmp_path):
    """Its file has actuators, degrees, a keyframe, a sensor and a joint that was not identified."""
    spec = mujoco.MjSpec.from_string(FOREIGN)
    inf, common = np.inf, {"delay_s": 0.005}
    drives = {
        "arm/shoulder": PlainDrive(
            stiffness=30.0, damping=1.5, effort_limit=20.0, saturation_effort=inf, velocity_limit=inf,
            encoder_bias=0.05, **common,
        ),
        "arm/elbow": PlainDrive(
            stiffness=0.0, damping=2.0, effort_limit=inf, saturation_effort=9.0, velocity_limit=5.0,
            encoder_bias=-0.02, **common,
        ),
    }  # fmt: skip
    before = spec.compile()
    notes = " ".join(write_drives(spec, drives, 0.002))
    spec.compile()
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    names = [model.actuator(i).name for i in range(model.nu)]
    assert names == ["last", "servo", "arm/elbow"]  # in its place, by its name; the second on a joint goes
    assert "brake" in notes and model.sensor("force").objid[0] == 1
    servo = model.actuator("servo")
    assert servo.gear[0] == 1 and servo.biasprm[1] == -30 and servo.biasprm[2] == -1.5 and servo.forcerange[1] == 20
    assert not model.actuator_ctrllimited[1] and model.actuator("last").gainprm[0] == 2  # the finger's is untouched
    assert np.allclose(model.actuator_delay, [0, 0.005, 0.005]) and model.actuator_history[1, 0] == 3
    data = mujoco.MjData(model)
    data.qvel[1] = 1.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[1] == pytest.approx(-2.0)
    assert np.allclose(model.jnt_range[0], np.radians([-90, 90]) - 0.05)
    assert np.allclose(model.key_qpos[0], [0.25, 0.22, 0.1])
    place = mujoco.MjData(before), mujoco.MjData(model)
    place[0].qpos[:], place[1].qpos[:] = before.key_qpos[0], model.key_qpos[0]
    for made, state in zip((before, model), place, strict=True):
        mujoco.mj_kinematics(made, state)
    assert np.allclose(place[0].xpos, place[1].xpos, atol=1e-6)  # the same posture, by what the encoders show
