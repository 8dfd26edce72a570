"""The benchmarks measure what they say: same problem on both sides, honest traces, a search that stops in time."""

import math
from dataclasses import replace
from pathlib import Path

import drive_problem
import identification
import numpy as np
import pytest
import sysid_peer
import torch
import transfer
import transfer_robot
import transfer_table
from mujoco import sysid
from solver_trace import Trace, table

from pace_actuators import ActuatorActions, PaceDCMotor
from pace_actuators.effects import EffectCfg
from pace_envs import load_env_cfg
from pace_optim.data_collection.plant import plant_robot
from pace_optim.problem.problem import load_problem

needs_peer = pytest.mark.skipif(not hasattr(sysid, "optimize"), reason="the extra `benchmark` is not installed")


@pytest.fixture(scope="module")
def case():
    return drive_problem.drive_problem(steps=400)


def test_the_problem_has_36_parameters_and_our_simulation_replays_its_truth(case):
    residuals = case.problem.evaluator().residuals(case.truth[None])
    assert len(case.fitted) == 36
    assert float(residuals.error.abs().max()) == 0.0


def test_fixed_entries_cost_no_simulation_and_keep_no_column(case):
    space = case.problem.space
    coloured = sorted(entry for colour in case.problem.colouring.colours for entry in colour)
    assert coloured == sorted(case.fitted.tolist())
    assert len(case.problem.colouring.colours) == 9
    assert all(case.problem.colouring.joints[entry] == () for entry in range(space.size) if entry not in coloured)


@pytest.mark.slow
def test_the_chirp_drives_the_drives_into_the_effort_limit_which_both_sides_have():
    begun = drive_problem.drive_problem(steps=1600)
    (drive,) = begun.problem.env_cfg.scene.robot.actuators.values()
    asked = drive.stiffness * (begun.recording.des_dof_pos - begun.recording.dof_pos)
    assert np.abs(asked).max() > drive.effort_limit
    assert drive.saturation_effort is None
    spec = sysid_peer.peer_spec(begun)
    assert {tuple(actuator.forcerange) for actuator in spec.actuators} == {(-drive.effort_limit, drive.effort_limit)}


@needs_peer
@pytest.mark.parametrize("where", [-0.5, 0.0, 0.7])
def test_the_peer_simulates_the_same_motion(case, where):
    x = torch.full((1, case.problem.space.size), where, dtype=torch.float64)
    physical = case.problem.space.to_physical(x)
    ours = case.problem.evaluator().residuals(physical).error[0, 1:, 0].numpy()
    theirs = sysid_peer.Peer(case).error(physical[0][case.fitted].numpy())
    assert np.abs(ours).max() > 1e-3
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9)


def test_a_missing_peer_is_one_clear_message(monkeypatch):
    monkeypatch.delattr(sysid, "optimize", raising=False)
    with pytest.raises(ValueError, match=r"pip install 'pace-mujoco\[benchmark\]'"):
        sysid_peer.load_peer()


def test_a_trace_keeps_what_is_better_and_says_when_a_score_was_reached():
    trace = Trace(solver="s")
    for score, steps in [(1.0, 10), (2.0, 20), (0.1, 30)]:
        trace.add(score, np.array([3.0, -4.0]), steps)
    trace.end(iterations=3, simulated_steps=40)
    assert trace.score == [1.0, 0.1] and trace.simulated_steps == [10, 30]
    assert trace.largest_error[-1] == 4.0 and trace.parameter_error[-1] == pytest.approx(math.sqrt(12.5))
    assert trace.seconds_to(0.5) == trace.seconds[1]
    assert trace.seconds_to(0.01) == math.inf
    assert trace.wall_time_s >= trace.seconds[-1]


def test_a_table_lines_its_columns_up():
    lines = table(["", "value"], [["long name", "1"], ["x", "22"]]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[2].startswith("long name") and lines[3].endswith("22")


@pytest.mark.slow
def test_effort_delay_gets_a_recording_of_its_own_with_the_same_truth(tmp_path):
    path = identification.reference_recording("effort", tmp_path)
    problem = load_problem(identification.TASK, data=[path], delay_mode="effort")
    truth = problem.space.from_dict(problem.env_cfg.sim2real.sample_params)
    assert float(problem.evaluator().residuals(truth[None]).score) < 1e-24
    assert identification.reference_recording("command", tmp_path) == Path(problem.env_cfg.sim2real.data_dir)


@pytest.mark.slow
def test_the_joint_search_stops_after_its_time_and_tells_what_was_known_by_then():
    run = identification.joint_search(load_problem(identification.TASK), seconds=0.01, population=4)
    assert len(run.seconds) == 1 and run.seconds[0] > 0.01
    assert run.at(0.01) == math.inf and run.at(run.seconds[0]) == run.best[0] < math.inf
    assert run.simulated_steps == 4 * (5600 - 1)


def test_physics_is_timed_only_inside_the_context(case):
    with identification.physics_timed() as spent:
        case.problem.evaluator().residuals(case.truth[None])
    once = spent[0]
    case.problem.evaluator().residuals(case.truth[None])
    assert spent[0] == once > 0


def test_the_real_robots_drive_is_the_torque_law_in_other_code():
    cfg, robot, truth = load_env_cfg(transfer.TASK), plant_robot(transfer.ROBOT), transfer.truth_of(0)
    transfer_robot.make_real(cfg, robot, truth)
    assert round(1 / (cfg.sim.dt * cfg.decimation)) == 50 and cfg.sim.dt == transfer_robot.PHYSICS_DT
    drive = cfg.scene.robot.actuators["legs"]
    assert drive.control_decimation * cfg.sim.dt == pytest.approx(robot.control_dt)
    build = {"num_envs": 3, "physics_dt": cfg.sim.dt, "dtype": torch.float64}
    real = drive.class_type(drive, robot.joint_names, slice(None), **build)
    gain = EffectCfg(effect="torque_gain", values={"gain": truth.effects["torque_gain"]["gain"]})
    model_cfg = replace(drive, class_type=None, delay_s=truth.base.delay, effects=[gain])
    model = PaceDCMotor(model_cfg, robot.joint_names, slice(None), **build)
    draw = torch.Generator().manual_seed(0)

    def normal(size: float) -> torch.Tensor:
        return size * torch.randn(3, robot.num_joints, generator=draw, dtype=torch.float64)

    for step in range(200):
        if step % drive.control_decimation == 0:
            target = normal(0.2)
        if step == 100:
            real.reset(torch.tensor([1]))
            model.reset(torch.tensor([1]))
        q, v = normal(0.1), normal(0.5)
        torques = [each.compute(ActuatorActions(joint_positions=target), q, v).joint_efforts for each in (real, model)]
        assert torch.allclose(*torques, atol=1e-6)
    assert float(torques[0].abs().max()) > 20.0


def test_the_transfer_table_has_both_worlds_and_their_gap(tmp_path):
    world = {"velocity_error": 0.2, "falls_per_episode": 0.01, "cost_of_transport": 0.5}
    lines = [
        {"policy": "a nominal", "seed": s, "own": world, "real": world | {"velocity_error": 0.3 + 0.1 * s}}
        for s in range(2)
    ]
    table = transfer_table.make_table(lines)
    assert "| a nominal | 2 | 0.200 (0.200 to 0.200), 0.350 (0.300 to 0.400), 0.150 | 1.0 (" in table
    transfer_table.plot_transfer(lines, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5000
