"""Motors that move several joints through a constant matrix, against plain MuJoCo."""

import json
from dataclasses import replace
from types import SimpleNamespace

import coupled_drives
import mujoco
import numpy as np
import pytest
import torch

from pace_actuators import PaceDCMotorCfg
from pace_actuators.effects.fading_friction import solver_parameters, step_of_constraint
from pace_envs import ManagerBasedRLEnv
from pace_envs.from_model import cfg_from_model
from pace_envs.model_file import read_model_file
from pace_envs.motor_coordinates import DrivenJoints
from pace_envs.robot_spec import load_robot_spec
from pace_envs.task_source import EnvironmentRecord
from pace_optim.estimate.least_squares import LeastSquaresCfg, least_squares
from pace_optim.export import export
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.problem.problem import load_problem
from pace_optim.recording import load_recording, save_recording

WRIST = coupled_drives.CASES[0]


def rows_of(case):
    return np.array([[row.get(joint, 0.0) for joint in case.joints] for row in case.rows.values()])


def problem_of(folder, case, names, turn=None, **options):
    """The problem that a recording of the plant poses, its columns turned by a matrix."""
    (folder / "robot.xml").write_text(case.xml())
    log = coupled_drives.record(case, 0, 1.2, noise=2e-5)
    turn = np.eye(2) if turn is None else turn
    turned = {key: log[key] @ turn.T for key in ("dof_pos", "des_dof_pos")}
    np.savez(folder / "log.npz", time=log["time"], joint_names=np.array(names), **turned)
    return load_problem(
        str(folder / "robot.xml"), data=[folder / "log.npz"], drive_dt=1e-3, tell=lambda _: None, **options
    )


@pytest.fixture(scope="module")
def wrist(tmp_path_factory):
    """The wrist at its true parameters, of a recording of its motors."""
    problem = problem_of(tmp_path_factory.mktemp("wrist"), WRIST, tuple(WRIST.rows))
    own = {name: dict(zip(WRIST.rows, pair, strict=True)) for name, pair in WRIST.truth.items()}
    truth = problem.space.from_dict({**own, "delay": {"all": WRIST.delay / 1e-3}})
    return SimpleNamespace(problem=problem, truth=truth)


def moved(problem, physical):
    rollout = problem.evaluator().rollout(1)
    rollout.start(physical[None], torch.ones_like(problem.dataset.train))
    return rollout


def shown_by(problem, physical):
    """Positions at every control step before the bias, (T, n) [rad]; drives are compiled."""
    return moved(problem, physical).positions(torch.arange(len(problem.dataset.measured)))[:, 0]


@pytest.mark.parametrize("soft", [0.0, 0.03], ids=["hard", "soft"])
@pytest.mark.parametrize("case", coupled_drives.CASES, ids=lambda case: case.name)
def test_motors_move_as_tendons_of_plain_mujoco(case, soft, tmp_path):
    """Step by step, with MuJoCo's own steps: armature, damping, friction and torque of the motors."""
    path = tmp_path / "robot.xml"
    path.write_text(case.xml())
    cfg = cfg_from_model(path, 1e-3)
    cfg.sim.integrator, cfg.scene.num_envs = "implicitfast", 2
    cfg.set_effects(["soft_friction"] if soft else [])
    env = ManagerBasedRLEnv(cfg)
    robot, rows = env.scene["robot"], rows_of(case)
    if soft:
        robot.write_effect_parameter_to_sim("soft_friction", "time_constant", torch.full((2, 1), soft).double())
    for name in ("armature", "viscous_friction", "friction"):
        robot.write_base_parameter_to_sim(name, torch.tensor([case.truth[name]] * 2).double())
    model = mujoco.MjModel.from_xml_string(case.xml())
    model.tendon_armature[:], model.tendon_damping[:] = case.truth["armature"], case.truth["viscous_friction"]
    model.tendon_frictionloss[:], model.tendon_solref_fri[:] = case.truth["friction"], (2e-3, 1.0)
    model.tendon_solimp_fri[:] = (0.999, 0.999, 0.001, 0.5, 2.0)
    if soft:
        constant, impedance = solver_parameters(*step_of_constraint(torch.tensor(soft).double(), 1e-3))
        model.tendon_solref_fri[:, 0], model.tendon_solimp_fri[:, :2] = float(constant), float(impedance)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    start = np.array([0.2, -0.1])
    data.qpos[:] = np.linalg.solve(rows, start)
    robot.write_joint_state_to_sim(torch.tensor(start)[None], torch.zeros(1, 2))
    assert set(robot.joint_names) == set(case.rows)
    apart = 0.0
    for target in coupled_drives.commands(case, 0, 300):
        position, speed = rows @ data.qpos, rows @ data.qvel
        apart = max(apart, float(np.abs(robot.data.joint_pos[1].numpy() - position).max()))
        torque = case.kp * (target - position) - case.kd * speed
        data.qfrc_applied[:] = rows.T @ np.clip(torque, -case.limit, case.limit)
        mujoco.mj_step(model, data)
        env.step(torch.tensor(np.stack([target] * 2)))
    env.close()
    assert apart < 1e-8


