"""A fit's result becomes drives of other environments."""

import dataclasses
import json
import math
import re
import warnings
from pathlib import Path

import pytest
import torch
from command_lines import run_script
from places import ROOT
from problems import BENCH, chirp, make_problem, record
from torque_sequence import DT, GAINS, JOINTS, write_result

from pace_actuators import IdentifiedDrives, PaceDCMotor, PaceDCMotorCfg
from pace_actuators.drive_result import DriveResult
from pace_actuators.effects import get_effect
from pace_actuators.effects.fading_friction import solver_parameters, step_of_constraint
from pace_actuators.identified import draw, labels_with_std
from pace_actuators.representable import HERE, ISAACLAB, MJLAB, World, check_representable, refuse_inertia
from pace_envs import ManagerBasedRLEnv, TerrainCfg, load_env_cfg, set_physics_dt
from pace_envs.identified import doubts, set_identified_step, set_step, step_note, use_identified
from pace_envs.registration import registered_tasks
from pace_envs.rl import RunSettings, load_cfg, train
from pace_optim.commands import train as commands_train
from pace_optim.commands.train import _task_for
from pace_optim.identification.fit import fit
from pace_optim.recording import save_recording
from pace_optim.run.result import drive_in_force
from pace_optim.run.settings import FitSettings
from pace_optim.run.training_replay import replay_in_training

CHIRP = chirp(0.2)
WALK = "Pace-AnymalD-Velocity-v0"


@pytest.fixture
def result(tmp_path):
    return write_result(tmp_path / "result.json")


def changed(path: Path, **changes) -> Path:
    content = json.loads(path.read_text())
    for key, value in changes.items():
        if isinstance(value, dict):
            content.setdefault(key, {}).update(value)
        else:
            content[key] = value
    path.write_text(json.dumps(content))
    return path


def motor(cfg: PaceDCMotorCfg, dt: float, joints=JOINTS) -> PaceDCMotor:
    return PaceDCMotor(cfg, joints, slice(None), 1, physics_dt=dt, dtype=torch.float64)


def walking(result, num_envs: int = 2, **options) -> ManagerBasedRLEnv:
    cfg = load_env_cfg(WALK)
    cfg.scene.num_envs, cfg.sim.num_threads = num_envs, 1
    set_identified_step(cfg, result)
    use_identified(cfg, result, **options)
    return ManagerBasedRLEnv(cfg)


# ---- reading ---------------------------------------------------------------------------------------------------------


def test_every_parameter_arrives(result):
    drives, made = IdentifiedDrives.load(result), motor(PaceDCMotorCfg.from_result(result), DT)
    for name in ("armature", "viscous_friction", "friction", "encoder_bias"):
        assert getattr(made, name)[0].tolist() == pytest.approx(list(drives.parameters[name].values())), name
    assert made.time_lags.tolist() == pytest.approx([3.4]) and made.stiffness[0, 0] == 85.0
    for effect in made.effects.effects:
        for parameter in effect.parameters:
            expected = drives.parameters[f"{effect.name}.{parameter.name}"]
            assert getattr(effect, parameter.name)[0].tolist() == pytest.approx(list(expected.values()))


def test_a_group_of_joints_gets_its_own_values_and_effects(result):
    changed(result, effects=["torque_gain@.*KFE"], parameters={"torque_gain.gain": {f"{leg}_KFE": 1.1 for leg in LEGS}})
    cfg = PaceDCMotorCfg.from_result(result, ".*(HAA|KFE)", stiffness=50.0)
    joints = [joint for joint in JOINTS if not joint.endswith("HFE")]
    made = motor(cfg, DT, joints)
    assert made.armature[0].tolist() == pytest.approx([0.05 + 0.005 * JOINTS.index(joint) for joint in joints])
    assert made.stiffness[0, 0] == 50.0
    assert made.effects.effects[0].gain[0].tolist() == pytest.approx([1.0, 1.1] * 4)
    assert PaceDCMotorCfg.from_result(result, ".*HAA").effects == ()


