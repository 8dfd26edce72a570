"""The independent plant: its integration against closed forms, against our model, and every hidden effect."""

import ast
import json
import runpy
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from places import ROOT
from problems import BENCH, env_cfg

from pace_envs.task_source import use_task
from pace_optim.data_collection.plant import (
    BENCH_LOAD,
    EFFECTS,
    BaseTruth,
    Case,
    PlantCfg,
    Run,
    Truth,
    draw_effect,
    joints_of,
    library_effects,
    make_case,
    motion_change,
    outside_effects,
    plant_robot,
    simulate_motions,
    simulate_runs,
    simulate_truths,
    write_case,
)
from pace_optim.data_collection.plant.dynamics import friction_impulse
from pace_optim.data_collection.plant.suite import make_suite
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.rollout import Rollout
from pace_optim.recording import Drive, Load, conform_recording, load_recording
from pace_optim.recording.dataset import make_dataset
from pace_optim.terminal.cli import run_cli

DT = 0.0025
ROBOT = plant_robot(BENCH)
BASE = BaseTruth(armature=0.1, viscous_friction=3.0, friction=0.4, encoder_bias=0.02, delay=0.0064)
EXACT = PlantCfg(noise=0.0)
FREE = Drive(stiffness=np.zeros(1), damping=np.zeros(1))
INERTIA, GRAVITY = 0.29671875, 7.9644  # of BENCH_LOAD


def chirp(duration=2.0, amplitude=0.6, low=0.5, high=5.0):
    t = np.arange(round(duration / DT)) * DT
    return amplitude * np.sin(2 * np.pi * (low * t + (high - low) / (2 * duration) * t**2))[:, None]


def run_of(command, **changes):
    return Run(name="r", command=command, load=BENCH_LOAD, **changes)


def positions(truth, runs=None, cfg=EXACT, robot=ROBOT):
    return simulate_runs(robot, runs or [run_of(chirp())], truth, cfg)


# --- independence


@pytest.mark.parametrize(
    "path", sorted((ROOT / "pace_optim" / "data_collection" / "plant").rglob("*.py")), ids=lambda p: p.name
)
def test_the_plant_shares_no_code_with_the_model(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "import" in path.name:
            names = [node.value]
        foreign = [name for name in names if name.startswith(("pace_actuators", "torch", "pace_optim.problem.rollout"))]
        foreign = [name for name in foreign if name != "pace_actuators.files"]  # writes files, knows no drive
        assert not foreign, f"{path.name} imports {foreign}"


# --- integration


@pytest.mark.slow
def test_a_free_swing_keeps_its_energy():
    truth = Truth(base=BaseTruth(armature=0.1, viscous_friction=0.0, friction=0.0, delay=0.0))
    q = positions(truth, [run_of(np.full((4000, 1), 1.2), drive=FREE)])[0].dof_pos[:, 0]
    speed = np.gradient(q, DT)
    energy = 0.5 * (INERTIA + 0.1) * speed**2 - GRAVITY * np.cos(q)
    assert np.ptp(energy[5:-5]) < 2e-3 * GRAVITY
    assert q[3000:].max() == pytest.approx(1.2, abs=1e-4), "after ten seconds it still reaches its first height"


def test_a_free_swing_has_the_period_of_the_closed_form():
    truth = Truth(base=BaseTruth(armature=0.1, viscous_friction=0.0, friction=0.0, delay=0.0))
    q = positions(truth, [run_of(np.full((500, 1), 0.02), drive=FREE)])[0].dof_pos[:, 0]
    frequency = np.sqrt(GRAVITY / (INERTIA + 0.1))
    assert q == pytest.approx(0.02 * np.cos(frequency * np.arange(500) * DT), abs=2e-5)


@pytest.mark.slow
def test_viscous_friction_lets_a_speed_die_out_exponentially():
    light = Load(load_mass=2.0, load_length=0.375, arm_mass=0.33)
    truth = Truth(base=BaseTruth(armature=0.1, viscous_friction=3.0, friction=0.0, delay=0.0))
    kick = np.zeros((200, 1))
    kick[:40] = 0.3
    drive = Drive(stiffness=np.array([85.0]), damping=np.zeros(1))
    fine = simulate_runs(ROBOT, [Run(name="r", command=kick, load=light, drive=drive)], truth, EXACT)[0].dof_pos
    finer = simulate_runs(
        ROBOT, [Run(name="r", command=kick, load=light, drive=drive)], truth, PlantCfg(noise=0.0, step=2e-5)
    )[0].dof_pos
    assert np.abs(fine - finer).max() < 2e-6, "smooth torques are integrated to second order"


@pytest.mark.slow
def test_a_link_swings_on_behind_a_motor_that_sticks():
    """Coulomb friction is the motor's; an elastic shaft without damping hands none of it to the link."""
    base = replace(BASE, friction=3.0)
    shaft = {"joint_elasticity": {"k": {"servo": 300.0}, "c": {"servo": 0.0}, "encoder_on_link": {"servo": 1.0}}}
    step = np.where(np.arange(round(2.0 / DT)) < 40, 0.0, 0.3)[:, None]
    late = positions(Truth(base=base, effects=shaft), [run_of(step)])[0].dof_pos[-200:]
    assert late.std() > 1e-3
    assert positions(Truth(base=base), [run_of(step)])[0].dof_pos[-200:].std() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [None, "stribeck_friction", "joint_elasticity", "backlash", "presliding_friction", "creeping_friction"]
)
def test_a_finer_step_changes_the_motion_by_less_than_the_noise(name):
    effects = {} if name is None else {name: draw_effect(name, ROBOT, np.random.default_rng(1))}
    truth = Truth(base=BASE, effects=effects)
    runs = [run_of(chirp(0.5))]
    usual, fine = (positions(truth, runs, PlantCfg(noise=0.0, step=step)) for step in (PlantCfg().step, 5e-5))
    assert motion_change(usual, fine) < (1e-4 if name == "backlash" else 3e-5)


