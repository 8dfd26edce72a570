"""The identified drive gives the same torque wherever it runs: identification, training, mjlab, Isaac Lab."""

import json
import sys
import warnings

import numpy as np
import pytest
import torch
from other_simulators import ROOT, isaaclab_wheel, others_python, run
from torque_sequence import DT, ENVS, GAINS, JOINTS, STEPS, sequence, write_result

from pace_actuators import IdentifiedDrives, PaceDCMotor, PaceDCMotorCfg
from pace_envs import ManagerBasedEnv, ManagerBasedRLEnv, load_env_cfg
from pace_envs.identified import set_identified_step, use_identified
from pace_optim.export import export
from pace_optim.problem.parameter_space import ParameterSpace

MODES = ("command", "effort")


def torques(env: ManagerBasedEnv) -> dict[str, np.ndarray]:
    """Of an environment's robot on the sequence; state and targets are written, the physics never steps."""
    robot, data = env.scene["robot"], sequence()
    assert robot.joint_names == list(JOINTS)
    env.scene.reset()
    result = []
    for command, position, velocity in zip(data["command"], data["position"], data["velocity"], strict=True):
        robot.write_joint_state_to_sim(torch.tensor(position), torch.tensor(velocity))
        robot.set_joint_position_target(torch.tensor(command))
        env.scene.write_data_to_sim()
        result.append(robot.data.applied_torque.clone().numpy())
    columns = robot.dof_columns
    fields = {"friction": "dof_frictionloss", "armature": "dof_armature", "viscous": "dof_damping"}
    found = {name: env.sim.expand(field)[:, columns].clone().numpy() for name, field in fields.items()}
    env.close()
    return {"torque": np.stack(result), **found}


def in_identification(result) -> dict[str, np.ndarray]:
    """As a fit sets its candidates."""
    drives = IdentifiedDrives.load(result)
    cfg = load_env_cfg("Pace-AnymalD-v0")
    cfg.scene.num_envs, cfg.sim.num_threads = ENVS, 1
    for drive in cfg.scene.robot.actuators.values():
        drive.delay_mode = drives.delay_mode
    cfg.set_effects([effect.label for effect in drives.effects])
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    space = ParameterSpace.of(cfg.sim2real)
    space.apply(env, space.from_dict(drives.parameters).expand(ENVS, -1))
    return torques(env)


def in_training(result) -> dict[str, np.ndarray]:
    """As train.py takes the result."""
    cfg = load_env_cfg("Pace-AnymalD-Velocity-v0")
    cfg.scene.num_envs, cfg.sim.num_threads = ENVS, 1
    set_identified_step(cfg, result)
    assert use_identified(cfg, result, gains=True) == []
    return torques(ManagerBasedRLEnv(cfg))


@pytest.fixture(scope="module", params=MODES)
def reference(request, tmp_path_factory):
    result = write_result(tmp_path_factory.mktemp(request.param) / "result.json", request.param)
    return result, in_identification(result)


def assert_same(found, reference) -> None:
    """To 1e-5 of the root mean square torque, joint by joint, and so the friction and inertia beside it."""
    expected = reference["torque"]
    assert expected.shape == (STEPS, ENVS, len(JOINTS)) and np.abs(expected).max() > 50
    scale = np.sqrt(np.square(expected).mean(axis=(0, 1)))
    assert (np.abs(found["torque"] - expected).max(axis=(0, 1)) < 1e-5 * scale).all()
    for name in ("friction", "armature", "viscous"):
        assert np.allclose(found[name], reference[name], rtol=1e-5), name


def test_the_sequence_feels_every_part_of_the_drive(reference):
    """Without the delay, the bias or an effect the torques are others, by far more than the tolerance."""
    result, expected = reference
    full = PaceDCMotorCfg.from_result(result, physics_dt=DT)
    data = sequence()
    without = [full.effects[:i] + full.effects[i + 1 :] for i in (0, 1)]
    for change in ({"delay_s": 0.0}, {"encoder_bias": 0.0}, *({"effects": effects} for effects in without)):
        found = alone(PaceDCMotorCfg.from_result(result, physics_dt=DT, **change), data)
        assert np.abs(found - expected["torque"]).max() > 1.0, change
    assert np.abs(alone(full, data) - expected["torque"]).max() < 1e-3


def alone(cfg: PaceDCMotorCfg, data) -> np.ndarray:
    from pace_actuators import ActuatorActions

    motor = PaceDCMotor(cfg, JOINTS, slice(None), ENVS, dtype=torch.float64)
    return np.stack(
        [
            motor.compute(ActuatorActions(torch.tensor(c)), torch.tensor(p), torch.tensor(v)).joint_efforts.numpy()
            for c, p, v in zip(data["command"], data["position"], data["velocity"], strict=True)
        ]
    )


def test_the_training_environment_gives_the_torque_of_the_identification(reference):
    result, expected = reference
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # same steps: nothing to warn of
        assert_same(in_training(result), expected)