def test_the_controller_keeps_the_rate_of_the_identification(result):
    changed(result, drive={"drive_dt": dict.fromkeys(JOINTS, 0.0005)})
    assert motor(PaceDCMotorCfg.from_result(result), 0.0005).run_dt == pytest.approx(0.0005)
    with pytest.raises(ValueError, match="Make the physics step finer"):
        motor(PaceDCMotorCfg.from_result(result), DT)
    env = walking(result)
    assert env.cfg.sim.dt == pytest.approx(0.0005)
    env.close()


def test_commands_that_act_on_time_go_on_to(result):
    changed(result, drive={"centred_commands": dict.fromkeys(JOINTS, 1.0)})
    assert PaceDCMotorCfg.from_result(result).centred_commands


def test_a_continuous_controller_stays_one(result):
    changed(result, drive={"implicit": {joint: 1.0 for joint in JOINTS if joint.endswith("KFE")}})
    assert PaceDCMotorCfg.from_result(result, ".*KFE").implicit
    assert not PaceDCMotorCfg.from_result(result, ".*HAA").implicit
    with pytest.raises(ValueError, match="Put them into separate groups"):
        PaceDCMotorCfg.from_result(result)


def test_one_line_tells_at_which_steps_a_training_runs_and_how_it_gets_faster(result):
    """Two lines named 1 ms and 0.5 ms as the step of the physics."""
    cfg, drives = load_env_cfg(WALK), IdentifiedDrives.load(result)
    before, control = cfg.sim.dt, drives.at.control_dt
    assert step_note(cfg, drives, before) == ""
    set_identified_step(cfg, drives)
    steps = "drives 2.5 ms, physics 2.5 ms, as in the fit (task: 5 ms)"
    assert control == DT and step_note(cfg, drives, before) == steps
    set_physics_dt(cfg, 0.0005)
    fine = step_note(cfg, drives, before)
    assert fine.startswith("drives 2.5 ms, physics 0.5 ms, as in the fit (task: 5 ms). Fine steps are slow")
    assert "--physics_dt 0.0025 --drive_dt 0.0025" in fine


LEGS = ("LF", "RF", "LH", "RH")


@pytest.mark.parametrize("dt", [0.0025, 0.00125, 0.00085])
def test_delays_travel_in_seconds(result, dt):
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        made = motor(PaceDCMotorCfg.from_result(result, control_decimation=2), dt / 2)
    assert made.time_lags.item() * dt == pytest.approx(3.4 * DT)


def test_a_step_that_changes_the_drive_is_warned_of(result):
    cfg = PaceDCMotorCfg.from_result(result)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motor(cfg, DT)  # the identification's own
        motor(cfg, DT / 2)
    with pytest.warns(UserWarning, match=r"delay of 8.5 ms \(1.7 control steps of 5 ms\) lies between two steps"):
        motor(cfg, 0.005)
    with pytest.warns(UserWarning, match=r"identified with physics steps of 2.5 ms, which are 0.5 ms here"):
        motor(cfg, 0.0005)
    with pytest.warns(UserWarning, match=r"longer than max_delay, 5 ms: max_delay was raised to 17 steps"):
        assert motor(cfg, 0.0005).time_lags.item() == pytest.approx(17.0)
    with pytest.warns(UserWarning, match=r"\(3.4 control steps of 2.5 ms\) becomes 10 ms: with"):
        motor(PaceDCMotorCfg.from_result(result, delay_interpolation="hold"), DT)


def test_seconds_need_the_time_of_a_step(result):
    with pytest.raises(ValueError, match="set physics_dt"):
        PaceDCMotor(PaceDCMotorCfg.from_result(result, effects=()), JOINTS, slice(None), 1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": 2}, "no fit result of version 1"),
        ({"effects": ["warp_drive"]}, r"no effect 'warp_drive'.*Import the module"),
        ({"effects": ["torque_offset"]}, "torque_offset.effort"),
        ({"parameters": {"armature": {"LF_HAA": 0.1}}}, "armature has no value for LF_HFE"),
        (
            {"parameters": {"friction": dict.fromkeys(JOINTS, math.nan)}},
            "friction/LF_HAA is nan, expected",
        ),
        ({"delay_mode": "torque"}, "delay_mode is 'torque'"),
        ({"joint_names": None}, "joint_names is 3, expected a list"),
    ],
)
def test_unusable_results_are_refused(result, changes, said):
    if "joint_names" in changes:
        changes = {"joint_names": 3}
    with pytest.raises(ValueError, match=said):
        IdentifiedDrives.load(changed(result, **changes))