def test_a_stuck_joint_does_not_creep():
    command = np.concatenate([np.zeros(10), np.full(390, 0.9 * 0.4 / 85.0)])[:, None]  # torque below friction
    q = positions(Truth(base=replace(BASE, encoder_bias=0.0)), [run_of(command)])[0].dof_pos
    assert np.all(q == 0.0)


@pytest.mark.slow
def test_sliding_stops_where_the_torque_fits_between_the_bounds():
    q = positions(Truth(base=replace(BASE, encoder_bias=0.0)), [run_of(np.full((1200, 1), 0.5))])[0].dof_pos[:, 0]
    assert np.ptp(q[-200:]) == 0.0
    holding = 85.0 * (0.5 - q[-1]) - GRAVITY * np.sin(q[-1])
    assert abs(holding) <= 0.4 + 1e-6


def test_coupled_joints_obey_the_friction_law_exactly():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 2, 3, 3))
    A = root @ root.transpose(0, 1, 3, 2) + 0.5 * np.eye(3)
    blocks = np.array([[0, 2, 4], [1, 3, 5]])
    free, bound = rng.normal(size=(6, 6)), np.abs(rng.normal(size=(6, 6))) * 0.4
    v, impulse = friction_impulse(free, A, -bound, bound, blocks, np.zeros((6, 6)))
    stuck = np.abs(v) < 1e-7
    assert stuck.any() and not stuck.all()
    assert np.all(np.abs(impulse) <= bound + 1e-12)
    assert impulse[~stuck] == pytest.approx(-np.sign(v[~stuck]) * bound[~stuck])
    rebuilt = free[:, blocks] + np.einsum("rkij,rkj->rki", A, impulse[:, blocks])
    assert v[:, blocks] == pytest.approx(rebuilt)


# --- against our model


@pytest.mark.slow
@pytest.mark.parametrize("delay_mode", ["command", "effort"])
def test_without_effects_the_model_converges_to_the_plant(delay_mode):
    truth = Truth(base=BASE, delay_mode=delay_mode)
    no_curve = Drive(velocity_limit=np.array([1e6]))  # the model may hold its torque-speed limit over a control step
    recording = positions(truth, [run_of(chirp(0.5, amplitude=0.4), drive=no_curve)])[0]
    space = ParameterSpace.of(env_cfg().sim2real)
    conformed = conform_recording(recording, joint_order=("servo",), control_dt=DT, accepts_load=True)
    dataset = make_dataset([conformed], train_fraction=1)
    values = {name: getattr(BASE, name) for name in ("armature", "viscous_friction", "friction", "encoder_bias")}
    x = space.from_dict({**values, "delay": BASE.delay / DT})
    simulated = {
        ratio: _replay(dataset, space, x, ratio, delay_mode) - 0.02 for ratio in (8, 16)
    }  # of first order at worst
    limit = 2 * simulated[16] - simulated[8]
    assert np.sqrt(np.mean((limit - recording.dof_pos[:, 0]) ** 2)) < 2e-5, "a fifth of the usual noise"


