"""Held commands act when they arrive, at the default steps too, beside an integrator of its own at 0.1 ms."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from bench_recordings import CONTROL_DT, STEP, Bench, chirp, record
from problems import BENCH, env_cfg

from pace_actuators import ActuatorActions, DelayBuffer, PaceDCMotor, PaceDCMotorCfg
from pace_envs import load_env_cfg
from pace_optim.estimate.error_bars.undetermined import whole_delay
from pace_optim.problem.problem import Problem, load_problem
from pace_optim.recording import load_recording, save_recording
from pace_optim.run.result import drive_in_force

URDF = """<robot name="pendulum"><link name="base"/>
  <link name="arm"><inertial><origin xyz="0 0 -0.1"/><mass value="0.3"/>
    <inertia ixx="1e-9" ixy="0" ixz="0" iyy="1e-9" iyz="0" izz="1e-9"/></inertial></link>
  <joint name="servo" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit effort="20" velocity="30"/></joint></robot>"""


def truth(problem: Problem, bench: Bench, late: float = 0.0) -> torch.Tensor:
    """The bench's parameters, its delay longer by so many control steps."""
    return problem.space.from_dict(
        {
            "armature": bench.armature,
            "viscous_friction": bench.viscous,
            "friction": bench.coulomb,
            "encoder_bias": bench.bias,
            "delay": bench.delay / CONTROL_DT + late,
        }
    )


def best_delay(problem: Problem, bench: Bench) -> float:
    """How much longer than the truth the delay of least error is, all else being true [control steps]."""
    around = (-0.6, 0.0, 0.6)
    scores = problem.evaluator().residuals(torch.stack([truth(problem, bench, late) for late in around])).score
    bend, slope, _ = np.polyfit(around, scores.numpy(), 2)
    return -slope / (2 * bend)


@pytest.mark.parametrize("bench", [Bench(drive_dt=STEP), Bench(kp=25.0, kd=0.6, delay=0.0081, drive_dt=STEP)])
def test_one_step_per_control_step_does_not_lengthen_the_delay_of_the_bench(tmp_path, bench):
    path = record(tmp_path / "chirp.csv", bench, position=chirp(3.0))
    problem = load_problem(BENCH, data=[path], env_cfg=env_cfg())
    assert problem.physics_dt == problem.control_dt == CONTROL_DT
    assert abs(best_delay(problem, bench)) < 0.1  # half a step before


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.005, 0.0061])
def test_a_torque_held_over_a_control_step_is_simulated_to_the_noise(tmp_path, delay):
    """A light link on stiff gains, whose loop runs at the commands' rate, as of a file without gains."""
    bench = Bench(armature=0.012, viscous=0.1, coulomb=0.2, delay=delay, load_mass=0.3, load_length=0.1)
    path = record(tmp_path / "held.csv", bench, position=chirp(3.0))
    urdf = tmp_path / "pendulum.urdf"
    urdf.write_text(URDF)
    path.with_suffix(".json").write_text(json.dumps({"stiffness": bench.kp, "damping": bench.kd}))
    problem = load_problem(str(urdf), data=[path])
    assert not problem.env_cfg.scene.robot.actuators["drives"].implicit
    residuals = problem.evaluator().residuals(truth(problem, bench)[None])
    assert float(residuals.score.sqrt()) < 5 * bench.noise  # two steps of semi-implicit Euler: 12 times


def test_commands_on_a_clock_of_their_own_keep_their_instants(tmp_path):
    """Samples at 125 Hz, commands at 41 Hz that begin before the first sample: neither falls on the grid."""
    bench = Bench(drive_dt=STEP, delay=0.004)
    period = 1 / 41
    issued = np.arange(int(3.0 / period)) * period
    values = np.interp(issued, np.arange(1200) * CONTROL_DT, chirp(3.0, top=3.0))
    held = values[(np.arange(1200) * CONTROL_DT / period + 1e-9).astype(int).clip(max=len(values) - 1)]
    path = record(tmp_path / "held.csv", replace(bench, noise=0.0), position=held)
    moves = np.flatnonzero(np.diff(held, prepend=held[0] - 1.0))
    whole = load_recording(path)
    samples = np.arange(5, len(held), 3)
    recording = replace(
        whole,
        time=samples * CONTROL_DT,
        dof_pos=whole.dof_pos[samples],
        des_dof_pos=held[moves, None],
        des_time=moves * CONTROL_DT,
    )
    save_recording(tmp_path / "clocks.npz", recording)
    problem = load_problem(BENCH, data=[tmp_path / "clocks.npz"], env_cfg=env_cfg())
    assert abs(best_delay(problem, bench)) < 0.15


def test_a_lead_is_added_to_every_lag():
    buffer, later = DelayBuffer(3.0, 1), DelayBuffer(3.5, 1)
    buffer.set_time_lag(3.0)
    buffer.set_lead(0.5)
    later.set_time_lag(3.5)
    for sample in np.random.default_rng(0).normal(size=9):
        pushed = torch.full((1, 1), float(sample), dtype=torch.float64)
        assert torch.equal(buffer.compute(pushed), later.compute(pushed))
    assert buffer.time_lags.tolist() == [3.0]