def test_another_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        IdentifiedDrives.load(tmp_path)
    (tmp_path / "result.json").write_text("{")
    with pytest.raises(ValueError, match="is no JSON"):
        IdentifiedDrives.load(tmp_path)


# ---- what a world cannot represent -----------------------------------------------------------------------------------


def test_what_cannot_be_represented_is_said(result):
    effects = ["measurement_delay", "payload", "stribeck_friction"]
    zeros = dict.fromkeys(JOINTS, 0.0)
    changed(result, effects=effects, parameters={"measurement_delay.delay": zeros, "payload.ratio": zeros})
    drives = IdentifiedDrives.load(result)
    (here,) = check_representable(drives, HERE)
    assert "measurement_delay" in here and "no influence" in here
    for world, hook in ((MJLAB, "drive_friction_event"), (ISAACLAB, "DriveFrictionMixin")):
        said = check_representable(drives, world)
        assert len(said) == 3 and "--format mjcf" in said[1] and hook in said[2]
    with pytest.raises(ValueError, match=r"stribeck_friction.*cannot do"):
        check_representable(drives, World(name="a world", friction_per_step=False))


def test_a_continuous_loop_is_said_to_need_friction_of_each_step(result):
    """Only an exported page said so: a drive from a result had no damping in Isaac Lab."""
    drives = IdentifiedDrives.load(changed(result, drive={"implicit": dict.fromkeys(JOINTS, 1.0)}))
    found = {world.name: " ".join(check_representable(drives, world)) for world in (HERE, MJLAB, ISAACLAB)}
    assert ["runs continuously" in said for said in found.values()] == [False, True, True]


def test_soft_friction_is_in_training_and_wherever_mujoco_is(result):
    changed(result, effects=["soft_friction"], parameters={"soft_friction.time_constant": {"all": 0.02}})
    env, drives = walking(result), IdentifiedDrives.load(result)
    columns, step = env.scene["robot"].dof_columns, env.cfg.sim.dt
    constant, impedance = solver_parameters(*step_of_constraint(torch.tensor(0.02, dtype=torch.float64), step))
    assert torch.allclose(env.sim.expand("dof_solref")[:, columns, 0], constant)
    assert torch.allclose(env.sim.expand("dof_solimp")[:, columns, :2], impedance)
    env.close()
    assert check_representable(drives, HERE) == check_representable(drives, MJLAB) == []
    with pytest.raises(ValueError, match=r"soft_friction is MuJoCo's own.*Isaac Lab does not have"):
        check_representable(drives, ISAACLAB)
    with pytest.raises(ValueError, match="Soft friction is MuJoCo's own"):
        refuse_inertia(motor(PaceDCMotorCfg(**drives.cfg_fields()), DT), ISAACLAB)


def test_a_payload_weighs_in_training(result):
    changed(result, effects=["payload"], parameters={"payload.ratio": dict.fromkeys(JOINTS, 0.3)})
    env, plain = walking(result), load_env_cfg(WALK)
    plain.scene.num_envs = 1
    model = ManagerBasedRLEnv(plain).sim.model
    body = int(model.joint("LF_KFE").bodyid[0])
    assert env.sim.expand("body_mass")[:, body].tolist() == pytest.approx([1.3 * model.body_mass[body]] * 2)
    env.close()


def test_what_held_the_robot_stays_on_the_rig(result):
    """A soft mount is simulated when the recording is replayed, and not when a policy is trained."""
    effect = get_effect("mount_compliance")
    values = {f"mount_compliance.{p.name}": {"all": p.start} for p in effect.parameters}
    drives = IdentifiedDrives.load(changed(result, effects=["mount_compliance"], parameters=values))
    for world in (HERE, MJLAB, ISAACLAB):
        (said,) = check_representable(drives, world)
        assert "it is left out" in said
    assert PaceDCMotorCfg.from_result(result).effects == ()
    assert drives.cfg_fields(on_the_rig=True)["effects"][0].effect == "mount_compliance"
    cfg = load_env_cfg(WALK)
    assert use_identified(cfg, result, on_the_rig=True) and len(cfg.scene.robot.actuators["legs"].effects) == 1
    with pytest.raises(ValueError, match="mount_compliance depends on the joint's inertia"):
        refuse_inertia(motor(PaceDCMotorCfg(**drives.cfg_fields(on_the_rig=True)), DT), MJLAB)


