"""Effects in fits: the log's clock, single joints beside the whole robot, and what a fit finds and writes."""

import copy
import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from command_lines import run_script
from effect_envs import null_values, rms
from problems import ANYMAL, BENCH, CALM, DT, chirp, env_cfg, legs_chirp, make_problem, record
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import pace_optim.identification.fit as fit_module
from pace_actuators.effects import get_effect
from pace_envs import set_physics_dt
from pace_optim.identification.fit import fit
from pace_optim.identification.optimization import Optimization
from pace_optim.identification.setup import make_optimizer
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.recording import save_recording
from pace_optim.run.folder import RunFolder
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.processes import Processes
from pace_optim.terminal.progress import ProgressLine


def problem_with(effects, recordings=None):
    return make_problem(recordings or record(chirp(0.5), CALM), cfg=env_cfg()).with_effects(effects)


def replay(problem, values):
    """Sensed positions of one candidate at every control step, (T, R, n)."""
    return replays(problem, [values])[:, 0]


def replays(problem, candidates):
    """The same of several candidates side by side, (T, m, R, n)."""
    rollout = problem.evaluator().rollout(len(candidates))
    rollout.start(torch.stack([problem.space.from_dict(each) for each in candidates]), problem.dataset.sampled)
    motion = torch.stack([position.clone() for _, position in rollout.samples()])
    return motion.unflatten(1, (len(candidates), -1))


@pytest.mark.parametrize(
    ("effect", "parameter", "value", "lag"),
    [
        ("measurement_delay", "delay", 0.0033, lambda t: 0.0033 + 0 * t),
        ("measurement_delay", "delay", 2 * DT, lambda t: 2 * DT + 0 * t),
        ("clock_skew", "skew", 0.004, lambda t: -0.004 * t),
        ("clock_skew", "skew", -0.004, lambda t: 0.004 * t),
    ],
)
def test_a_late_log_is_exact_on_a_cubic_motion(effect, parameter, value, lag, monkeypatch):
    problem = problem_with([effect])
    rollout = problem.evaluator().rollout(1)
    rollout.start(problem.space.from_dict({**CALM, f"{effect}.{parameter}": value})[None])

    def position(t):
        return 0.3 - 2 * t + 5 * t**2 - 7 * t**3

    steps = rollout.duration_steps

    def simulated(count):
        yield from (torch.full((1, 1), position(k * DT), dtype=torch.float64) for k in range(count))

    monkeypatch.setattr(rollout, "simulated", simulated)
    got = torch.stack([sample[0, 0] for _, sample in rollout.samples()]).numpy()
    t = np.arange(steps) * DT
    late = t - lag(t)
    inside = late >= DT  # before, the robot stands where the recording begins
    assert len(got) == steps
    assert np.abs(got - position(late))[inside].max() < 1e-12


def test_a_late_log_is_the_replay_read_earlier():
    late = replay(problem_with(["measurement_delay"]), {**CALM, "measurement_delay.delay": 2 * DT})
    assert torch.allclose(late[2:], replay(problem_with([]), CALM)[:-2], atol=1e-12)


@pytest.mark.parametrize(
    ("effect", "values", "twist"),
    [
        ("joint_elasticity", {"stiffness": 150.0, "damping": 1.0}, lambda load: -load / 150),
        ("backlash", {"gap": 0.02, "stiffness": 3e3, "damping": 4.0}, lambda load: -load / 3e3 - 0.01 * np.sign(load)),
    ],
)
@pytest.mark.parametrize("side", [0.0, 1.0])
def test_a_replay_begins_where_the_encoder_was_on_whichever_side(effect, values, twist, side):
    recording = record(chirp(0.5, amplitude=0.0) + 1.0, CALM)
    recording.dof_pos[:] = recording.dof_pos[0]
    problem = problem_with([effect], recording)
    values = {**CALM, **{f"{effect}.{key}": value for key, value in {**values, "encoder_side": side}.items()}}
    physical = problem.space.from_dict(values)
    for each in (problem, twin_problem(problem, reference_path(problem, physical)).with_effects([effect])):
        rollout = each.evaluator().rollout(1)
        rollout.start(physical[None], problem.dataset.sampled)
        seen, link = float(rollout.robot.sensed_joint_pos()), float(rollout.robot.data.joint_pos)
        load = float(rollout.robot.load_effort)
        assert abs(load) > 1.0
        assert seen - CALM["encoder_bias"] == pytest.approx(recording.dof_pos[0, 0], abs=1e-6)
        assert seen - link == pytest.approx(side * twist(load), abs=1e-6)


