"""A drive whose own loop runs faster than commands come: at a rate that is stated, or by the effect of a fast loop."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from bench_recordings import STEP, Bench, chirp, record
from problems import BENCH, env_cfg
from problems import chirp as chirp_of_one
from problems import record as own_recording

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive, save_recording
from pace_optim.run.settings import FitSettings


def error_at(problem, bench, **more):
    """RMSE of what is true of a drive."""
    truth = {
        "armature": bench.armature,
        "viscous_friction": bench.viscous,
        "friction": bench.coulomb,
        "encoder_bias": bench.bias,
        "delay": bench.delay / problem.control_dt,
    }
    physical = problem.space.from_dict({**truth, **more})
    return float(problem.evaluator().residuals(physical[None]).score.sqrt())


def test_a_fast_loop_is_simulated_at_its_own_rate(tmp_path):
    bench = Bench(drive_dt=0.0005, noise=0.0)
    told = {"data": [record(tmp_path / "fast.csv", bench, position=chirp(1.0))], "env_cfg": env_cfg()}
    held, fast = (load_problem(BENCH, physics_dt=0.0005, drive_dt=each, **told) for each in (None, bench.drive_dt))
    assert error_at(fast, bench) < 0.2 * error_at(held, bench)


@pytest.mark.slow
def test_the_effect_explains_the_motion_of_a_drive_that_runs_continuously(tmp_path):
    bench = Bench(drive_dt=STEP, noise=0.0)
    path = record(tmp_path / "fast.csv", bench, position=chirp(1.0))
    problem = load_problem(BENCH, data=[path], physics_dt=0.00125, effects=["fast_loop"])
    held, follows = (error_at(problem, bench, **{"fast_loop.share": share}) for share in (0.0, 1.0))
    assert follows < 0.1 * held


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drive_dt", "physics_dt"),
    [(0.001, 0.0005), (0.005, 0.0025), (0.0025, 0.0025), (0.0007, 0.0025 / 7), (0.004, 0.0005)],
)
def test_any_rate_finds_a_physics_step_that_fits_it(drive_dt, physics_dt):
    problem = load_problem(BENCH, env_cfg=env_cfg(), drive_dt=drive_dt)
    assert problem.physics_dt == pytest.approx(physics_dt)
    evaluator = problem.evaluator()
    middle = problem.space.to_physical(problem.space.start)[None]
    rollout = evaluator.rollout(1)
    rollout.start(middle)
    steps = torch.arange(100)
    stepped = torch.stack([position.clone() for position in rollout.simulated(100)])
    rollout.start(middle)
    assert torch.allclose(rollout.positions(steps), stepped, atol=1e-12)  # the compiled drive has the same clock


def test_a_rate_of_drives_counts_among_the_physics_steps_of_a_control_step():
    """Each step that the rate asked for was divided again: a robot from a file took 0.125 ms."""
    cfg = env_cfg()
    cfg.sim2real.physics_steps = 4
    assert load_problem(BENCH, env_cfg=cfg).physics_dt == pytest.approx(0.000625)
    assert load_problem(BENCH, env_cfg=cfg, drive_dt=0.001).physics_dt == pytest.approx(0.0005)


def test_a_rate_that_is_no_time_is_refused():
    with pytest.raises(ValueError, match=r"drive_dt is -0\.001, expected seconds, or 0"):
        FitSettings(task=BENCH, drive_dt=-0.001)


@pytest.mark.parametrize(("damping", "raised"), [(1.0, False), (60.0, True)])
def test_the_armature_is_sought_where_the_loop_is_stable(tmp_path, damping, raised):
    """A search that strayed below found oscillations, and a fit ended in a valley of theirs."""
    recording = replace(
        own_recording(chirp_of_one(1.0)), drive=Drive(stiffness=np.array([200.0]), damping=np.array([damping]))
    )
    path = str(save_recording(tmp_path / "stiff.npz", recording))
    plain, problem = ParameterSpace.of(env_cfg().sim2real), load_problem(BENCH, data=[path], env_cfg=env_cfg())
    lower, env = float(problem.space.lower[0]), problem.make_env(1)
    inertia = float(env.sim.model.dof_M0[0] - env.sim.model.dof_armature[0])
    env.close()
    if raised:
        assert (damping * 0.0025 + 0.5 * 200.0 * 0.0025**2) / (inertia + lower) == pytest.approx(2.0, rel=1e-3)
    else:
        assert lower == float(plain.lower[0])


def test_the_longest_step_is_no_longer_than_a_drives_loop_whatever_step_is_asked_for():
    """A diagnosis asks for half of the fit's: its first stage, at the longest, was refused."""
    told = {"env_cfg": env_cfg(), "drive_dt": 0.0005}
    for asked in (None, 0.0005, 0.00025):
        problem = load_problem(BENCH, physics_dt=asked, **told)
        assert problem.coarsest_dt == 0.0005 and problem.physics_dt == (asked or 0.0005)
        problem.with_physics_dt(problem.coarsest_dt).make_env(1).close()
    with pytest.raises(ValueError, match="expected at least a physics step in drive_dt"):
        load_problem(BENCH, physics_dt=0.00125, **told)


# ---- the effect


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


def test_a_loop_that_runs_at_every_call_is_the_effect_with_a_share_of_one():
    assert torques(motor(1.0)) == pytest.approx(torques(motor(drive_dt=0.0005)))
    assert torques(motor(1.0)) != pytest.approx(torques(motor()))


def test_the_effect_s_torque_is_that_of_the_mean_of_both_at_a_half_and_within_the_limit():
    held, follows, half = (torques(motor(share, effort_limit=100.0)) for share in (0.0, 1.0, 0.5))
    assert half == pytest.approx([(a + b) / 2 for a, b in zip(held, follows, strict=True)])
    assert max(abs(torque) for torque in torques(motor(1.0, effort_limit=5.0))) == 5.0


@pytest.mark.parametrize("changes", [{"implicit": True}, {"delay_mode": "effort"}])
def test_the_effect_does_nothing_where_the_loop_runs_continuously_or_its_torque_is_delayed(changes):
    assert torques(motor(1.0, **changes)) == torques(motor(**changes))
