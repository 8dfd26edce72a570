"""Data collection: recordings that replay exactly, encoders as asked for, and a command line that does not lie."""

import csv
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from command_lines import run_script
from places import ROOT

import pace_envs
from pace_envs.tasks.pace import go2
from pace_optim.commands import data_collection
from pace_optim.data_collection import Collection, Encoder, true_parameters
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import load_problem
from pace_optim.problem.rollout import Rollout
from pace_optim.recording import conform_recording, load_recording
from pace_optim.recording.dataset import make_dataset
from pace_optim.terminal.cli import run_cli

BENCH = ("--task", "Pace-TestBench-v0")
SHORT = ("--duration", "0.6", "--no_plot")
EXACT = 1e-12  # [rad²]


def script(name: str, *args: str) -> int:
    """Run a script in this process; what it prints is captured as if the test had."""
    done = run_script(name, *args)
    print(done.stdout, end="")
    print(done.stderr, end="", file=sys.stderr)
    return done.returncode


def record(folder: Path, *args: str, name: str = "r.npz"):
    assert script("data_collection", *args, "--output", str(folder / name), "--overwrite") == 0
    return load_recording(folder / name)


def replay_score(recording, task: str, *, parameters=None, physics_dt=None, delay_mode=None) -> float:
    """Σ over joints of the squared error, averaged over time [rad²], with the true parameters."""
    env = gym.make(task, num_envs=1, physics_dt=physics_dt, delay_mode=delay_mode).unwrapped
    cfg = env.cfg.sim2real
    space = ParameterSpace.of(cfg)
    truth = true_parameters(cfg, space, parameters or {})
    conformed = conform_recording(
        recording,
        joint_order=cfg.joint_order,
        control_dt=env.step_dt,
        load_bodies=env.scene["robot"].body_names,
        accepts_load=cfg.apply_load is not None,
    )
    rollout = Rollout(env, make_dataset([conformed], train_fraction=1), space)
    rollout.start(truth[None])
    score = torch.zeros(1, len(cfg.joint_order), dtype=torch.float64)
    for sim_dof_pos, real_dof_pos in rollout.at_once():
        score += rollout.weight * (sim_dof_pos - truth[space["encoder_bias"]] - real_dof_pos) ** 2
    env.close()
    return float(score.sum())


# --- replay


@pytest.mark.slow
@pytest.mark.parametrize("task", ["Pace-AnymalD-v0", "Pace-Go2-v0", "Pace-SO101-v0", "Pace-TestBench-v0"])
def test_the_sample_recording_replays_exactly_with_the_true_parameters(task):
    cfg = pace_envs.load_env_cfg(task).sim2real
    recording = load_recording(cfg.data_dir)
    assert recording.joint_names == tuple(cfg.joint_order)
    assert recording.num_samples == 8000 and recording.duration == pytest.approx(19.9975)
    assert np.array_equal(recording.dof_pos[0], recording.des_dof_pos[0])
    assert Path(cfg.data_dir).stat().st_size < 1.2e6
    assert replay_score(recording, task) <= EXACT


def test_the_sample_recording_of_anymal_is_the_reference_case():
    cfg = pace_envs.load_env_cfg("Pace-AnymalD-v0").sim2real
    truth = true_parameters(cfg, ParameterSpace.of(cfg), {})
    assert truth.tolist() == [0.1] * 12 + [4.5] * 12 + [0.05] * 12 + [0.05] * 12 + [5.0]
    drive = load_recording(cfg.data_dir).drive
    facts = (drive.stiffness, drive.damping, drive.saturation_effort, drive.effort_limit, drive.velocity_limit)
    for values, expected in zip(facts, (85.0, 0.6, 140.0, 89.0, 8.5), strict=True):
        assert np.array_equal(values, np.full(12, expected))