def test_another_robot_is_refused(result):
    cfg = load_env_cfg("Pace-Go2-Velocity-v0")
    with pytest.raises(ValueError, match="of another robot: it has LF_HAA"):
        use_identified(cfg, result)
    some = IdentifiedDrives.load(result).joint_names[:3]
    short = {name: {j: 0.1 for j in some} for name in ("armature", "viscous_friction", "friction", "encoder_bias")}
    content = json.loads(result.read_text()) | {"joint_names": list(some), "effects": []}
    content["parameters"] = {**short, "delay": {"all": 1.0}}
    result.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"no values for RF_HAA.*separate group"):
        use_identified(load_env_cfg(WALK), result)


# ---- the training environment ----------------------------------------------------------------------------------------


def test_the_policys_gains_stay(result):
    changed(result, drive={"damping": dict.fromkeys(JOINTS, 0.9)})
    env = walking(result)
    (drive,) = env.scene["robot"].actuators.values()
    assert drive.damping[0, 0] == 0.6 and drive.armature[0, 1] == pytest.approx(0.055)
    assert env.physics_dt == DT and env.step_dt == pytest.approx(0.02)
    env.close()
    env = walking(result, gains=True)
    assert next(iter(env.scene["robot"].actuators.values())).damping[0, 0] == 0.9
    env.close()


def test_gains_that_no_file_states_become_the_recordings_unless_the_task_sets_them(result):
    cfg = load_env_cfg(WALK)
    robot, first = cfg.scene.robot, JOINTS[0]
    robot.assumed_gains = dict.fromkeys(JOINTS, (85.0, 0.6))
    (group,) = robot.actuators
    robot.actuators[group].stiffness, robot.actuators[group].damping = {first: 9.0, f"(?!{first}).*": 85.0}, 0.6
    changed(result, drive={"stiffness": dict.fromkeys(JOINTS, 7.0), "damping": dict.fromkeys(JOINTS, 0.3)})
    (doubt,) = [each for each in doubts(cfg, result) if "[W25]" in each]
    assert doubt.startswith("stiffness differs between this task and the recordings: 9 and 7")
    assert f"gains of {len(JOINTS)} joints: the recordings'" in use_identified(cfg, result)[0]
    drive = cfg.scene.robot.actuators[group]
    assert drive.stiffness == {re.escape(j): 9.0 if j == first else 7.0 for j in JOINTS}
    assert set(drive.damping.values()) == {0.3}


def test_the_policy_sees_the_encoder(result):
    """A scale error shows up in the observation too."""
    changed(result, effects=["encoder_scale"], parameters={"encoder_scale.error": dict.fromkeys(JOINTS, 0.05)})
    env = walking(result)
    env.reset()
    robot = env.scene["robot"]
    bias = torch.tensor(list(IdentifiedDrives.load(result).parameters["encoder_bias"].values()))
    from pace_envs import mdp

    expected = 1.05 * robot.data.joint_pos - bias - robot.data.default_joint_pos
    assert torch.allclose(mdp.encoder_pos_rel(env), expected, atol=1e-7)
    env.close()


def test_a_step_that_does_not_fit_is_refused():
    cfg = load_env_cfg(WALK)
    with pytest.raises(ValueError, match=r"0.003 s, expected a whole fraction .* 0.02 s"):
        set_step(cfg, 0.003)
    set_step(cfg, 0.002)
    assert (cfg.sim.dt, cfg.decimation) == (0.002, 10)


# ---- error bars ------------------------------------------------------------------------------------------------------