def test_isaac_lab_gives_the_torque_of_the_identification(reference, tmp_path):
    """Under the actuator classes of Isaac Lab's wheel, called as its articulation calls them; PhysX is not here."""
    result, expected = reference
    run(sys.executable, "isaaclab_torques.py", isaaclab_wheel(), result, tmp_path / "out.npz")
    found = np.load(tmp_path / "out.npz")
    assert_same(found, expected)
    scale = np.abs(found["theirs_delayed"]).max()
    assert np.abs(found["ours_delayed"] - found["theirs_delayed"]).max() < 1e-5 * scale
    assert np.abs(found["ours_biased"] - found["theirs_biased"]).max() < 1e-5 * scale
    assert "motor" in str(found["refused"])
    assert (found["load"] == -2.0).all() and int(found["applied"]) == 1
    assert np.allclose(found["written_friction"], found["friction"])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_isaac_lab_3_gives_the_torque_of_the_identification(reference, tmp_path):
    """In the actuator collection of Isaac Lab 3.0's wheel, through its own control bridge and kernels; one of the two
    as ``export --format isaaclab`` writes it."""
    result, expected = reference
    exported = []
    if IdentifiedDrives.load(result).delay_mode == "effort":
        export(result, "isaaclab").write(tmp_path / "cfg.py")
        exported = [tmp_path / "cfg.py"]
    run(others_python(), "isaaclab3_torques.py", isaaclab_wheel("3.0.0"), result, tmp_path / "out.npz", *exported)
    found = np.load(tmp_path / "out.npz")
    assert_same(found, expected)
    for name in ("delayed", "biased"):
        theirs = found[f"theirs_{name}"]
        assert np.abs(found[f"ours_{name}"] - theirs).max() < 1e-5 * np.abs(theirs).max()
    drive = PaceDCMotorCfg.from_result(result, physics_dt=DT)
    at_rest = PaceDCMotor(drive, JOINTS, slice(None), 1).joint_friction.numpy()
    assert np.allclose(found["friction_at_rest"], at_rest) and (found["limit"] > 200).all()  # the asset's own is 10
    bias = [IdentifiedDrives.load(result).parameters["encoder_bias"][joint] for joint in JOINTS]
    assert np.allclose(found["shown"], -np.array(bias), atol=1e-5) and (found["load"] == -2.0).all()
    assert "use_newton_actuators" in str(found["native"])  # Newton's own path refuses it in words
    assert str(found["refused"]).count("motor") == 2 and "armature" in str(found["refused"])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_mjlab_gives_the_torque_of_the_identification(reference, tmp_path):
    """In an entity and a simulation of mjlab, through its own position action."""
    result, expected = reference
    run(others_python(), "mjlab_torques.py", ROOT / "assets/anymal_d/anymal_d.xml", result, tmp_path / "out.npz")
    found = np.load(tmp_path / "out.npz")
    assert_same(found, expected)
    bias = np.array([IdentifiedDrives.load(result).parameters["encoder_bias"][joint] for joint in JOINTS])
    assert np.allclose(found["bias"], -bias, atol=1e-6)  # mjlab's encoder shows q + bias
    assert np.array_equal(found["spurious"], found["torque"])  # calls without a physics step leave no trace
    assert np.abs(found["ours"] - found["theirs"]).max() < 1e-5 * np.abs(found["theirs"]).max()
    assert np.allclose(found["solref"], [2 * DT, 1.0])
    assert np.allclose(found["applied"], found["torque"][-1], rtol=1e-5, atol=1e-4)  # what the joints get, unclipped
    assert "drive_friction_event" in str(found["unexpanded"]) and "motor" in str(found["refused"])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_newtons_actuators_give_the_drives_torque(tmp_path):
    """Of the exported page, built in Python and authored in USD: delay in whole steps, bias and clamps included."""
    result = write_result(tmp_path / "result.json", delay=3.0)
    content = json.loads(result.read_text())
    content["effects"] = ["torque_gain"]  # Newton has no others: the export says so
    result.write_text(json.dumps(content))
    exported = export(result, "newton")
    exported.write(tmp_path / "drives.py")
    run(others_python(), "newton_torques.py", tmp_path / "drives.py", tmp_path / "out.npz")
    found, drives = np.load(tmp_path / "out.npz"), IdentifiedDrives.load(result)
    expected = alone(PaceDCMotorCfg.from_result(result, physics_dt=DT), sequence())
    scale = np.sqrt(np.square(expected).mean(axis=(0, 1)))
    # driven faster than its line reaches, a motor with a torque gain brakes with another limit there
    within = np.abs(sequence()["velocity"]) < GAINS["velocity_limit"] * (
        1 + GAINS["effort_limit"] / GAINS["saturation_effort"]
    )
    assert within.mean() > 0.99
    for name in ("torque", "usd_torque"):
        assert (np.abs(found[name] - expected) * within < 1e-5 * scale).all(), name
    for name, parameter in (("armature", "armature"), ("friction", "friction"), ("damping", "viscous_friction")):
        value = list(drives.values(parameter, JOINTS).values())
        assert np.allclose(found[name], value) and np.allclose(found[f"usd_{name}"], value), name
