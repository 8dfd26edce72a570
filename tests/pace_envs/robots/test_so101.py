"""The SO-101's servos: what is published about them, as a PD drive with a torque-speed line."""

import numpy as np
import pytest
import torch

from pace_actuators import ActuatorActions, PaceDCMotor
from pace_envs import load_env_cfg
from pace_envs.robots import SO101_JOINTS
from pace_envs.robots.so101 import so101_drive_cfg
from pace_optim.identification.fit import fit
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine

TASK = "Pace-SO101-v0"


def test_the_drive_is_the_servo_that_turns_an_error_into_a_duty_cycle():
    cfg = so101_drive_cfg()
    stall, free = cfg.saturation_effort, cfg.velocity_limit
    drive = PaceDCMotor(cfg, list(SO101_JOINTS), slice(None), num_envs=200)
    target, q, v = torch.randn(3, 200, 6, generator=torch.Generator().manual_seed(0))
    v = (2 * v).clamp(-free, free)
    duty = (0.164 * 16 * (target - q)).clamp(-1, 1)
    torque = drive.compute(ActuatorActions(target), q, v).joint_efforts
    assert (duty.abs() == 1).any() and (duty.abs() < 1).any()
    assert torch.allclose(torque, stall * (duty - v / free), atol=1e-4)


def test_delay_and_friction_of_hobby_servos_lie_within_the_bounds():
    cfg = load_env_cfg(TASK)
    step = cfg.sim.dt * cfg.decimation
    bounds = cfg.sim2real.bounds
    assert bounds["delay"][0, 1] * step >= 0.15
    (drive,) = cfg.scene.robot.actuators.values()
    assert drive.max_delay >= bounds["delay"][0, 1]
    assert float(bounds["friction"][:, 1].min()) >= 0.05 * drive.stiffness


def test_the_smallest_armature_is_stable_at_the_smallest_inertia():
    cfg = load_env_cfg(TASK)
    (drive,) = cfg.scene.robot.actuators.values()
    smallest = float(cfg.sim2real.bounds["armature"][:, 0].min())
    assert drive.damping * cfg.sim.dt / smallest < 1  # explicit back-EMF: no overshoot within a step


@pytest.mark.slow
def test_the_sample_is_identified(tmp_path):
    result, _ = fit(FitSettings(task=TASK, optimizer="least_squares", log_dir=str(tmp_path)), ProgressLine())
    truth = load_env_cfg(TASK).sim2real.sample_params
    assert result.score < 1e-10
    for name in ("armature", "viscous_friction", "friction"):
        np.testing.assert_allclose(list(result.parameters[name].values()), truth[name], rtol=0.02)
    assert result.parameters["delay"]["all"] == pytest.approx(truth["delay"], abs=0.02)