@pytest.mark.slow
def test_a_fit_finds_which_side_of_an_elastic_shaft_the_encoder_is_on(tmp_path):
    problem = problem_with(["joint_elasticity"], record(chirp(1.2), CALM))
    truth = {"stiffness": 600.0, "damping": 1.0, "encoder_side": 1.0}
    seen = replay(problem, {**CALM, **{f"joint_elasticity.{name}": value for name, value in truth.items()}})
    noise = 1e-4 * np.random.default_rng(0).standard_normal(seen[:, 0].shape)
    recording = record(chirp(1.2), CALM)
    recording = dataclasses.replace(
        recording,
        time=recording.time[: len(seen)],
        des_dof_pos=recording.des_dof_pos[: len(seen)],
        dof_pos=seen[:, 0].numpy() - CALM["encoder_bias"] + noise,
    )
    data = save_recording(tmp_path / "seen.npz", recording)
    options = {"effects": ["joint_elasticity"], "optimizer": "least_squares", "physics_dt": DT}
    result, _ = fit(FitSettings(task=BENCH, data=[str(data)], log_dir=str(tmp_path), **options))
    assert result.parameters["joint_elasticity.encoder_side"] == {"servo": 1.0}
    assert result.parameters["joint_elasticity.stiffness"]["servo"] == pytest.approx(600.0, rel=0.02)


def test_a_resumed_search_has_the_structure_that_it_was_begun_with(tmp_path):
    """It went on with that of the start: the encoder on the other side of the shaft."""
    problem = problem_with(["joint_elasticity"])
    asked = FitSettings(task=BENCH, data=["log.npz"], num_envs=16)
    before, resumed = (Optimization(asked, problem, RunFolder(tmp_path), Silent()) for _ in range(2))
    label, start = "joint_elasticity.encoder_side/servo", before.problem.space.to_physical(before.problem.space.start)
    at = problem.space.labels.index(label)
    other = before.problem.holding({label: 1.0 - float(start[at])})
    before._around = other.space.to_physical(other.space.start)
    before.optimizer = make_optimizer(other, asked, Processes(), before._around)
    before.optimizer.ask()
    before.optimizer._learn(np.arange(float(before.optimizer.population_size))[:, None])
    before._write_checkpoint()
    resumed.restore(RunFolder(tmp_path).read_checkpoint())
    assert float(resumed.optimizer.space.lower[at]) == 1.0 - float(start[at])
    assert torch.equal(resumed.optimizer.best, before.optimizer.best)


TWIN_CASES = {
    "stribeck_friction": {"effort": 1.5, "velocity": 0.5},
    "load_dependent_friction": {"coefficient": 0.2},
    "friction_asymmetry": {"effort": 0.5},
    "quadratic_friction": {"coefficient": 0.5},
    "presliding_friction": {"stiffness": 10.0},
    "creeping_friction": {"velocity": 0.1},
    "soft_friction": {"time_constant": 0.05},
    "integral_gain": {"gain": 200.0, "effort": 5.0},
    "gravity_compensation": {"share": 0.5},
    "command_filter": {"time_constant": 0.02},
    "torque_fade": {"effort": 15.0, "time_constant": 5.0},
    "supply_sag": {"effort": 60.0},
    "friction_drift": {"ratio": -0.7, "time_constant": 1.0},
    "torque_offset": {"effort": 1.0},
    "parallel_spring": {"stiffness": 5.0, "rest": 0.2},
    "torque_gain": {"gain": 1.1},
    "proportional_gain": {"gain": 1.1},
    "derivative_gain": {"gain": 1.5},
    "fast_loop": {"share": 0.7},
    "drive_bandwidth": {"time_constant": 0.005},
    "velocity_filter": {"time_constant": 0.02},
    "torque_limit": {"effort": 10.0},
    "torque_speed_limit": {"velocity": 4.0, "effort": 30.0},
    "command_rate_limit": {"velocity": 2.0},
    "command_acceleration_limit": {"acceleration": 30.0},
    "torque_ripple": {"sine": 1.0, "cosine": 0.0, "periods": 20.0},
    "joint_elasticity": {"stiffness": 300.0, "damping": 0.5, "encoder_side": 0.0},
    "backlash": {"gap": 0.02, "stiffness": 3000.0, "damping": 5.0, "encoder_side": 0.0},
    "encoder_scale": {"error": 0.03},
    "encoder_eccentricity": {"sine": 0.01, "cosine": 0.01},
    "other_delay": {"delay": 0.003},
    "measurement_delay": {"delay": 0.004},
    "payload": {"ratio": 0.2},
    "com_offset": {"angle": 0.1},
    "mount_compliance": {"stiffness": 1000.0, "damping": 3.0, "inertia": 0.5},
}