def test_draws_have_the_spread_and_the_correlation_of_the_fit(result):
    joints = ("LF_HAA", "LF_HFE")
    labels = [f"viscous_friction/{joints[0]}", f"viscous_friction/{joints[1]}"]
    std = {"viscous_friction": {joints[0]: 0.02, joints[1]: 0.04}, "armature": {joints[0]: None}}
    content = json.loads(result.read_text())
    content |= {"std": std, "correlation": {"labels": labels, "matrix": [[1.0, -0.9], [-0.9, 1.0]]}}
    result.write_text(json.dumps(content))
    drives = IdentifiedDrives.load(result)
    assert labels_with_std(drives) == [("viscous_friction", joint) for joint in joints]
    uniform = torch.rand(20_000, 2, generator=torch.Generator().manual_seed(0))
    drawn = draw(drives, uniform, scale=2.0)["viscous_friction"]
    a, b = drawn[joints[0]], drawn[joints[1]]
    assert a.mean() == pytest.approx(0.4, abs=2e-3) and a.std() == pytest.approx(0.04, rel=0.03)
    assert b.std() == pytest.approx(0.08, rel=0.03)
    assert torch.corrcoef(torch.stack([a, b]))[0, 1] == pytest.approx(-0.9, abs=0.02)
    assert (a - 0.4).abs().max() <= 3 * 0.04 + 1e-9


def test_draws_stay_physical(result):
    wide = {name: dict.fromkeys(values, 50.0) for name, values in json.loads(result.read_text())["std"].items()}
    drives = IdentifiedDrives.load(changed(result, std=wide))
    drawn = draw(drives, torch.rand(200, len(labels_with_std(drives)), generator=torch.Generator().manual_seed(0)))
    for name in ("armature", "friction", "viscous_friction", "delay"):
        assert all((values >= 0).all() for values in drawn[name].values()), name
    gain = torch.stack(list(drawn["torque_gain.gain"].values()))
    assert gain.min() == 0.1 and gain.max() == 10.0


def test_every_environment_gets_drives_of_its_own(result):
    small = {name: dict.fromkeys(v, 1e-3) for name, v in json.loads(result.read_text())["parameters"].items()}
    env = walking(changed(result, std=small), num_envs=64, randomize_std=1.0)
    drives, robot = IdentifiedDrives.load(result), env.scene["robot"]
    (drive,) = robot.actuators.values()
    columns = robot.dof_columns
    written = {
        "armature": env.sim.expand("dof_armature")[:, columns],
        "encoder_bias": drive.encoder_bias,
        "torque_gain.gain": drive.effects.find("torque_gain").gain,
        "drive_bandwidth.time_constant": drive.effects.find("drive_bandwidth").time_constant,
    }
    for name, values in written.items():
        centre = torch.tensor(list(drives.parameters[name].values()), dtype=torch.float64)
        assert (values - centre).abs().max() <= 3.01e-3, name
        assert (values.std(dim=0) > 5e-4).all(), name
    assert drive.time_lags.std() > 5e-4 and (drive.time_lags - 3.4).abs().max() <= 3.01e-3
    env.close()


# ---- training, and the recording in the training environment ---------------------------------------------------------


def test_a_training_keeps_its_drives(result, tmp_path, no_export):
    settings = RunSettings(
        task=WALK, num_envs=4, max_iterations=1, identified=str(result), randomize_identified=1.0, log_dir=str(tmp_path)
    )
    run = train(settings)
    result.unlink()  # the run has its own copy
    read = RunSettings.read(run)
    assert read.identified == str(run / "identified.json") and read.randomize_identified == 1.0
    cfg = load_cfg(read)
    assert cfg.scene.robot.actuators["legs"].delay_s == pytest.approx(3.4 * DT) and cfg.sim.dt == DT
    played = run_script("play", "--checkpoint", run, "--num_envs", "2", "--seconds", "0.1", cwd=ROOT)
    assert played.returncode == 0 and "identified drives: drives 2.5 ms, physics 2.5 ms, as in the fit" in played.stdout