def test_what_a_motor_carries_is_that_of_its_joints_at_the_motor(tmp_path):
    """Inertia R⁻ᵀ M R⁻¹ without armature, R⁻ᵀ times the torque of the load, and its slope over the motor's angle."""
    case, place = coupled_drives.CASES[1], np.array([0.1, -0.1])
    path = tmp_path / "robot.xml"
    path.write_text(case.xml())
    cfg = cfg_from_model(path, 1e-3)
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg)
    robot, inverse = env.scene["robot"], np.linalg.inv(rows_of(case))
    robot.write_base_parameter_to_sim("armature", torch.tensor([case.truth["armature"]]).double())
    robot.write_joint_state_to_sim(torch.tensor(place)[None], torch.zeros(1, 2))
    robot.load_effort  # noqa: B018 (MuJoCo computes what is bound)
    env.sim.forward()
    inertia, stiffness, _ = (each[0].numpy() for each in env.sim.felt_link(robot.dof_columns))
    load = robot.load_effort[0].numpy()
    env.close()
    model = mujoco.MjModel.from_xml_string(case.xml())
    data, mass = mujoco.MjData(model), np.zeros((2, 2))

    def weight(at):
        data.qpos[:] = inverse @ at
        mujoco.mj_forward(model, data)
        return inverse.T @ data.qfrc_bias

    slopes = [(weight(place + step) - weight(place - step)) / 2e-5 for step in 1e-5 * np.eye(2)]
    assert load == pytest.approx(-weight(place), abs=1e-9)
    mujoco.mj_fullM(model, data, mass)
    assert inertia == pytest.approx(np.diag(inverse.T @ mass @ inverse), abs=1e-9)
    assert stiffness == pytest.approx(np.diag(slopes), rel=1e-3)  # of each joint alone


@pytest.mark.slow
def test_the_plant_moves_as_the_true_parameters_say(wrist):
    shown, measured = shown_by(wrist.problem, wrist.truth), wrist.problem.dataset.measured
    error = shown - torch.tensor(WRIST.truth["encoder_bias"]) - measured[:, 0]
    assert float(error.square().mean().sqrt()) < 1e-4


@pytest.mark.slow
def test_compiled_drives_move_as_stepped_ones(wrist):
    steps = torch.arange(0, 300, 7)
    compiled = moved(wrist.problem, wrist.truth).positions(steps)
    stepped = [position.clone() for position in moved(wrist.problem, wrist.truth).simulated(300)]
    assert torch.allclose(compiled, torch.stack(stepped)[steps], atol=1e-10)


@pytest.mark.slow
def test_a_motor_alone_along_the_motion_of_the_other_moves_as_on_the_robot(wrist):
    problem = wrist.problem
    path = reference_path(problem, wrist.truth)
    twins = twin_problem(problem, path)
    shown = shown_by(problem, wrist.truth)[:400, None]
    alone = torch.stack([each.clone() for each in moved(twins, wrist.truth).simulated(400)])
    assert float((alone - shown).abs().max()) < 3e-4
    second = twins.on_joints(torch.tensor([False, True]))
    values = problem.space.to_dict(wrist.truth)
    own = {name: {key: each for key, each in of.items() if key != "motor_a"} for name, of in values.items()}
    part = torch.stack([each.clone() for each in moved(second, second.space.from_dict(own)).simulated(400)])
    assert torch.allclose(part[..., 0], alone[..., 1], atol=1e-9)


@pytest.mark.slow
def test_a_recording_of_joints_is_one_of_their_motors(wrist, tmp_path):
    problem = problem_of(tmp_path, WRIST, WRIST.joints, np.linalg.inv(rows_of(WRIST)))
    assert problem.joint_names == tuple(WRIST.rows)
    assert torch.allclose(problem.dataset.measured, wrist.problem.dataset.measured, atol=1e-12)
    assert torch.allclose(problem.dataset.command, wrist.problem.dataset.command, atol=1e-12)
    assert "turned into their motors motor_a, motor_b" in " ".join(problem.dataset.recordings[0].notes)