@pytest.mark.slow
@pytest.mark.parametrize("delay_mode", ["command", "effort"])
@pytest.mark.parametrize("delay", [0.0, 2.4])
@pytest.mark.parametrize("task", ["Pace-Go2-v0", "Pace-SO101-v0", "Pace-TestBench-v0"])
def test_recordings_replay_exactly_in_both_delay_modes(task, delay, delay_mode, tmp_path):
    options = ("--task", task, *SHORT, "--delay_mode", delay_mode, "--parameter", f"delay={delay}")
    recording = record(tmp_path, *options)
    truth = {"delay": delay}
    assert replay_score(recording, task, parameters=truth, delay_mode=delay_mode) <= EXACT
    if delay:
        other = {"command": "effort", "effort": "command"}[delay_mode]
        assert replay_score(recording, task, parameters=truth, delay_mode=other) > 1e-7


@pytest.mark.parametrize("suffix", [".npz", ".pt", ".csv"])
def test_the_joints_of_a_file_may_stand_in_another_order(suffix, tmp_path):
    task = "Pace-AnymalD-v0"
    recording = record(tmp_path, "--task", task, *SHORT, "--parameter", "friction/LF_KFE=0.4", name=f"r{suffix}")
    order = np.random.default_rng(0).permutation(12)
    names = tuple(recording.joint_names[i] for i in order)
    shuffled = {key: getattr(recording, key)[:, order] for key in ("dof_pos", "des_dof_pos", "dof_vel")}
    shuffled_recording = replace(recording, joint_names=names, **shuffled)
    assert replay_score(shuffled_recording, task, parameters={"friction/LF_KFE": 0.4}) <= EXACT
    assert replay_score(shuffled_recording, task) > 1e-7, "the true friction of one joint was changed"


@pytest.mark.slow
def test_gains_loads_and_physics_step_are_facts_of_the_replay(tmp_path):
    options = ("--stiffness", "60", "--damping", "1.5", "--load_mass", "2", "--load_length", "0.3", "--arm_mass", "0.4")
    recording = record(tmp_path, *BENCH, *SHORT, *options, "--physics_dt", "0.0005")
    assert recording.drive.stiffness == 60 and recording.drive.damping == 1.5
    load = recording.load
    assert (load.load_mass, load.load_length, load.arm_mass) == (2.0, 0.3, 0.4)
    assert replay_score(recording, "Pace-TestBench-v0", physics_dt=0.0005) <= EXACT
    assert replay_score(recording, "Pace-TestBench-v0") > 1e-10


def test_a_mass_on_a_body_is_a_fact_of_the_replay(tmp_path):
    recording = record(tmp_path, "--task", "Pace-AnymalD-v0", *SHORT, "--added_mass", "LF_THIGH=0.8")
    assert recording.load.added_mass == {"LF_THIGH": 0.8}
    assert replay_score(recording, "Pace-AnymalD-v0") <= EXACT


def test_the_robot_starts_at_rest_with_its_encoder_at_the_first_target(tmp_path):
    recording = record(tmp_path, "--task", "Pace-Go2-v0", *SHORT)
    assert np.array_equal(recording.dof_pos[0], recording.des_dof_pos[0])
    assert np.all(recording.dof_vel[0] == 0.0)
    assert np.abs(np.gradient(recording.dof_pos, recording.time, axis=0) - recording.dof_vel)[5:].max() < 0.5


# --- the encoder


def test_noise_has_the_level_asked_for():
    encoder = Encoder(noise=1e-3, bits=None, rng=np.random.default_rng(0))
    error = encoder.read(np.zeros((20000, 3)))
    assert error.std(axis=0) == pytest.approx(1e-3, rel=0.02) and np.abs(error.mean(axis=0)).max() < 3e-5


def test_a_slides_encoder_has_a_tenth_of_the_noise():
    encoder = Encoder(noise=1e-3, bits=None, rng=np.random.default_rng(0), radians=(1.0, 0.1))
    assert encoder.read(np.zeros((20000, 2))).std(axis=0) == pytest.approx([1e-3, 1e-4], rel=0.02)


def test_a_slides_encoder_has_steps_of_a_tenth():
    encoder = Encoder(noise=0.0, bits=12, rng=np.random.default_rng(0), radians=(1.0, 0.1))
    read = encoder.read(np.random.default_rng(1).random((4000, 2)))
    step = [float(np.diff(np.unique(column)).min()) for column in read.T]
    assert step == pytest.approx([2 * np.pi / 4096, 0.2 * np.pi / 4096])


