"""A whole robot whose drives are compiled around MuJoCo's step moves as the environment does."""

import shutil
from dataclasses import replace

import pytest
import torch
from effect_envs import EFFECTS, Branching
from problems import ANYMAL, CALM, DT, TRUTH, chirp, env_cfg, legs_chirp, make_problem, physical, record

from pace_actuators import PaceDCMotor
from pace_actuators.effects import EffectCfg, get_effect, registry
from pace_actuators.files import OwnFolder
from pace_envs import set_physics_dt
from pace_envs.compiler import host
from pace_optim.recording import Load

pytestmark = pytest.mark.skipif(shutil.which("c++") is None, reason="needs a compiler of C++")


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    """Compile at once, however short a recording is."""
    monkeypatch.setattr(host, "_PATIENCE", 0)


def both(problem, values, where=None):
    """Positions of two candidates by the environment and by compiled drives, and whether these were compiled."""
    candidates = torch.stack([values, problem.space.to_physical(problem.space.to_normalised(values) * 0.99)])
    results = []
    for compiled in (False, True, True):
        evaluator = problem.evaluator()
        rollout = evaluator.rollout(2)
        used = []
        simulate = rollout._compiled.positions

        def positions(at, state=None, torque=None, simulate=simulate, compiled=compiled, used=used):
            shown = simulate(at, state, torque) if compiled else None
            used.append(shown is not None)
            return shown

        rollout._compiled.positions = positions
        for _ in range(1 + compiled):
            error = evaluator.residuals(candidates, where).error
        results.append(error)
    assert torch.equal(results[1], results[2])
    return results[0], results[1], used[-1]


def apart(problem, values=None, where=None):
    """The largest difference [rad], of drives that could be compiled; what a wrong one would hide moves by 1e-4."""
    values = physical(problem, CALM) if values is None else values
    expected, got, compiled = both(problem, values, where)
    assert compiled and float(expected.abs().max()) > 1e-4
    return float((expected - got).abs().max())


def with_effects(problem, effects):
    """The problem with effects, and its parameters at where searches for these start."""
    problem = problem.with_effects(effects)
    values = {**CALM}
    for name in effects:
        kind = get_effect(name.split("@")[0])
        values |= {f"{kind.name}.{parameter.name}": parameter.start for parameter in kind.parameters}
    return problem, problem.space.from_dict(values)


@pytest.fixture(scope="module")
def bench():
    """A joint on two short recordings of different lengths."""
    return make_problem([record(chirp(duration, 2.0, 6.0, size), CALM) for duration, size in ((0.4, 0.5), (0.3, 0.3))])


def test_the_plain_drive_of_a_joint_moves_to_the_last_digits(bench):
    assert apart(bench) < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize(("physics_dt", "first"), [(DT / 4, 0), (DT / 4, 1), (DT / 4, 2), (DT / 4, 3), (DT, 0)])
def test_effects_move_a_joint_as_in_the_environment(bench, physics_dt, first):
    """Every one of them, several at once: each set takes a compiler a second."""
    names = [name for name in EFFECTS if not get_effect(name).reads_link][first::4]
    assert apart(*with_effects(bench.with_physics_dt(physics_dt), names)) < 1e-8


READ_THE_LINK = [name for name in EFFECTS if get_effect(name).reads_link and not get_effect(name).free_form]


@pytest.mark.slow
@pytest.mark.parametrize("name", READ_THE_LINK)
def test_an_effect_that_reads_the_link_is_left_to_the_environment(bench, name):
    expected, got, compiled = both(*with_effects(bench, [name]))
    assert not compiled and torch.equal(expected, got)


@pytest.mark.slow
def test_a_robot_of_several_joints_that_move_each_other():
    cfg = env_cfg(ANYMAL)
    problem = make_problem(record(legs_chirp(cfg, 0.3), TRUTH, cfg=cfg), cfg=cfg)
    assert apart(problem, problem.space.from_dict(TRUTH)) < 1e-12
    finer, values = with_effects(problem.with_physics_dt(DT / 2), ["torque_gain", "stribeck_friction", "backlash"])
    assert apart(finer, values) < 1e-8
    motions = []
    for compiled in (False, True):  # of the whole robot too
        rollout = finer.evaluator().rollout(1)
        if not compiled:
            rollout._compiled.positions = lambda *_: None
        rollout.start(values[None])
        motions.append(rollout.motion(100))
    for one, other in zip(*motions, strict=True):
        assert float((one - other).abs().max()) < 1e-6 and float((one[-1] - one[0]).abs().min()) > 1e-5
    shown, positions, speeds = motions[1]
    assert positions.shape[1:] == speeds.shape[1:] == shown.shape[1:]


@pytest.mark.slow
def test_frictions_of_joints_that_push_each_other_settle_as_in_the_environment():
    cfg = env_cfg(ANYMAL)
    problem = make_problem(record(legs_chirp(cfg, 0.3), TRUTH, cfg=cfg), cfg=cfg).with_physics_dt(DT / 2)
    assert apart(problem, problem.space.from_dict({**TRUTH, "friction": 3.0})) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("where", [".*", ".*KFE"], ids=["all", "beside hard ones"])