@pytest.fixture(scope="module")
def bench_and_twin():
    """At physics steps of 0.5 ms, where the integrators' own errors are small."""
    problem = make_problem(record(chirp(0.4, high=8.0), CALM), cfg=env_cfg())
    cfg = copy.deepcopy(problem.plain_cfg)
    set_physics_dt(cfg, 0.0005)
    problem = dataclasses.replace(problem, env_cfg=cfg)
    path = reference_path(problem, problem.space.from_dict(CALM), ("payload", "com_offset"))
    return problem, twin_problem(problem, path)


@pytest.fixture(scope="module")
def without(bench_and_twin):
    """Both without effects, which is where these are at their null, bit for bit."""
    return [replay(problem, CALM) for problem in bench_and_twin]


@pytest.mark.slow
def test_the_twin_of_a_joint_moves_as_the_robot(without):
    assert rms(*without) < 2e-4


@pytest.fixture(scope="module")
def with_each(bench_and_twin):
    """Both with each effect, side by side: those of the others are at their null, where they vanish."""
    nulls = {key: value for name in TWIN_CASES for key, value in null_values(name).items()}
    candidates = [
        {**CALM, **nulls, **{f"{name}.{key}": value for key, value in own.items()}} for name, own in TWIN_CASES.items()
    ]
    each = [replays(problem.with_effects(list(TWIN_CASES)), candidates) for problem in bench_and_twin]
    return {name: [motions[:, i] for motions in each] for i, name in enumerate(TWIN_CASES)}


@pytest.mark.slow
@pytest.mark.parametrize("name", TWIN_CASES)
def test_an_effect_changes_the_twin_as_it_changes_the_robot(name, with_each, without):
    motions = with_each[name]
    changes = [motion - base for motion, base in zip(motions, without, strict=True)]
    assert rms(changes[0]) > 1e-4
    # how the robot's integrator takes a sharp friction is in both of its motions, but where the effect smooths it
    apart = rms(*motions) if get_effect(name).smooths_friction else rms(*changes)
    assert apart < (0.15 if get_effect(name).parts_motor_and_link else 0.06) * rms(changes[0])


class Silent(ProgressLine):
    def say(self, text):
        pass