@pytest.mark.slow
def test_a_recording_is_as_noisy_as_asked_for(tmp_path):
    options = (*BENCH, "--duration", "2", "--no_plot")
    exact, noisy = record(tmp_path, *options), record(tmp_path, *options, "--noise", "1e-3")
    error = noisy.dof_pos - exact.dof_pos
    assert np.diff(error, axis=0).std() / np.sqrt(2) == pytest.approx(1e-3, rel=0.05)
    assert error.std() == pytest.approx(1e-3, rel=0.1)
    again = record(tmp_path, *options, "--noise", "1e-3")
    other = record(tmp_path, *options, "--noise", "1e-3", "--seed", "1")
    assert np.array_equal(noisy.dof_pos, again.dof_pos) and not np.array_equal(noisy.dof_pos, other.dof_pos)


def test_the_loop_sees_the_noise(tmp_path):
    exact = record(tmp_path, *BENCH, *SHORT)
    noisy = record(tmp_path, *BENCH, *SHORT, "--noise", "1e-2")
    assert np.abs(noisy.dof_vel - exact.dof_vel).max() > 1e-3


def test_positions_lie_on_the_encoder_lattice(tmp_path):
    recording = record(tmp_path, *BENCH, *SHORT, "--encoder_bits", "12")
    counts = recording.dof_pos / (2 * np.pi / 4096)
    assert np.abs(counts - np.round(counts)).max() < 1e-9
    assert len(np.unique(np.round(counts))) > 100
    assert np.abs(recording.dof_pos[0] - recording.des_dof_pos[0]).max() <= np.pi / 4096


# --- files


def test_the_battery_is_written_as_six_recordings(tmp_path, capsys):
    args = (*BENCH, "--excitation", "battery", "--duration", "1", "--output", str(tmp_path / "b.npz"))
    assert script("data_collection", *args, "--no_plot") == 0
    parts = ["chirp_large", "chirp_medium", "chirp_small", "staircase", "steps", "triangle"]
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"b_{part}.npz" for part in parts]
    printed = capsys.readouterr().out.splitlines()
    assert sorted(printed) == [f"recording: {tmp_path / f'b_{part}.npz'}" for part in parts]
    for part in parts:
        recording = load_recording(tmp_path / f"b_{part}.npz")
        assert recording.name == f"b_{part}"
        assert replay_score(recording, "Pace-TestBench-v0") <= EXACT


def test_a_plot_lies_beside_the_recording(tmp_path, capsys):
    record(tmp_path, *BENCH, "--duration", "1")
    assert f"plot: {tmp_path / 'r.png'}" in capsys.readouterr().out.splitlines()
    assert (tmp_path / "r.png").read_bytes().startswith(b"\x89PNG")


def test_files_have_names_of_their_own_without_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert script("data_collection", *BENCH, *SHORT, "--excitation", "steps") == 0
    assert [str(p) for p in Path().rglob("*.*")] == ["data/test_bench/steps.npz"]


def test_positions_only_leaves_speeds_out(tmp_path):
    assert record(tmp_path, *BENCH, *SHORT, "--positions_only").dof_vel is None


def test_commands_alone_are_a_csv_that_becomes_a_recording_with_measured_columns(tmp_path):
    path = tmp_path / "c.csv"
    args = ("--task", "Pace-Go2-v0", *SHORT, "--command_only", "--export_command", str(path))
    assert script("data_collection", *args) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["c.csv"]
    recording = record(tmp_path, "--task", "Pace-Go2-v0", *SHORT)
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    values = np.array(rows, dtype=float)
    assert header == ["time", *(f"des_dof_pos/{joint}" for joint in recording.joint_names)]
    assert np.array_equal(values[:, 1:], recording.des_dof_pos)
    played = tmp_path / "played.csv"  # as a logger on the robot adds what it measures
    with played.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*header, *(f"dof_pos/{joint}" for joint in recording.joint_names)])
        writer.writerows(np.column_stack([values, recording.dof_pos]).tolist())
    assert np.array_equal(load_recording(played).des_dof_pos, recording.des_dof_pos)


