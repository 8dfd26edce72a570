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


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    """A result of each mode, and its torques in the identification."""
    folder = tmp_path_factory.mktemp("results")
    results = {mode: write_result(folder / f"{mode}.json", mode) for mode in MODES}
    return {mode: (result, in_identification(result)) for mode, result in results.items()}


@pytest.fixture(params=MODES)
def reference(request, references):
    return references[request.param]


def elsewhere(python, script, references, folder, *args, fmt, pages=()) -> dict[str, dict[str, np.ndarray]]:
    """What another simulator found, by mode: one as it takes the result, the other as ``export`` writes it."""
    export(references["effort"][0], fmt).write(folder / "cfg.py")
    run(python, script, *args, folder / "out.npz", references["command"][0], folder / "cfg.py", *pages)
    found = np.load(folder / "out.npz")
    split = {name: name.partition("_") for name in found}
    kinds = {kind for kind, _, rest in split.values() if f"{kind}_torque" in found and rest}
    result = {kind: {rest: found[name] for name, (first, _, rest) in split.items() if first == kind} for kind in kinds}
    return result | {"": {name: found[name] for name, (first, _, _) in split.items() if first not in kinds}}


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


@pytest.mark.slow
def test_isaac_lab_gives_the_torque_of_the_identification(references, tmp_path):
    """Under the actuator classes of Isaac Lab's wheel, called as its articulation calls them; PhysX is not here."""
    found = elsewhere(sys.executable, "isaaclab_torques.py", references, tmp_path, isaaclab_wheel(), fmt="isaaclab")
    for mode in MODES:
        assert_same(found[mode], references[mode][1])
        assert int(found[mode]["applied"]) == 1
        assert np.allclose(found[mode]["written_friction"], found[mode]["friction"])
    plain = found[""]
    for name in ("delayed", "biased"):
        theirs = plain[f"theirs_{name}"]
        assert np.abs(plain[f"ours_{name}"] - theirs).max() < 1e-5 * np.abs(theirs).max()
    assert "motor" in str(plain["refused"]) and (plain["load"] == -2.0).all()
    assert "DriveFrictionMixin" in str(plain["unwritten"])  # a continuous loop's kd was nowhere
    assert "friction_is_written" in str(plain["unwritten"])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_isaac_lab_3_gives_the_torque_of_the_identification(references, tmp_path):
    """In the actuator collection of Isaac Lab 3.0's wheel, through its own control bridge and kernels."""
    wheel = isaaclab_wheel("3.0.0")
    found = elsewhere(others_python(), "isaaclab3_torques.py", references, tmp_path, wheel, fmt="isaaclab")
    for mode in MODES:
        assert_same(found[mode], references[mode][1])
        drives = IdentifiedDrives.load(references[mode][0])
        motor = PaceDCMotorCfg.from_result(drives.path, physics_dt=DT)
        at_rest = PaceDCMotor(motor, JOINTS, slice(None), 1).joint_friction.numpy()
        assert np.allclose(found[mode]["friction_at_rest"], at_rest)
        assert (found[mode]["limit"] > 200).all()  # the asset's own is 10
        bias = list(drives.values("encoder_bias", JOINTS).values())
        assert np.allclose(found[mode]["shown"], -np.array(bias), atol=1e-5)
        assert "use_newton_actuators" in str(found[mode]["native"])  # Newton's own path refuses it in words
    plain = found[""]
    for name in ("delayed", "biased"):
        theirs = plain[f"theirs_{name}"]
        assert np.abs(plain[f"ours_{name}"] - theirs).max() < 1e-5 * np.abs(theirs).max()
    assert (plain["load"] == -2.0).all()
    assert str(plain["refused"]).count("motor") == 2 and "armature" in str(plain["refused"])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_mjlab_gives_the_torque_of_the_identification(references, whole_steps, tmp_path):
    """In an entity and a simulation of mjlab, through its own position action; by our drive, and by mjlab's own."""
    robot = ROOT / "assets/anymal_d/anymal_d.xml"
    exported = export(whole_steps, "mjlab_native")
    exported.write(tmp_path / "native.py")
    assert "pace" not in exported.text.split('"""', 2)[2]  # none of our code
    pages = [tmp_path / "native.py"]
    found = elsewhere(others_python(), "mjlab_torques.py", references, tmp_path, robot, fmt="mjlab", pages=pages)
    for mode in MODES:
        assert_same(found[mode], references[mode][1])
        assert np.array_equal(found[mode]["spurious"], found[mode]["torque"])  # calls without a step leave no trace
        applied = found[mode]["torque"][-1]  # what the joints get, unclipped
        assert np.allclose(found[mode]["applied"], applied, rtol=1e-5, atol=1e-4)
    for kind, result in (*((mode, references[mode][0]) for mode in MODES), ("native", whole_steps)):
        bias = list(IdentifiedDrives.load(result).values("encoder_bias", JOINTS).values())
        assert np.allclose(found[kind]["bias"], -np.array(bias), atol=1e-6)  # mjlab's encoder shows q + bias
        assert np.allclose(found[kind]["solref"], [2 * DT, 1.0])
    plain, native = found[""], found["native"]
    assert np.abs(plain["ours"] - plain["theirs"]).max() < 1e-5 * np.abs(plain["theirs"]).max()
    assert "drive_friction_event" in str(plain["unexpanded"]) and "motor" in str(plain["refused"])
    assert str(plain["no_bias"]) == "encoder_bias of LF_HAA is nan, expected a finite number."
    assert_plain(native["torque"], whole_steps)
    drives = IdentifiedDrives.load(whole_steps)
    for name, parameter in (("armature", "armature"), ("friction", "friction"), ("viscous", "viscous_friction")):
        assert np.allclose(native[name], list(drives.values(parameter, JOINTS).values())), name