@pytest.mark.slow
def test_a_log_states_the_motors_that_the_model_file_lacks(wrist, tmp_path):
    """Of joints' columns; a run finds them again. A belt beside a joint's own drive has a row for that too."""
    for case in (WRIST, coupled_drives.CASES[2]):
        path = tmp_path / f"{case.name}.xml"
        path.write_text(case.xml(bare=True))
        log = coupled_drives.record(case, 0, 0.5, noise=2e-5)
        turned = {key: log[key] @ np.linalg.inv(rows_of(case)).T for key in ("dof_pos", "des_dof_pos")}
        file = tmp_path / f"{case.name}.npz"
        np.savez(file, time=log["time"], joint_names=np.array(case.joints), **turned)
        file.with_suffix(".json").write_text(json.dumps(case.facts()))
        problem = load_problem(str(path), data=[file], drive_dt=1e-3, tell=lambda _: None)
        assert problem.joint_names == tuple(case.rows)
        assert np.allclose(problem.dataset.measured[:, 0].numpy(), log["dof_pos"][: len(problem.dataset.measured)])
        record = EnvironmentRecord.of(str(path), problem.plain_cfg)
        again = EnvironmentRecord.read(json.loads(json.dumps(record.to_dict())), str(path)).load_cfg("record")
        assert again.sim2real.joint_order == tuple(case.rows)
    save_recording(tmp_path / "saved.npz", load_recording(file))
    assert load_recording(tmp_path / "saved.npz").couplings == case.rows
    file.with_suffix(".json").write_text(json.dumps({"couplings": {"a": 2}}))
    with pytest.raises(ValueError, match=r"expected \{motor: \{joint: ratio\}\}"):
        load_recording(file)


@pytest.mark.slow
def test_a_fit_finds_the_motors(wrist):
    problem = wrist.problem
    evaluator, cfg = problem.training_evaluator(), LeastSquaresCfg(max_iteration=6)
    best = least_squares(evaluator, [problem.space.start], cfg)[0]
    found = problem.space.to_dict(problem.space.to_physical(best.x))
    for name in ("armature", "viscous_friction", "friction"):
        assert list(found[name].values()) == pytest.approx(WRIST.truth[name], rel=0.02)


def test_the_exported_model_moves_as_the_fit_in_plain_mujoco(wrist, tmp_path):
    """The motors' armature, damping and friction are their tendons', their bias the joints' ref."""
    problem, motors = wrist.problem, list(WRIST.rows)
    values = problem.space.to_dict(wrist.truth)
    drive = {"stiffness": WRIST.kp, "damping": WRIST.kd, "effort_limit": WRIST.limit, "second_order": 1.0}
    content = {
        "version": 1, "task": problem.task, "joint_names": motors, "effects": [], "delay_mode": "command",
        "physics_dt": problem.physics_dt, "control_dt": 1e-3, "parameters": values, "delay_s": WRIST.delay, "std": {},
        "drive": {name: dict.fromkeys(motors, value) for name, value in (drive | {"drive_dt": 1e-3}).items()},
    }  # fmt: skip
    (tmp_path / "result.json").write_text(json.dumps(content))
    written = export(tmp_path / "result.json", "mjcf")
    bias = np.array(WRIST.truth["encoder_bias"])
    fitted = shown_by(problem, wrist.truth).numpy() - bias
    target = problem.dataset.recordings[0].command
    shown = coupled_drives.replay(written.text, motors, rows_of(WRIST), target, fitted[0])
    assert np.abs(shown - fitted).max() < 2e-4  # of 0.35 rad, from rest to 4 Hz in 1.2 s
    assert "motor_a, motor_b: tendons" in " ".join(written.notes)
    assert json.loads(export(tmp_path / "result.json", "json").text)["couplings"] == WRIST.rows
    with pytest.raises(ValueError, match="Use the format mjcf"):
        export(tmp_path / "result.json", "newton")


FINGERS = """<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast"/><worldbody>
<body pos="0 .02 0"><joint name="left" axis="1 0 0" armature=".003"/>
  <inertial pos="0 .01 .1" mass=".05" diaginertia="1e-4 1e-4 1e-4"/></body>
<body pos="0 -.02 0"><joint name="right" axis="-1 0 0"/>
  <inertial pos="0 .01 .1" mass=".05" diaginertia="1e-4 1e-4 1e-4"/></body>
</worldbody><equality><joint joint1="right" joint2="left"/></equality>
<tendon><fixed name="split"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed></tendon>
<actuator><position tendon="split" kp="4" kv=".1"/></actuator></mujoco>"""