@pytest.mark.parametrize(
    ("cfg", "is_trapezoidal", "holds_line", "early"),
    [
        ({}, False, False, True),
        ({}, True, True, False),  # a simulator in which a held torque acts when it should
        ({"delay_mode": "effort"}, False, False, False),
        ({"centred_commands": False, "second_order": True}, False, False, True),
    ],
)
def test_the_half_step_is_taken_out_where_a_simulator_makes_it(cfg, is_trapezoidal, holds_line, early):
    cfg = {"centred_commands": True} | cfg
    cfg = PaceDCMotorCfg(joint_names_expr="a", stiffness=1.0, damping=0.0, effort_limit=100.0, **cfg)
    motor = PaceDCMotor(cfg, ["a"], slice(None), 1, physics_dt=CONTROL_DT, dtype=torch.float64)
    motor.take_over_simulator(is_trapezoidal=is_trapezoidal, holds_line=holds_line)
    still, torques = torch.zeros(1, 1, dtype=torch.float64), []
    for target in (0.0, 0.0, 1.0, 1.0):
        for _ in range(cfg.control_decimation):
            action = ActuatorActions(joint_positions=torch.full_like(still, target))
            torques.append(float(motor.compute(action, still, still).joint_efforts))
    assert motor.time_lags.tolist() == [0.0]
    assert (torques == [0.0, 0.0, 0.5, 1.0]) == early


@pytest.mark.parametrize(
    ("is_trapezoidal", "changes", "shown"),
    [(False, {}, 0.1 - 0.5 * CONTROL_DT * 4.0), (True, {}, 0.1), (False, {"implicit": True}, 0.1)],
)
def test_positions_that_a_simulator_shows_early_are_taken_back_where_a_simulator_makes_it(
    is_trapezoidal, changes, shown
):
    cfg = PaceDCMotorCfg(
        joint_names_expr="a", stiffness=1.0, damping=0.0, effort_limit=100.0, second_order=True, **changes
    )
    motor = PaceDCMotor(cfg, ["a"], slice(None), 1, physics_dt=CONTROL_DT, dtype=torch.float64)
    motor.take_over_simulator(is_trapezoidal=is_trapezoidal, holds_line=False)
    position, velocity = (torch.full((1, 1), value, dtype=torch.float64) for value in (0.1, 4.0))
    torque = motor.compute(ActuatorActions(joint_positions=torch.zeros_like(position)), position, velocity)
    assert float(torque.joint_efforts) == pytest.approx(-shown)


@pytest.mark.parametrize("decimation", [1, 5])
@pytest.mark.parametrize("mode", ["command", "effort"])
def test_limits_act_on_the_torque_before_and_after_a_command_that_arrives_within_a_step(decimation, mode):
    """A delay of 1.3 control steps; targets 0, then 3 rad at a limit of 1 N m: 0.3 of a step at 0, 0.7 at the limit."""
    cfg = PaceDCMotorCfg(
        joint_names_expr="a",
        stiffness=1.0,
        damping=0.0,
        effort_limit=1.0,
        delay=1.3,
        delay_mode=mode,
        control_decimation=decimation,
    )
    motor = PaceDCMotor(cfg, ["a"], slice(None), 1, physics_dt=CONTROL_DT / decimation, dtype=torch.float64)
    still, means = torch.zeros(1, 1, dtype=torch.float64), []
    for target in (0.0, 3.0, 3.0, 3.0):
        action = ActuatorActions(joint_positions=torch.full_like(still, target))
        torques = [float(motor.compute(action, still, still).joint_efforts) for _ in range(decimation)]
        means.append(sum(torques) / decimation)
    assert means == pytest.approx([0.0, 0.0, 0.7, 1.0])


def test_what_a_fit_found_keeps_how_commands_act_in_training_and_exports(tmp_path):
    problem = load_problem(BENCH, env_cfg=env_cfg())
    assert drive_in_force(problem)["centred_commands"] == {"servo": 1.0}
    assert not load_env_cfg("Pace-AnymalD-v0").scene.robot.actuators["legs"].centred_commands  # PACE's own
    assert "second_order" not in drive_in_force(problem)
    assert drive_in_force(problem.with_physics_dt(CONTROL_DT / 2))["second_order"] == {"servo": 1.0}


def test_a_delay_of_whole_steps_of_a_held_loop_is_said_to_be_one_of_many(tmp_path):
    bench = Bench(drive_dt=STEP)
    recording = load_recording(record(tmp_path / "chirp.csv", bench, position=chirp(2.0)))
    clocks = replace(recording, des_time=recording.time[::2], des_dof_pos=recording.des_dof_pos[::2])
    paths = [save_recording(tmp_path / f"{name}.npz", each) for name, each in (("own", clocks), ("rows", recording))]
    own, rows = (load_problem(BENCH, data=[path], env_cfg=env_cfg()) for path in paths)
    assert "above 5 and up to 7.5 ms" in whole_delay(own, 2.98, 0.008)[0]
    assert not whole_delay(own, 2.9, 0.008) and not whole_delay(rows, 3.0, 0.008)
    fast = load_problem(BENCH, data=[paths[0]], env_cfg=env_cfg(), drive_dt=0.0005)
    assert not whole_delay(fast, 3.0, 0.008)
