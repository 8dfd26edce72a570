"""Friction at rest and while sliding, identified apart: PACE's flag."""

import dataclasses

import pytest
import torch
from problems import BENCH, CALM, chirp, record

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg
from pace_actuators.effects import EffectCfg
from pace_envs import ManagerBasedRLEnv, load_env_cfg, register_task
from pace_envs.tasks.pace import PaceSim2realEnvCfg
from pace_envs.tasks.pace.parameters import effect_parameters
from pace_optim.diagnosis import candidate_effects
from pace_optim.identification.fit import fit
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings


def separated(task: str, **bounds) -> PaceSim2realEnvCfg:
    cfg = load_env_cfg(task)
    cfg.sim2real.separate_dynamic_friction = True
    for name, value in bounds.items():
        setattr(cfg.sim2real, name, value)
    cfg.prepare()
    return cfg


def test_the_flag_adds_a_ratio_per_joint():
    cfg = separated("Pace-AnymalD-v0", friction_ratio_bounds=(0.2, 0.9))
    space = ParameterSpace.of(cfg.sim2real)
    assert space.size == 61
    ratios = space.slices["dynamic_friction.ratio"]
    assert ratios == slice(49, 61)  # after PACE's 49, whose places stay
    (ratio,) = effect_parameters(cfg.sim2real)
    assert set(ratio.lower) == {0.2} and set(ratio.upper) == {0.9}
    cfg.set_effects(["torque_gain"])  # what a fit does with --effects
    assert [effect.effect_class.name for effect in cfg.sim2real.effects] == ["dynamic_friction", "torque_gain"]


def test_without_the_flag_nothing_changes():
    assert ParameterSpace.of(load_env_cfg("Pace-AnymalD-v0").sim2real).size == 49


def test_bounds_of_the_ratio_are_checked():
    with pytest.raises(ValueError, match="friction_ratio_bounds"):
        separated("Pace-AnymalD-v0", friction_ratio_bounds=(0.5, 1.2)).sim2real.prepare()


def test_friction_is_that_of_rest_at_rest_and_its_share_while_sliding():
    cfg = PaceDCMotorCfg(
        joint_names_expr=".*",
        stiffness=1.0,
        damping=0.0,
        friction=2.0,
        effects=(EffectCfg(effect="dynamic_friction", values={"ratio": 0.5}),),
        physics_dt=0.0025,
    )
    motor = PaceDCMotor(cfg, ["a"], slice(None), 3)
    speeds, zeros = torch.tensor([[0.0], [0.5], [-2.0]]), torch.zeros(3, 1)
    motor.compute(ActuatorActions(zeros), zeros, speeds)
    assert torch.allclose(motor.joint_friction, torch.tensor([[2.0], [1.0], [1.0]]))


def test_a_stuck_joint_breaks_away_later_than_it_comes_to_rest():
    """In the simulation: 0.8 N m hold at rest what 0.5 times as much does not while it slides."""
    cfg = separated("Pace-TestBench-v0")
    cfg.scene.num_envs, cfg.sim.num_threads, cfg.sim.gravity = 4, 1, (0.0, 0.0, 0.0)
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    space = ParameterSpace.of(cfg.sim2real)
    values = space.from_dict(
        {
            "armature": {"servo": 0.1},
            "viscous_friction": {"servo": 0.0},
            "friction": {"servo": 0.8},
            "encoder_bias": {"servo": 0.0},
            "delay": {"all": 0.0},
            "dynamic_friction.ratio": {"servo": 0.5},
        }
    )
    space.apply(env, values.expand(4, -1))
    robot = env.scene["robot"]
    robot.write_joint_state_to_sim(torch.zeros(4, 1), torch.tensor([[0.0], [0.0], [0.5], [0.5]]))
    pull = torch.tensor([[0.6], [1.0], [0.6], [0.3]]) / 85.0  # the drive's torque over its gain, at the start [rad]
    for _ in range(20):
        robot.actuators["servo"].damping[:] = 0.0
        env.step(robot.data.joint_pos + pull)
    moved, speed = robot.data.joint_pos[:, 0], robot.data.joint_vel[:, 0]
    env.close()
    assert moved[0].abs() < 1e-4  # 0.6 N m: less than at rest
    assert moved[1] > 1e-3  # 1.0 N m: more
    assert speed[2] > 0.5 and speed[3] < 0.5  # already sliding: 0.6 N m is more than 0.4, 0.3 N m less


@pytest.mark.slow
def test_a_fit_of_a_task_with_the_flag_recovers_both_frictions(tmp_path):
    """The bench with 0.8 N m at rest and half of it while sliding, 0.1 mrad of noise."""
    register_task("Pace-SeparatedBench-v0", lambda: separated(BENCH))
    truth = {**CALM, "friction": 0.8, "viscous_friction": 0.5, "dynamic_friction.ratio": 0.5}
    made = record(chirp(2.0, 0.2, 4.0, 0.4), truth, cfg=separated(BENCH), noise=1e-4)
    save_recording(tmp_path / "bench.npz", dataclasses.replace(made, name="bench"))
    result, _ = fit(
        FitSettings(
            task="Pace-SeparatedBench-v0",
            data=[str(tmp_path / "bench.npz")],
            optimizer="least_squares",
            check_consistency=False,
            log_dir=str(tmp_path),
        )
    )
    for name, tolerance in (("friction", 0.02), ("dynamic_friction.ratio", 0.02)):
        (found,), (std,) = result.parameters[name].values(), result.std[name].values()
        assert abs(found - truth[name]) < min(tolerance, 4 * std), name
    assert result.effects == ["dynamic_friction"]


def test_a_diagnosis_tries_both_laws():
    """Either is named as the other where it is missing."""
    assert {"stribeck_friction", "dynamic_friction"} <= {effect.name for effect in candidate_effects()}