def _replay(dataset, space, x, ratio, delay_mode):
    from pace_envs import ManagerBasedRLEnv
    from pace_envs.registration import set_physics_dt

    cfg = env_cfg()
    cfg.scene.num_envs = 1
    for actuator in cfg.scene.robot.actuators.values():
        actuator.delay_mode = delay_mode
    set_physics_dt(cfg, DT / ratio)
    rollout = Rollout(ManagerBasedRLEnv(cfg), dataset, space)
    rollout.start(x[None], dataset.sampled)
    result = np.array([float(q[0, 0]) for q, _ in rollout.at_once()])
    rollout.env.close()
    return result


# --- effects


CHIRP = [run_of(chirp(1.0, amplitude=0.8), session_start=30.0)]
COARSE = PlantCfg(noise=0.0, step=5e-4)
COARSE_STEP = ("--physics_dt", "0.0005")
COARSE_CASES = partial(PlantCfg, step=5e-4)
"""Of cases whose motions are compared with each other, or with a band of frequencies."""


@pytest.fixture(scope="module")
def plain():
    """Without effects."""
    return positions(Truth(base=BASE), CHIRP, COARSE)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_changes_the_motion_and_its_null_does_not(name, plain):
    drawn = draw_effect(name, ROBOT, np.random.default_rng(0))
    assert motion_change(positions(Truth(base=BASE, effects={name: drawn}), CHIRP, COARSE), plain) > 3e-5
    nothing = {parameter: {} for parameter in EFFECTS[name].draws}
    assert motion_change(positions(Truth(base=BASE, effects={name: nothing}), CHIRP, COARSE), plain) < 1e-9


def test_the_library_has_every_effect_of_the_list_and_outside_it_there_are_at_least_four():
    assert len(library_effects()) >= 30 and len(outside_effects()) >= 4
    assert not set(library_effects()) & set(outside_effects())


def test_a_late_log_is_the_same_motion_shifted():
    late = Truth(base=BASE, effects={"measurement_delay": {"delay": 2 * DT}})
    shown, meant = (positions(truth, [run_of(chirp(0.5))])[0].dof_pos for truth in (late, Truth(base=BASE)))
    assert shown[2:] == pytest.approx(meant[:-2], abs=1e-12)


def test_torque_gain_and_an_effort_free_payload_are_twins_only_at_one_load():
    """A gain of 1/(1+m) and a link (1+m) times as heavy differ once a known mass is added."""
    scale = {key: getattr(BASE, key) * 1.25 for key in ("armature", "viscous_friction", "friction")}
    heavy = Truth(base=replace(BASE, **scale), effects={"payload": {"m": 0.25}})
    weak = Truth(base=BASE, effects={"torque_gain": {"gain": 0.8}})
    runs = [
        run_of(chirp(1.0, amplitude=0.2)),
        replace(run_of(chirp(1.0, amplitude=0.2)), load=replace(BENCH_LOAD, added_mass={"load": 0.8})),
    ]
    a, b = positions(heavy, runs), positions(weak, runs)
    assert motion_change(a[:1], b[:1]) < 1e-6 < 1e-3 < motion_change(a[1:], b[1:])


def test_the_four_quadrant_limit_holds_at_every_instant():
    motion = simulate_motions(ROBOT, [run_of(chirp(1.0, amplitude=0.8, high=9.0))], [Truth(base=BASE)], EXACT)[0][0]
    assert np.abs(motion.torque).max() <= 89.0


def test_a_request_is_limited_before_the_torque_constant_makes_torque_of_it():
    weak = Truth(base=BASE, effects={"torque_gain": {"gain": 0.5}})
    limited = run_of(chirp(1.0, amplitude=0.8), drive=Drive(effort_limit=np.array([20.0])))
    motion = simulate_motions(ROBOT, [limited], [weak], EXACT)[0][0]
    assert np.abs(motion.torque).max() == pytest.approx(10.0)


def test_truths_side_by_side_are_the_truths_alone():
    one = Truth(base=BASE, effects={"torque_offset": {"tau_0": 1.0}})
    other = Truth(base=replace(BASE, friction=0.1), effects={"torque_offset": {"tau_0": -0.5}})
    runs, cfg = [run_of(chirp(0.5)), run_of(chirp(0.5, amplitude=0.2))], PlantCfg(seed=3)
    together = simulate_truths(ROBOT, runs, [one, other], cfg)
    for truth, recordings in zip((one, other), together, strict=True):
        for alone, recording in zip(simulate_runs(ROBOT, runs, truth, cfg), recordings, strict=True):
            assert np.array_equal(alone.dof_pos, recording.dof_pos)