def test_a_finer_step_keeps_the_controllers_rate_with_effects_too(result):
    fine = load_cfg(RunSettings(task=WALK, identified=str(result), physics_dt=0.0005))
    drive = fine.scene.robot.actuators["legs"]
    assert (fine.sim.dt, fine.decimation, drive.control_decimation) == (pytest.approx(0.0005), 40, 5)
    assert fine.sim.integrator == "leapfrog"
    values = {"stiffness": 800.0, "damping": 0.5, "encoder_side": 0.0}
    parameters = {f"joint_elasticity.{name}": dict.fromkeys(JOINTS, value) for name, value in values.items()}
    changed(result, effects=["joint_elasticity"], parameters=parameters)
    stiff = load_cfg(RunSettings(task=WALK, identified=str(result), physics_dt=0.0005))
    assert (stiff.sim.integrator, stiff.scene.robot.actuators["legs"].control_decimation) == ("leapfrog", 5)
    coarse = load_cfg(RunSettings(task=WALK, identified=str(result), physics_dt=0.005))
    assert (coarse.sim.dt, coarse.decimation) == (0.005, 4)


def test_the_task_to_train_in_is_of_that_robot_and_of_no_other_with_a_longer_name(result, monkeypatch):
    content = json.loads(result.read_text())
    result.write_text(json.dumps(content | {"task": "Pace-Go2-v0"}))
    own = registered_tasks()
    monkeypatch.setattr(commands_train, "registered_tasks", lambda: ["Pace-Go2-Heavy-Velocity-v0", *own])
    assert _task_for(str(result)) == "Pace-Go2-Velocity-v0"


def test_the_task_to_train_in_is_that_of_the_fit_s_robot_or_what_there_is_is_told(result):
    assert _task_for(str(result)) == WALK
    content = json.loads(result.read_text())
    result.write_text(json.dumps(content | {"task": "Pace-SO101-v0"}))
    assert _task_for(str(result)) == "Pace-SO101-Reach-v0"
    result.write_text(json.dumps(content | {"task": "/tmp/head.xml"}))
    with pytest.raises(ValueError, match=r"fit of /tmp/head\.xml, which has no task to train in.*Pace-Go2-Velocity-v0"):
        _task_for(str(result))
    with pytest.raises(ValueError, match="--task is missing"):
        _task_for(None)


def test_error_bars_without_a_result_are_refused():
    with pytest.raises(ValueError, match="--identified"):
        load_cfg(RunSettings(task=WALK, randomize_identified=1.0))
    with pytest.raises(ValueError, match="randomize_identified is -1, expected a finite number >= 0"):
        load_cfg(RunSettings(task=WALK, identified="any", randomize_identified=-1.0))


@pytest.fixture(scope="module")
def anymal_run(tmp_path_factory):
    """A fit of a noisy recording with a hidden effect: its error is that of the noise and of what is missing."""
    folder = tmp_path_factory.mktemp("anymal")
    words = ["--task", "Pace-AnymalD-v0", "--duration", "1.5", "--noise", "0.0005", "--output", str(folder / "r.npz")]
    assert run_script("data_collection", *words, cwd=ROOT).returncode == 0
    settings = FitSettings(
        task="Pace-AnymalD-v0", data=[str(folder / "r.npz")], optimizer="least_squares", log_dir=str(folder)
    )
    return fit(settings)[1]


def largest_change(found):
    """Relative change of the error of all joints, the larger of training and validation data."""
    return max(abs(found.replayed[part]["all"] / found.fitted[part]["all"] - 1) for part in ("train", "validation"))


@pytest.mark.slow
def test_the_replay_in_training_has_the_error_of_the_fit(anymal_run):
    cfg = load_cfg(RunSettings(task=WALK, identified=str(anymal_run)))
    found = replay_in_training(anymal_run, cfg)
    assert found.fitted["train"]["all"] == pytest.approx(5e-4, rel=0.1)
    drive = IdentifiedDrives.load(anymal_run).drive
    assert {name: set(values.values()) for name, values in drive.items()} == {k: {v} for k, v in GAINS.items()}
    assert largest_change(found) < 0.01
    for part in ("train", "validation"):
        for joint in (*JOINTS, "all"):
            assert found.replayed[part][joint] == pytest.approx(found.fitted[part][joint], rel=0.01), joint


@pytest.mark.slow
def test_the_replay_shows_what_another_step_or_drive_costs(anymal_run):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cfg = load_cfg(RunSettings(task=WALK, identified=str(anymal_run), physics_dt=0.005))
        assert largest_change(replay_in_training(anymal_run, cfg)) > 0.5


