"""A drive whose own loop runs faster than commands come."""

import pytest
import torch
from bench_recordings import STEP, Bench, chirp, record

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg
from pace_optim.problem.problem import load_problem

BENCH = "Pace-TestBench-v0"


def motor(share=None, calls=4, **changes) -> PaceDCMotor:
    effects = [] if share is None else ["fast_loop"]
    fields = {"stiffness": 40.0, "damping": 1.0, "effort_limit": 9.0, "physics_dt": 0.0005, "control_decimation": calls}
    cfg = PaceDCMotorCfg(joint_names_expr="j", effects=effects, **fields | changes)
    drive = PaceDCMotor(cfg, ["j"], [0], 1, dtype=torch.float64)
    if share is not None:
        drive.effects.find("fast_loop").set_parameter("share", share)
        drive.update_effects()
    return drive


def torques(drive: PaceDCMotor, count: int = 9) -> list[float]:
    """Torques of a drive along a motion."""
    found = []
    for k in range(count):
        at, speed = (torch.tensor([[value]], dtype=torch.float64) for value in (0.02 * k, 1.0 + 0.3 * k))
        found.append(drive.compute(ActuatorActions(torch.tensor([[0.05]]).double()), at, speed).joint_efforts.item())
    return found


def test_a_loop_that_runs_at_every_call_is_one_whose_share_is_one():
    assert torques(motor(1.0)) == pytest.approx(torques(motor(drive_dt=0.0005)))
    assert torques(motor(1.0)) != pytest.approx(torques(motor()))


def test_its_torque_is_that_of_the_mean_of_both_at_a_half_and_within_the_limit():
    held, follows, half = (torques(motor(share, effort_limit=100.0)) for share in (0.0, 1.0, 0.5))
    assert half == pytest.approx([(a + b) / 2 for a, b in zip(held, follows, strict=True)])
    assert max(abs(torque) for torque in torques(motor(1.0, effort_limit=5.0))) == 5.0


@pytest.mark.parametrize("changes", [{"implicit": True}, {"delay_mode": "effort"}])
def test_it_does_nothing_where_the_loop_runs_continuously_or_its_torque_is_delayed(changes):
    assert torques(motor(1.0, **changes)) == torques(motor(**changes))


def test_it_explains_the_motion_of_a_drive_that_runs_continuously(tmp_path):
    bench = Bench(drive_dt=STEP, noise=0.0)
    path = record(tmp_path / "fast.csv", bench, position=chirp(1.0))
    problem = load_problem(BENCH, data=[path], physics_dt=0.00125, effects=["fast_loop"])
    error = {}
    for share in (0.0, 1.0):
        values = {
            "armature": bench.armature,
            "viscous_friction": bench.viscous,
            "friction": bench.coulomb,
            "encoder_bias": bench.bias,
            "delay": bench.delay / problem.control_dt,
            "fast_loop.share": share,
        }
        physical = problem.space.from_dict(values)
        error[share] = float(problem.training_evaluator().residuals(physical[None]).score[0]) ** 0.5
    assert error[1.0] < 0.1 * error[0.0]