@pytest.mark.slow
def test_a_gripper_s_tendon_pulls_both_fingers(tmp_path):
    """As MuJoCo's own servo does at fine steps; the first finger alone would bend the soft constraint between them."""
    path = tmp_path / "hand.xml"
    path.write_text(FINGERS)
    cfg = cfg_from_model(path, 1e-3)
    cfg.sim.integrator, cfg.scene.num_envs, parts = "leapfrog", 1, 50
    cfg.sim.dt, cfg.decimation = 5e-4, 2
    cfg.scene.robot.actuators["drives"].control_decimation = 2
    model = mujoco.MjModel.from_xml_string(FINGERS)
    model.opt.timestep = 1e-3 / parts
    targets, shown = 0.3 * np.sin(2 * np.pi * 3e-3 * np.arange(300)), {"plain": []}
    data = mujoco.MjData(model)
    for target in targets:
        shown["plain"].append(0.5 * float(data.qpos.sum()))
        data.ctrl[:] = target
        for _ in range(parts):
            mujoco.mj_step(model, data)
    for name, couplings in (("both", cfg.scene.robot.couplings), ("first", {})):
        cfg.scene.robot.couplings, shown[name] = couplings, []
        env = ManagerBasedRLEnv(cfg)
        robot = env.scene["robot"]
        robot.write_joint_state_to_sim(torch.zeros(1, 1), torch.zeros(1, 1))
        for target in targets:
            shown[name].append(float(robot.data.joint_pos[0, 0]))
            env.step(torch.full((1, 1), target))
        env.close()
    both, first = (np.abs(np.subtract(shown[name], shown["plain"])).max() for name in ("both", "first"))
    assert both < 3e-4 and both < 0.2 * first


def test_an_exported_gripper_s_servo_pulls_both_fingers(tmp_path):
    (tmp_path / "hand.xml").write_text(FINGERS)
    values = {"armature": 0.004, "viscous_friction": 0.01, "friction": 0.02, "encoder_bias": 0.01}
    content = {
        "version": 1, "task": str(tmp_path / "hand.xml"), "joint_names": ["left"], "effects": [], "std": {},
        "delay_mode": "command", "physics_dt": 5e-4, "control_dt": 1e-3, "delay_s": 0.0,
        "parameters": {name: {"left": value} for name, value in values.items()} | {"delay": {"all": 0.0}},
        "drive": {"stiffness": {"left": 4.0}, "damping": {"left": 0.1}},
    }  # fmt: skip
    (tmp_path / "result.json").write_text(json.dumps(content))
    model = mujoco.MjModel.from_xml_string(export(tmp_path / "result.json", "mjcf").text)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5
    mujoco.mj_forward(model, data)
    assert model.nu == 1 and data.actuator_length[0] == pytest.approx(-0.01)  # what the encoder shows at 0
    assert data.qfrc_actuator == pytest.approx([1.02, 1.02])
    assert "the drive of left pulls right too" in " ".join(export(tmp_path / "result.json", "newton").notes)