@pytest.mark.slow
def test_the_command_line_replays(anymal_run):
    done = run_script("play", "--replay", anymal_run, "--task", WALK, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()[2:-2]] == list(JOINTS)


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 3])
def test_a_replay_where_it_was_fitted_has_its_error_whatever_rate_and_step(every, tmp_path):
    """A log slower than the control step has samples at some steps only, and the fit's finer step is the replay's."""
    whole = record(CHIRP, noise=1e-4)
    rows = slice(None, None, every)
    changes = {name: getattr(whole, name)[rows] for name in ("time", "dof_pos", "des_dof_pos")}
    path = save_recording(tmp_path / "slow.npz", dataclasses.replace(whole, **changes))
    settings = FitSettings(
        task=BENCH,
        data=[str(path)],
        optimizer="least_squares",
        check_consistency=False,
        physics_dt=0.00125,
        log_dir=str(tmp_path),
    )
    run = fit(settings)[1]
    assert largest_change(replay_in_training(run)) < 1e-3
    assert largest_change(replay_in_training(run, standing_in_the_ground(tmp_path))) < 1e-3


def standing_in_the_ground(folder):
    """The test bench with an arm that touches the ground, in which it hangs."""
    cfg = load_env_cfg(BENCH)
    set_physics_dt(cfg, 0.00125)
    model = Path(cfg.scene.robot.mjcf_path).read_text().replace('contype="0" conaffinity="0"', "")
    model = model.replace('name="stand" pos="0 0 0.35"', 'name="stand" pos="0 0 0"')
    (folder / "bench.xml").write_text(model)
    cfg.scene.robot.mjcf_path = str(folder / "bench.xml")
    cfg.scene.terrain, cfg.sim.contacts = TerrainCfg(collision_geoms="arm"), True
    return cfg


def test_gains_that_differ_between_recordings_are_not_the_drives():
    made = [record(CHIRP, drive={"stiffness": kp}, name=str(kp)) for kp in (60.0, 85.0)]
    found = drive_in_force(make_problem(made))
    assert "stiffness" not in found and found["damping"] == {"servo": 0.6}
    assert drive_in_force(make_problem(made[:1]))["stiffness"] == {"servo": 60.0}


# ---- doubts about a result, before a policy is trained with it


def test_a_sound_result_with_the_tasks_gains_raises_no_doubt(result):
    assert doubts(load_env_cfg(WALK), result) == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"times_noise": 55.0}, r"ended at 55 times the measurement noise.*pace diagnose"),
        ({"at_bound": ["friction/LF_HAA"]}, r"friction of LF_HAA ended at a bound.*Widen bounds"),
        ({"undetermined": [f"encoder_bias/{j}" for j in JOINTS]}, r"LF_HAA.*and 8 more was not determined"),
        ({"drive": {"stiffness": {"LF_HAA": 120.0}}}, r"stiffness .*this task and the recordings: 85 and 120 .*LF_HAA"),
        (
            {"drive": {"effort_limit": {"LF_HAA": 900.0, "LF_HFE": 500.0, "LF_KFE": 89.0}}},
            r"recordings: 89 and 900 \(LF_HAA\); 89 and 500 \(LF_HFE\)\. Set",  # an xArm had seven such lines
        ),
        ({"drive": {"effort_limit": {"LF_KFE": 40.0}}}, r"effort_limit .*recordings: 89 and 40 \(LF_KFE\)"),
    ],
)
def test_what_a_result_is_doubted_for_is_told_before_training(result, changes, said, capsys):
    found = doubts(load_env_cfg(WALK), changed(result, **changes))
    assert len(found) == 1 and re.search(said, found[0])
    load_cfg(RunSettings(task=WALK, identified=str(result)))
    assert f"warning: identified drives: {found[0]}" in capsys.readouterr().err


def test_a_training_reads_its_result_once(result, monkeypatch, capsys):
    read, load = [], DriveResult.load.__func__
    monkeypatch.setattr(DriveResult, "load", classmethod(lambda cls, path: read.append(path) or load(cls, path)))
    cfg = load_cfg(RunSettings(task=WALK, identified=str(result), randomize_identified=1.0))
    assert len(read) == 1 and "identified_drives" in cfg.events
    drives = IdentifiedDrives.load(result)
    assert use_identified(cfg, drives) == use_identified(cfg, result)
