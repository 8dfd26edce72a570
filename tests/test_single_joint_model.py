"""Joints simulated alone along a reference: friction at reversals, and the load that drives are told of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from problems import ANYMAL, CALM, chirp, env_cfg, legs_chirp, make_problem, record

from pace_envs import set_physics_dt
from pace_optim.recording import Load
from pace_optim.single_joint_model import measured_path, reference_path, twin_problem
from pace_optim.single_joint_model.simulation import _with_friction

TRUTH = {"armature": 0.1, "viscous_friction": 4.5, "friction": 0.1, "encoder_bias": 0.0, "delay": 2.0}


def moved_by(problem, physical):
    """Positions of the robot, or of joints alone, at every control step."""
    rollout = problem.evaluator().rollout(1)
    rollout.start(physical[None], problem.dataset.sampled)
    return torch.stack([position.clone() for position in rollout.simulated(rollout.duration_steps)])


def test_friction_turns_where_the_speed_passes_zero():
    """As a thousand small steps under the same push, each with friction against the speed that it ends with."""
    generator = torch.Generator().manual_seed(0)
    speed, pushed = torch.randn(2, 5000, dtype=torch.float64, generator=generator)
    stop = torch.rand(5000, dtype=torch.float64, generator=generator)
    speed[:200] = 0.0
    stop[100:300] = 0.0
    expected, parts = speed.clone(), 1000
    for _ in range(parts):
        free = expected + pushed / parts
        expected = free - torch.clamp(free, -stop / parts, stop / parts)
    assert float((_with_friction(speed, pushed, stop) - expected).abs().max()) < 4 / parts
    at_once = speed + pushed - torch.clamp(speed + pushed, -stop, stop)
    assert float((at_once - expected).abs().max()) > 0.5  # friction of the new sign all along


def test_a_joint_without_speed_push_and_friction_stays():
    zero = torch.zeros(1, dtype=torch.float64)
    assert _with_friction(zero, zero, zero).tolist() == [0.0]
    assert _with_friction(zero, zero + 0.5, zero + 0.5).tolist() == [0.0]
    assert _with_friction(zero - 1.0, zero + 1.0, zero).tolist() == [0.0]


@pytest.mark.parametrize("payload", [0.0, 0.3])
def test_friction_under_load_is_what_it_is_on_the_robot(payload):
    """Its drives are told of weight, and not of what their neighbours' accelerations do."""
    cfg = env_cfg(ANYMAL)
    problem = make_problem(record(legs_chirp(cfg, 0.5), TRUTH, cfg=cfg), cfg=cfg)
    whole = problem.with_effects(["load_dependent_friction", "payload"]).with_physics_dt(0.00025)
    values = {**TRUTH, "load_dependent_friction.coefficient": 0.1, "payload.ratio": payload}
    physical = whole.space.from_dict(values)
    path = reference_path(whole, physical, ["payload"])
    twins = twin_problem(whole, path).with_physics_dt(0.00125)
    assert float((moved_by(twins, physical) - path.position).abs().max()) < 3e-4


def test_a_joint_s_own_payload_is_that_of_its_link_alone():
    cfg = env_cfg(ANYMAL)
    problem = make_problem(record(legs_chirp(cfg, 0.05), TRUTH, cfg=cfg), cfg=cfg)
    path = reference_path(problem, problem.space.from_dict(TRUTH), ["payload"])
    twice, whole = path.model_effects["payload", "ratio"].inertia, path.feel.inertia
    assert torch.allclose(twice[..., 2], whole[..., 2])  # the shank is all that the knee moves
    assert bool((twice[..., 0] < 0.5 * whole[..., 0]).all())  # the hip moves thigh and shank too


def test_a_joint_without_neighbours_moves_alike_along_what_was_measured():
    """With noise on it, every third sample only, an encoder bias, and a payload sought beside the known load."""
    fine = env_cfg()
    set_physics_dt(fine, 0.00025)
    truth = {**CALM, "encoder_bias": 0.1}
    target = chirp(2.0)[::3]
    held = np.repeat(target, 3, axis=0)[: 3 * len(target) - 2]
    recording = record(held, truth, cfg=fine, load=Load(load_mass=1.0, load_length=0.15), noise=1e-3)
    third = {"time": recording.time[::3], "dof_pos": recording.dof_pos[::3], "des_dof_pos": target}
    recording = replace(recording, **third)
    whole = make_problem(recording).with_effects(["payload"])
    plain = whole.with_effects(())
    physical = whole.space.from_dict({**truth, "payload.ratio": 0.2})
    path = measured_path(plain, plain.space.from_dict(truth), ["payload"])
    twins = twin_problem(whole, path).with_physics_dt(0.00025)
    robot = moved_by(whole.with_physics_dt(0.00025), physical)
    without_noise = reference_path(plain, plain.space.from_dict(truth))
    armature = torch.tensor([truth["armature"]])
    expected = without_noise.typical_effort(armature).tolist()
    assert path.typical_effort(armature).tolist() == pytest.approx(expected, rel=0.1)
    apart = (moved_by(twins, physical) - robot).abs().max()
    without = moved_by(twin_problem(plain, path).with_physics_dt(0.00025), plain.space.from_dict(truth))
    assert float(apart) < 2e-4
    assert float((without - robot).abs().max()) > 2e-3  # the payload shows