def test_motors_that_do_not_determine_their_joints_are_refused(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(WRIST.xml().replace('coef="-1.0"', 'coef="1.0"'))
    with pytest.raises(ValueError, match="motor_a, motor_b turn the joints pitch, roll: 2 independent drives"):
        cfg_from_model(path)
    path.write_text(WRIST.xml().replace('<position name="motor_b"', '<position name="other" joint="pitch" kp="1"/><!--')
                    .replace("</actuator>", "--></actuator>"))  # fmt: skip
    assert cfg_from_model(path).sim2real.joint_order == ("motor_a", "pitch")


def test_a_motor_between_branches_is_refused(tmp_path):
    path = tmp_path / "robot.xml"
    apart = FINGERS.replace('<equality><joint joint1="right" joint2="left"/></equality>', "")
    second = '<fixed name="turn"><joint joint="left" coef="1"/><joint joint="right" coef="-1"/></fixed></tendon>'
    path.write_text(apart.replace("</tendon>", second).replace("</actuator>", '<motor tendon="turn"/></actuator>'))
    cfg = cfg_from_model(path)
    with pytest.raises(ValueError, match="split moves left, right, which lie on different branches"):
        ManagerBasedRLEnv(cfg)


def test_groups_of_motors_are_held_together(wrist, tmp_path):
    cfg = wrist.problem.plain_cfg
    robot = replace(cfg.scene.robot, held_joints={"motor_a": 0.3, "motor_b": 0.1}, joint_order=None)
    model = load_robot_spec(robot).compile()
    assert model.njnt == 0 and model.ntendon == 0
    with pytest.raises(ValueError, match="held together, or none of them"):
        load_robot_spec(replace(robot, held_joints={"motor_a": 0.3}))


def test_a_configuration_and_a_urdf_state_motors_too(tmp_path):
    """Differential transmissions of ROS; what a file gives the joints for drives is left to the motors."""
    urdf = tmp_path / "wrist.urdf"
    urdf.write_text(URDF)
    motors = read_model_file(urdf).urdf.motors
    cfg = cfg_from_model(urdf, motors=motors)
    assert cfg.sim2real.joint_order == ("a", "b_motor")
    env = ManagerBasedRLEnv(cfg)
    assert env.scene["robot"].driven.row_of("b_motor") == {"pitch": 1.5, "b": -2.0}
    assert env.scene["robot"].driven.row_of("a") == {"pitch": 1.5, "b": 2.0}
    env.close()
    plain = tmp_path / "plain.xml"
    text = WRIST.xml()
    plain.write_text(text[: text.index("<tendon>")].replace('name="roll"', 'name="roll" damping="3"') + "</mujoco>")
    robot = cfg_from_model(plain).scene.robot
    drives = {"all": PaceDCMotorCfg(joint_names_expr=["motor_.*"], stiffness=1.0, damping=0.1)}
    robot = replace(robot, joint_order=("motor_b", "motor_a"), couplings=WRIST.rows, actuators=drives)
    robot.init_state = replace(robot.init_state, joint_pos=0.0)
    model = load_robot_spec(robot).compile()
    assert not model.dof_damping.any()
    assert np.allclose(DrivenJoints.of_model(model, robot.joint_order).matrix, [[1.5, -1.0], [1.5, 1.0]][::1])


def test_a_urdf_s_drives_are_the_joints_unless_a_log_names_the_motors(tmp_path):
    """A log is in the coordinates that its columns name, and so are the gains and limits beside it."""
    urdf = tmp_path / "wrist.urdf"
    urdf.write_text(URDF)
    time = np.arange(0, 3, 0.005)
    swing = 0.3 * np.sin(2 * np.pi * 0.7 * time)[:, None] * [1.0, 0.8]

    def posed(names, gains):
        log = tmp_path / f"{names[0]}.csv"
        columns = [f"{name}_{kind}" for kind in ("pos", "cmd") for name in names]
        table = np.column_stack([time, swing, swing])
        np.savetxt(log, table, delimiter=",", header=",".join(["time", *columns]), comments="")
        log.with_suffix(".json").write_text(json.dumps({"stiffness": gains, "damping": 0.2}))
        return load_problem(str(urdf), data=[log], drive_dt=1e-3, tell=lambda _: None)

    problem = posed(("pitch", "b"), {"pitch": 12.0, "b": 7.0})
    assert problem.joint_names == ("pitch", "b")
    assert problem.dataset.recordings[0].drive.stiffness.tolist() == [12.0, 7.0]
    assert problem.env_cfg.scene.robot.actuators["drives"].effort_limit == [18.0, 12.0]  # of the joints
    motors = posed(("a", "b_motor"), {"a": 12.0, "b_motor": 7.0})
    assert motors.joint_names == ("a", "b_motor")
    assert motors.make_env(1).scene["robot"].driven.row_of("a") == {"pitch": 1.5, "b": 2.0}


URDF = """<robot name="wrist"><link name="base"/>
<link name="cross"><inertial><mass value=".1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>
</inertial></link>
<link name="hand"><inertial><mass value=".6"/><inertia ixx="2e-3" iyy="2e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/>
</inertial></link>
<joint name="pitch" type="revolute"><parent link="base"/><child link="cross"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="18" velocity="10"/></joint>
<joint name="b" type="revolute"><parent link="cross"/><child link="hand"/><axis xyz="1 0 0"/>
  <limit lower="-1" upper="1" effort="12" velocity="10"/></joint>
<transmission name="t"><type>transmission_interface/DifferentialTransmission</type>
  <actuator name="a"><role>actuator1</role><mechanicalReduction>50</mechanicalReduction></actuator>
  <actuator name="b"><role>actuator2</role></actuator>
  <joint name="pitch"><role>joint1</role><mechanicalReduction>1.5</mechanicalReduction></joint>
  <joint name="b"><role>joint2</role><mechanicalReduction>2</mechanicalReduction></joint></transmission></robot>"""