def test_soft_friction_is_the_environment_s(where):
    cfg = env_cfg(ANYMAL)
    problem = make_problem(record(legs_chirp(cfg, 0.3), TRUTH, cfg=cfg), cfg=cfg).with_physics_dt(DT / 2)
    soft = problem.with_effects([EffectCfg(effect="soft_friction", joint_names_expr=where)])
    values = soft.space.from_dict({**TRUTH, "friction": 3.0, "soft_friction.time_constant": 0.02})
    assert apart(soft, values) < 1e-9
    hard = problem.evaluator().residuals(problem.space.from_dict({**TRUTH, "friction": 3.0})[None]).error
    assert float((hard - soft.evaluator().residuals(values[None]).error).abs().max()) > 1e-4


@pytest.mark.slow
def test_drives_in_several_groups_whose_joints_are_not_in_the_model_s_order():
    cfg = env_cfg(ANYMAL)
    robot = cfg.scene.robot
    (drive,) = robot.actuators.values()
    groups = {"hips": ".*(HAA|HFE)", "knees": ".*KFE"}
    robot.actuators = {name: replace(drive, joint_names_expr=expr) for name, expr in groups.items()}
    problem = make_problem(record(legs_chirp(cfg, 0.2), TRUTH, cfg=cfg), cfg=cfg)
    assert apart(problem, problem.space.from_dict(TRUTH)) < 1e-12
    mixed, values = with_effects(problem, ["torque_gain@.*KFE"])
    assert apart(mixed, values) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("delay_mode", ["command", "effort"])
@pytest.mark.parametrize("rate", [{}, {"drive_dt": DT / 4}, {"implicit": True}], ids=str)
def test_delays_of_every_kind(delay_mode, rate):
    cfg = env_cfg()
    for drive in cfg.scene.robot.actuators.values():
        drive.delay_mode = delay_mode
        for key, value in rate.items():
            setattr(drive, key, value)
    set_physics_dt(cfg, DT / 4)
    problem = make_problem(record(chirp(0.3, 2.0, 6.0), CALM), cfg=cfg)
    assert apart(problem) < 1e-12


@pytest.mark.slow
def test_facts_of_recordings_switches_speeds_and_samples_beside_the_steps(bench):
    stiff = record(chirp(0.3, 2.0, 6.0), CALM, drive={"stiffness": 60.0}, load=Load(load_mass=0.5))
    problem = make_problem([*bench.dataset.recordings, stiff])
    data = problem.dataset
    enable = torch.ones_like(data.sampled)
    enable[20:45] = False
    offset = torch.linspace(-0.5, 0.5, len(enable), dtype=torch.float64)[:, None].expand(enable.shape)
    speeds = torch.gradient(data.command, dim=0)[0] / DT
    for changes in (
        {},
        {"torque_enable": enable, "command_vel": speeds, "command_effort": 0.1 * data.command},
        {"sample_offset": offset},
    ):
        assert apart(replace(problem, dataset=replace(data, **changes))) < 1e-12
    late, values = with_effects(problem, ["measurement_delay"])
    assert apart(late, values) < 1e-8
    where = problem.dataset.train.clone()
    where[30:] = where[5:12] = False
    assert apart(problem, where=where) < 1e-14


class OwnDrive(PaceDCMotor):
    """A drive of a user's that remembers what it likes."""

    def drive_effort(self, effort_command, joint_pos, joint_vel):
        self.seen = [*getattr(self, "seen", []), joint_pos]
        return super().drive_effort(effort_command, self.seen[0], joint_vel)


@pytest.mark.slow
def test_what_cannot_be_compiled_is_stepped_by_the_environment(bench, monkeypatch):
    monkeypatch.setitem(registry._EFFECTS, Branching.name, Branching)
    expected, got, compiled = both(*with_effects(bench, ["branching"]))
    assert torch.equal(expected, got) and not compiled
    cfg = env_cfg()
    for drive in cfg.scene.robot.actuators.values():
        drive.class_type = OwnDrive
    own = make_problem(bench.dataset.recordings[0], cfg=cfg)
    expected, got, compiled = both(own, physical(own, CALM))
    assert torch.equal(expected, got) and not compiled


def test_nothing_is_compiled_for_few_steps(bench, monkeypatch, tmp_path):
    monkeypatch.setattr(host, "_PATIENCE", 500)
    kernels = host.HostKernels(shutil.which("c++"), OwnFolder.at(tmp_path))
    assert [kernels.pays("source", 300) for _ in range(4)] == [False, True, True, True]
    name, binary = kernels._name_of("kept"), b"a kernel"
    (tmp_path / name).write_bytes(binary + host._digest_of(name, binary))
    assert kernels.pays("kept", 1)


def test_a_simulation_that_diverges_diverges_and_the_next_one_does_not(bench):
    values = physical(bench, CALM)
    wild = values.clone()
    wild[bench.space["delay"]], wild[bench.space["armature"]] = 10.0, float(bench.space.lower[0])
    problem = replace(bench, delay_mode="effort")
    evaluator = problem.evaluator()
    scores = evaluator.residuals(torch.stack([values, wild])).score
    assert torch.equal(evaluator.residuals(values[None]).score, scores[:1])