STRIBECK = {**CALM, "stribeck_friction.effort": 1.2, "stribeck_friction.velocity": 0.3}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A chirp, then a slow swing, of a drive with Stribeck friction."""
    t = np.arange(0, 2.0, DT)[:, None]
    target = np.concatenate([chirp(1.0), chirp(1.0)[-1] * np.cos(math.pi * t)])
    cfg = env_cfg()
    cfg.set_effects(["stribeck_friction"])
    path = tmp_path_factory.mktemp("recorded") / "stribeck.npz"
    save_recording(path, record(target, STRIBECK, cfg=cfg))
    return str(path)


def run_fit(folder, recorded, monkeypatch, **changes):
    monkeypatch.setattr(fit_module, "write_report", lambda folder: None)
    content = {"task": BENCH, "data": [recorded], "num_envs": 16, "log_dir": str(folder), "epsilon": 1e-9}
    return fit(FitSettings(**{**content, "effects": ["stribeck_friction"], **changes}), Silent())


@pytest.mark.slow
def test_a_fit_recovers_an_effect_and_writes_it(recorded, tmp_path, monkeypatch):
    result, folder = run_fit(tmp_path, recorded, monkeypatch, optimizer="least_squares")
    content = json.loads((folder / "result.json").read_text())
    assert content["effects"] == ["stribeck_friction"]
    assert content["parameters"]["stribeck_friction.effort"]["servo"] == pytest.approx(1.2, abs=0.02)
    assert content["parameters"]["stribeck_friction.velocity"]["servo"] == pytest.approx(0.3, abs=0.01)
    assert content["parameters"]["friction"]["servo"] == pytest.approx(CALM["friction"], abs=0.02)
    std = content["std"]["stribeck_friction.effort"]["servo"]
    assert std is None or 0 <= std < 0.1  # none where the noise-free recording is missed by more than its noise
    assert content["units"]["stribeck_friction.velocity"] == "rad/s"
    assert result.score < 1e-9
    events = EventAccumulator(str(folder)).Reload()
    tags = events.Tags()["scalars"]
    assert "result/stribeck_friction.effort/servo" in tags
    without, _ = run_fit(tmp_path, recorded, monkeypatch, optimizer="least_squares", effects=[])
    assert without.score > 100 * result.score


@pytest.mark.slow
def test_a_search_moves_effects_inside_their_bounds(recorded, tmp_path, monkeypatch):
    result, folder = run_fit(tmp_path, recorded, monkeypatch, optimizer="cmaes", max_iteration=3)
    found = result.parameters["stribeck_friction.velocity"]["servo"]
    velocity = next(p for p in get_effect("stribeck_friction").parameters if p.name == "velocity")
    assert velocity.lower <= found <= velocity.upper
    tags = EventAccumulator(str(folder)).Reload().Tags()["scalars"]
    assert any(tag.startswith("best/stribeck_friction.velocity") for tag in tags)
    assert any(tag == "spread/stribeck_friction.effort" for tag in tags)


def test_a_parameter_has_the_keys_of_its_joints_or_one_for_all():
    cfg = env_cfg(ANYMAL)
    cfg.sim2real.effects = ()
    knees = [name for name in cfg.sim2real.joint_order if name.endswith("KFE")]
    base = {name: value for name, value in CALM.items() if name != "delay"}
    problem = make_problem(record(legs_chirp(cfg, 0.1), {**base, "delay": 1.0}, cfg=cfg), cfg=cfg)
    problem = problem.with_effects(["torque_gain@.*KFE", "torque_offset@shared", "clock_skew"])
    keys = {p.name: list(p.keys) for p in problem.space.parameters if "." in p.name}
    assert keys == {"torque_gain.gain": knees, "torque_offset.effort": ["all"], "clock_skew.skew": ["all"]}
    effect = {"torque_gain.gain": 1.1, "torque_offset.effort": 0.7, "clock_skew.skew": 0.001}
    rollout = problem.evaluator().rollout(2)
    one = problem.space.from_dict({**base, "delay": 1.0, **effect})
    none = problem.space.from_dict({**base, "delay": 1.0, **dict.fromkeys(effect, 0.0), "torque_gain.gain": 1.0})
    rollout.start(torch.stack([one, none]))
    stack = next(iter(rollout.robot.actuators.values())).effects
    at = [name in knees for name in problem.joint_names]
    assert stack.find("torque_gain").gain[0].tolist() == [1.1 if x else 1.0 for x in at]
    assert stack.find("torque_offset").effort.tolist() == [[0.7] * 12, [0.0] * 12]
    assert stack.find("clock_skew").skew[0].tolist() == [0.001] * 12


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        (["stribek_friction"], "no effect 'stribek_friction'. Did you mean 'stribeck_friction'?"),
        (["torque_gain@elbow"], "'elbow' matches no joint. Available: servo."),
        (["nowhere:Drag"], "cannot be imported"),
        (["torque_gain", "torque_gain"], "named twice"),
    ],
)
def test_a_wrong_effect_is_one_line_and_exit_code_2(effects, message, tmp_path):
    run = run_script("fit", "--task", BENCH, "--effects", *effects, cwd=tmp_path)
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert line.startswith("error: ") and message in line
    assert not list(tmp_path.iterdir())