@pytest.fixture
def whole_steps(tmp_path):
    """A drive that other programs' own classes hold: whole steps of delay, bias, and the effects that are gains."""
    result = write_result(tmp_path / "whole_steps.json", delay=3.0)
    content = json.loads(result.read_text())
    content["effects"] = ["torque_gain"]  # they have no others: the exports say so
    result.write_text(json.dumps(content))
    return result


def assert_plain(torque, result) -> None:
    """The drive's torque, to 1e-5 of its root mean square.

    Driven faster than its line reaches, a motor with a torque gain brakes with another limit there.
    """
    expected = alone(PaceDCMotorCfg.from_result(result, physics_dt=DT), sequence())
    scale = np.sqrt(np.square(expected).mean(axis=(0, 1)))
    ratio = GAINS["effort_limit"] / GAINS["saturation_effort"]
    within = np.abs(sequence()["velocity"]) < GAINS["velocity_limit"] * (1 + ratio)
    assert within.mean() > 0.99
    assert (np.abs(torque - expected) * within < 1e-5 * scale).all()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_newtons_actuators_give_the_drives_torque(whole_steps, tmp_path):
    """Of the exported page, built in Python and authored in USD: delay in whole steps, bias and clamps included."""
    export(whole_steps, "newton").write(tmp_path / "drives.py")
    run(others_python(), "newton_torques.py", tmp_path / "drives.py", tmp_path / "out.npz")
    found, drives = np.load(tmp_path / "out.npz"), IdentifiedDrives.load(whole_steps)
    for name in ("add_actuators", "author_usd"):  # joints of other names were passed over
        assert JOINTS[0] in str(found[f"{name}_refused"])
    for name in ("torque", "usd_torque"):
        assert_plain(found[name], whole_steps)
    for name, parameter in (("armature", "armature"), ("friction", "friction"), ("damping", "viscous_friction")):
        value = list(drives.values(parameter, JOINTS).values())
        assert np.allclose(found[name], value) and np.allclose(found[f"usd_{name}"], value), name