@pytest.mark.parametrize(("option", "said"), [("--command_only", "writing the commands"), ("--no_plot", "simulating")])
def test_the_progress_of_commands_alone_says_nothing_of_a_simulation(tmp_path, monkeypatch, option, said):
    shown: list[str] = []
    monkeypatch.setattr(data_collection.ProgressLine, "wait_for", lambda self, text: shown.append(text))
    monkeypatch.setattr(
        data_collection, "collect", lambda cfg, tell: Collection(recordings=(), commands=(), plots=(), warnings=())
    )
    monkeypatch.setattr(sys, "argv", ["data-collection", *BENCH, option])
    data_collection.main()
    assert [text.startswith(said) for text in shown] == [True]


# --- bad input

BAD = [
    ([], "--task"),
    (["--task", "Pace-Anymal-v0"], "Did you mean 'Pace-AnymalD-v0'"),
    (["--task", "no_such_module:Robot-v0"], "no_such_module"),
    ([*BENCH, "--excitation", "chrip"], "Did you mean 'chirp'"),
    ([*BENCH, "--duration", "0"], "The duration is 0 s"),
    ([*BENCH, "--duration", "long"], "not a finite number"),
    ([*BENCH, "--max_frequency", "300"], "200 Hz"),
    ([*BENCH, "--min_frequency", "nan"], "nan"),
    ([*BENCH, "--parameter", "frction=0.1"], "Did you mean 'friction'"),
    (["--task", "Pace-AnymalD-v0", "--parameter", "friction/LF_KEF=0.1"], "Did you mean 'LF_KFE'"),
    ([*BENCH, "--parameter", "friction"], "NAME=VALUE"),
    ([*BENCH, "--parameter", "friction=nan"], "finite number"),
    ([*BENCH, "--parameter", "friction=1", "--parameter", "friction=2"], "given twice"),
    ([*BENCH, "--parameter", "armature=-1"], "armature is -1"),
    ([*BENCH, "--parameter", "delay=11"], "max_delay"),
    ([*BENCH, "--noise", "-1"], "noise is -1"),
    ([*BENCH, "--encoder_bits", "0"], "expected 1 to 32"),
    ([*BENCH, "--stiffness", "-5"], "stiffness is -5"),
    ([*BENCH, "--load_length", "0"], "a length > 0"),
    (["--task", "Pace-Go2-v0", "--load_mass", "1"], "belong to the test bench"),
    (["--task", "Pace-AnymalD-v0", "--added_mass", "LF_THIGHS=1"], "did you mean 'LF_THIGH'"),
    ([*BENCH, "--delay_mode", "efort"], "'effort'"),
    ([*BENCH, "--physics_dt", "0.002"], "whole fraction"),
    ([*BENCH, "--seed", "-1"], "seed is -1"),
    ([*BENCH, "--frequency", "3"], "did you mean --m"),
    ([*BENCH, "--output", "r.txt"], ".npz"),
    ([*BENCH, "--output", "."], "is a folder"),
    ([*BENCH, "--output", "file/r.npz"], "is a file, not a folder"),
    ([*BENCH, "--plot", "p.jpg"], ".png"),
    ([*BENCH, "--export_command", "c.npz"], ".csv"),
    ([*BENCH, "--output", "a.csv", "--export_command", "a.csv"], "Two files"),
    ([*BENCH, "--output", "a.npz", "--command_only"], "--export_command"),
]