@pytest.mark.slow
def test_noise_and_lattice_are_those_asked_for():
    truth, still = Truth(base=replace(BASE, encoder_bias=0.0)), run_of(np.zeros((4000, 1)))
    assert positions(truth, [still], replace(COARSE, noise=1e-4))[0].dof_pos.std() == pytest.approx(1e-4, rel=0.05)
    coarse = positions(truth, [run_of(chirp(0.5))], PlantCfg(counts_per_turn=4096))[0].dof_pos * 4096 / (2 * np.pi)
    assert np.abs(coarse - np.round(coarse)).max() < 1e-9


@pytest.mark.slow
def test_legs_are_simulated_with_effects_on_chosen_joints():
    robot = plant_robot("Pace-AnymalD-v0")
    knees = joints_of(robot, ".*KFE")
    command = (chirp(0.5, amplitude=0.2) + np.array(robot.pace.excitation.bias)) * np.array(robot.pace.excitation.scale)
    base = BaseTruth(armature=0.1, viscous_friction=4.5, friction=0.2, delay=0.005)
    runs = [Run(name="r", command=command)]
    plain = simulate_runs(robot, runs, Truth(base=base), EXACT)
    effects = {"joint_elasticity": draw_effect("joint_elasticity", robot, np.random.default_rng(0), knees)}
    made = simulate_runs(robot, runs, Truth(base=base, effects=effects), EXACT)
    assert motion_change(made, plain, knees) > 1e-4
    loose = {"mount_compliance": draw_effect("mount_compliance", robot, np.random.default_rng(0))}
    assert motion_change(simulate_runs(robot, runs, Truth(base=base, effects=loose), EXACT), plain) > 1e-4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"effects": {"stribek_friction": {}}}, "Did you mean 'stribeck_friction'"),
        ({"effects": {"torque_gain": {"g": 0.1}}}, "expected gain"),
        ({"effects": {"torque_gain": {"gain": {"knee": 0.1}}}}, "which is no joint. Available: servo"),
    ],
)
def test_what_the_plant_cannot_do_is_said(changes, message):
    with pytest.raises(ValueError, match=message):
        positions(Truth(base=BASE, **changes))


# --- cases and the command line


@pytest.mark.slow
def test_a_case_is_written_with_its_facts_and_always_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr("pace_optim.data_collection.plant.case.make_suite", partial(make_suite, duration=2.0))
    monkeypatch.setattr("pace_optim.data_collection.plant.case.PlantCfg", COARSE_CASES)
    case = Case(effects=("torque_ripple",), seed=5)
    files, again = write_case(case, tmp_path / "a"), write_case(case, tmp_path / "b")
    assert len(files.train) == 8 and len(files.validation) == 2
    recordings = [load_recording(path) for path in files.train]
    for recording, path in zip(recordings, again.train, strict=True):
        assert np.array_equal(recording.dof_pos, load_recording(path).dof_pos)
    assert [r.drive.stiffness[0] for r in recordings] == [85.0] * 6 + [127.5, 85.0]
    assert recordings[7].load.added_mass == {"load": 0.8} and recordings[0].load.load_mass == 2.0
    truth = json.loads(files.truth.read_text())
    assert list(truth["effects"]) == ["torque_ripple"] and truth["size"] >= 3e-4


@pytest.mark.slow
def test_the_parts_of_a_case_with_a_background_make_up_the_whole(monkeypatch):
    monkeypatch.setattr("pace_optim.data_collection.plant.case.make_suite", partial(make_suite, duration=2.0))
    monkeypatch.setattr("pace_optim.data_collection.plant.case.PlantCfg", COARSE_CASES)
    case = Case(effects=("torque_gain",), background=0.5, kind="chirp")
    (_, both), (_, main), (_, rest) = (
        make_case(replace(case, part=part)) for part in ("both", "effects", "background")
    )
    assert set(main.truth.effects) == {"torque_gain"} and len(rest.truth.effects) >= 15
    assert {**main.truth.effects, **rest.truth.effects} == both.truth.effects
    assert both.truth.base == main.truth.base == rest.truth.base
    alone, beside = motion_change(both.recordings, rest.recordings), motion_change(both.recordings, main.recordings)
    assert alone == pytest.approx(both.size, rel=0.5) and beside == pytest.approx(0.5 * both.size, rel=0.5)
    assert len({replace(case, part=part).name for part in ("both", "effects", "background")}) == 3
    with pytest.raises(ValueError, match="no background"):
        make_case(replace(case, part="effects", background=0.0))