@pytest.mark.parametrize(("args", "says"), BAD, ids=[" ".join(args) or "nothing" for args, _ in BAD])
def test_bad_input_is_one_clear_line_and_writes_nothing(args, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    duration = [] if "--duration" in args else ["--duration", "0.5"]
    assert script("data_collection", *args, *duration) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and err.startswith("error: ") and says in err
    assert [p.name for p in tmp_path.rglob("*")] == ["file"]


@pytest.mark.parametrize("only", [(), ("--command_only",)])
def test_targets_beyond_the_joint_limits_are_refused(only, tmp_path, monkeypatch, capsys):
    def too_wide():
        cfg = go2.go2_pace_env_cfg()
        cfg.sim2real.excitation = replace(cfg.sim2real.excitation, scale=(0.25, 0.5, 0.9) * 4)
        return cfg

    pace_envs.register_task("Pace-TooWide-v0", too_wide)
    try:
        monkeypatch.chdir(tmp_path)
        assert script("data_collection", "--task", "Pace-TooWide-v0", *SHORT, *only) == 2
    finally:
        del gym.registry["Pace-TooWide-v0"]
    error = capsys.readouterr().err
    assert "FL_calf_joint: its target is" in error and "limits of -2.723 to -0.838" in error
    assert list(tmp_path.iterdir()) == []


def test_a_drive_that_hangs_at_its_torque_limit_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    args = ("--load_mass", "60", "--load_length", "0.5", *SHORT)
    assert script("data_collection", *BENCH, *args, "--stiffness", "5000") == 2
    assert "The drive hardly follows" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_task_of_ones_own_is_imported_from_the_present_folder(tmp_path, monkeypatch):
    (tmp_path / "my_bench.py").write_text(
        "from pace_envs import register_task\n"
        "from pace_envs.tasks.pace.test_bench import test_bench_pace_env_cfg\n"
        "register_task('Pace-MyBench-v0', test_bench_pace_env_cfg)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    try:
        recording = record(tmp_path, "--task", "my_bench:Pace-MyBench-v0", *SHORT)
    finally:
        gym.registry.pop("Pace-MyBench-v0", None)
    assert replay_score(recording, "Pace-TestBench-v0") <= EXACT


@pytest.mark.slow
def test_warnings_go_to_stderr_and_do_not_stop(tmp_path, capsys):
    record(tmp_path, *BENCH, "--no_plot", "--duration", "5")
    out, err = capsys.readouterr()
    assert out.splitlines() == [f"recording: {tmp_path / 'r.npz'}"]
    assert err.startswith("warning: servo: its target moves at up to") and len(err.splitlines()) == 1


def test_the_shipped_chirps_stay_inside_the_joint_limits():
    for task in pace_envs.registered_tasks():
        cfg = pace_envs.load_env_cfg(task)
        if not hasattr(cfg, "sim2real") or not Path(cfg.sim2real.data_dir).is_file():
            continue
        recording = load_recording(cfg.sim2real.data_dir)
        env = gym.make(task, num_envs=1).unwrapped
        low, high = env.scene["robot"].data.joint_pos_limits.numpy().T
        for series in (recording.des_dof_pos, recording.dof_pos):
            assert np.all(series >= low) and np.all(series <= high), task


# --- the scripts as programs


def test_list_envs_has_one_line_per_task(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert script("list_envs") == 0
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split()[:3] == ["task", "robot", "joints"]
    assert [line.split()[0] for line in lines] == pace_envs.registered_tasks()
    words = next(line for line in lines if line.startswith("Pace-AnymalD-v0")).split()
    assert words[1:] == ["anymal_d", "12", "400/400", "Hz", "assets/anymal_d/chirp.npz"]


@pytest.mark.parametrize("name", ["data_collection", "list_envs"])
def test_help_shows_an_example(name, capsys):
    assert script(name, "--help") == 0
    assert f"example:\n  scripts/{name}.py" in capsys.readouterr().out


@pytest.mark.slow
def test_scripts_run_from_anywhere(warm, tmp_path):
    done = warm.run(ROOT / "scripts" / "data_collection.py", "--task", "Pace-Testbench-v0", cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert (
        done.stderr.startswith("error: There is no environment 'Pace-Testbench-v0'.") and done.stderr.count("\n") == 1
    )


def test_an_interruption_exits_with_130(capsys):
    def interrupted():
        raise KeyboardInterrupt

    assert run_cli(interrupted) == 130 and capsys.readouterr().err == "interrupted\n"


def test_a_missing_key_and_a_file_error_read_as_sentences(capsys):
    def missing():
        raise KeyError("There is no parameter 'x'.")

    def absent():
        open("/no/such/file").close()

    assert run_cli(missing) == run_cli(absent) == 2
    lines = ["error: There is no parameter 'x'.", "error: /no/such/file: No such file or directory"]
    assert capsys.readouterr().err.splitlines() == lines


@pytest.mark.slow
def test_loops_of_a_file_are_simulated_as_a_fit_does(tmp_path):
    (tmp_path / "stiff.xml").write_text(
        '<mujoco model="stiff"><compiler angle="radian"/><worldbody><body>'
        '<joint name="j" axis="0 1 0" range="-2 2"/>'
        '<inertial pos="0 0.02 -0.08" mass="0.5" diaginertia="2e-3 2e-3 1e-3"/></body></worldbody>'
        '<actuator><position joint="j" kp="160" kv="20" forcerange="-60 60"/></actuator></mujoco>'
    )
    task = ("--task", str(tmp_path / "stiff.xml"))
    record(tmp_path, *task, *SHORT, "--parameter", "armature=1e-3")
    problem = load_problem(task[1], data=[tmp_path / "r.npz"])
    assert problem.physics_dt < problem.coarsest_dt
    values = true_parameters(problem.env_cfg.sim2real, problem.space, {"armature": 1e-3})
    assert float(problem.evaluator().residuals(values[None], problem.dataset.sampled).score) < EXACT


# --- drives that follow speeds


@pytest.fixture(scope="module")
def cart(tmp_path_factory):
    """Two wheels, and how they are told to be."""
    inertia = (
        '<inertial><mass value="0.8"/><inertia ixx="2e-3" iyy="3e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    wheels = [
        f'<link name="{name}">{inertia}</link><joint name="{name}" type="continuous"><parent link="base"/>'
        f'<child link="{name}"/><axis xyz="0 1 0"/><limit effort="6" velocity="40"/></joint>'
        for name in ("left", "right")
    ]
    path = tmp_path_factory.mktemp("cart") / "cart.urdf"
    path.write_text(f'<robot name="cart"><link name="base"/>{"".join(wheels)}</robot>')
    truth = {"armature": 0.01, "viscous_friction": 0.01, "friction": 0.1, "encoder_bias": 0, "delay": 1}
    given = (word for name, value in truth.items() for word in ("--parameter", f"{name}={value}"))
    return ("--task", str(path), *given, "--damping", "0.35", *SHORT)


@pytest.mark.slow
def test_a_drive_without_stiffness_is_told_speeds_and_moves(cart, tmp_path):
    """It was told positions, which it does not follow, and a recording of a robot at rest was written."""
    file = tmp_path / "told.csv"
    recording = record(tmp_path, *cart, "--stiffness", "0", "--export_command", str(file))
    assert recording.des_dof_pos is None and (np.ptp(recording.dof_pos, axis=0) > 0.1).all()
    assert next(csv.reader(file.open())) == ["time", "des_dof_vel/left", "des_dof_vel/right"]


def test_joints_that_are_named_are_told_speeds_beside_others_with_positions(cart, tmp_path):
    recording = record(tmp_path, *cart, "--velocity_joints", "l.*")
    assert np.isnan(recording.des_dof_pos).all(axis=0).tolist() == [True, False]
    assert np.isnan(recording.des_dof_vel).all(axis=0).tolist() == [False, True]
    assert (np.ptp(recording.dof_pos, axis=0) > 0.1).all()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["--stiffness", "0", "--damping", "0"], "Nothing would move left, right: stiffness and damping are 0"),
        (["--velocity_joints", "arm"], "'arm' fits no joint. Available: left, right."),
        (["--velocity_joints", "("], "is no regular expression"),
        (["--stiffness", "0", "--excitation", "steps"], "steps jumps from target to target, and left, right follow"),
        (["--stiffness", "0", "--effect", "backlash"], "Omit --effect"),
    ],
)
def test_what_speeds_cannot_tell_is_refused(cart, tmp_path, capsys, given, told):
    assert script("data_collection", *cart, *given, "--output", str(tmp_path / "none.npz")) == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