@pytest.mark.slow
def test_the_harmonic_drive_resonates_above_0_db_within_4_to_8_hz(monkeypatch):
    monkeypatch.setattr("pace_optim.data_collection.plant.case.PlantCfg", COARSE_CASES)
    suite, drawn = make_case(Case(harmonic_drive=True, seed=1))
    small = drawn.recordings[0]
    frequency = 0.1 + 9.9 * small.time / 10.0
    band = (frequency > 4.0) & (frequency < 6.0)
    assert suite.train[0].name == "chirp_small"
    assert small.dof_pos[band].std() > 1.4 * small.des_dof_pos[band].std()
    assert [float(r.drive.stiffness[0]) for r in drawn.recordings[5:7]] == [300.0, 450.0]


def collect(*args):
    main = runpy.run_path(str(ROOT / "scripts" / "data_collection.py"))["main"]
    before, sys.argv = sys.argv, ["data_collection", *args]
    try:
        return run_cli(main)
    finally:
        sys.argv = before


@pytest.fixture
def drawn_by_a_second(monkeypatch):
    """An effect's size is drawn on a second of chirp, in place of six."""
    monkeypatch.setattr("pace_optim.data_collection.hidden._REFERENCE", 1.0)


def test_data_collection_hides_an_effect_and_says_so_beside_the_recording(drawn_by_a_second, tmp_path, capsys):
    path = tmp_path / "r.npz"
    options = ("--task", BENCH, "--duration", "2", "--no_plot", "--noise", "1e-4", "--output", str(path), *COARSE_STEP)
    assert collect(*options, "--effect", "torque_offset", "--seed", "4") == 0
    said = capsys.readouterr().out
    assert "hidden: torque_offset: tau_0" in said and f"truth: {tmp_path / 'r.truth.json'}" in said
    truth = json.loads((tmp_path / "r.truth.json").read_text())
    assert set(truth["effects"]) == {"torque_offset"} and truth["base"]["friction"] == {"servo": 0.3}
    with np.load(path) as content:
        assert not any("torque_offset" in str(content[key]) for key in content.files if content[key].dtype.kind == "U")
    assert load_recording(path).dof_vel is None


@pytest.mark.slow
def test_recordings_made_one_by_one_with_the_same_seed_are_of_one_robot(drawn_by_a_second, tmp_path):
    truths = []
    for motion in ("steps", "multisine"):
        options = ("--task", BENCH, "--duration", "2", "--no_plot", "--excitation", motion, "--seed", "3", *COARSE_STEP)
        path = tmp_path / f"{motion}.npz"
        assert collect(*options, "--effect", "stribeck_friction", "--noise", "1e-4", "--output", str(path)) == 0
        truths.append(json.loads((tmp_path / f"{motion}.truth.json").read_text()))
    assert truths[0] == truths[1]


def test_data_collection_with_a_battery_writes_every_recording(drawn_by_a_second, tmp_path):
    options = ("--task", BENCH, "--duration", "0.5", "--no_plot", "--excitation", "battery", *COARSE_STEP)
    assert collect(*options, "--effect", "torque_gain", "--output", str(tmp_path / "b.npz")) == 0
    assert len(list(tmp_path.glob("b_*.npz"))) == 6 and (tmp_path / "b.truth.json").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--effect", "stribek"), "Available: backlash"),
        (("--effect", "torque_gain", "--effect_joints", "knee"), "matches no joint. Available: servo"),
        (("--effect", "torque_gain", "--command_only"), "--effect has no use"),
        (("--effect_joints", "servo"), "Add --effect NAME"),
        (("--effect", "torque_gain", "torque_gain"), "twice"),
    ],
)
def test_data_collection_says_what_is_wrong_with_a_request(options, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert collect("--task", BENCH, "--duration", "1", "--no_plot", *options) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.npz"))


def test_a_plant_reads_a_model_whose_keyframes_move_actuators(tmp_path):
    path = tmp_path / "swing.xml"
    path.write_text(
        "<mujoco><worldbody><body><joint name='hinge' axis='0 1 0' range='-1 1'/><inertial pos='0 0 -0.1' mass='1' "
        "diaginertia='0.01 0.01 0.01'/></body></worldbody><actuator><position name='a' joint='hinge' kp='8' "
        "forcerange='-5 5'/></actuator><keyframe><key name='home' qpos='0.1' ctrl='0.1'/></keyframe></mujoco>"
    )
    robot = plant_robot(use_task(str(path)))
    assert robot.spec().compile().nu == 0
