"""Joints simulated alone along a reference: friction at reversals, and the load that drives are told of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from models import FINGER, FOUR_BAR
from problems import ANYMAL, CALM, chirp, env_cfg, legs_chirp, make_problem, record, replayed

from pace_envs import set_physics_dt
from pace_envs.coulomb import turned
from pace_envs.from_model import cfg_from_model
from pace_optim.joints.simulation import measured_path, reference_path, twin_problem
from pace_optim.recording import Load

TRUTH = {"armature": 0.1, "viscous_friction": 4.5, "friction": 0.1, "encoder_bias": 0.0, "delay": 2.0}


def moved_by(problem, physical):
    """Positions of the robot, or of joints alone, at every control step."""
    rollout = problem.evaluator().rollout(1)
    rollout.start(physical[None], problem.dataset.sampled)
    return rollout.positions(torch.arange(rollout.duration_steps))


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
    assert float((turned(speed, pushed, stop) - expected).abs().max()) < 4 / parts
    at_once = speed + pushed - torch.clamp(speed + pushed, -stop, stop)
    assert float((at_once - expected).abs().max()) > 0.5  # friction of the new sign all along


def test_a_joint_without_speed_push_and_friction_stays():
    zero = torch.zeros(1, dtype=torch.float64)
    assert turned(zero, zero, zero).tolist() == [0.0]
    assert turned(zero, zero + 0.5, zero + 0.5).tolist() == [0.0]
    assert turned(zero - 1.0, zero + 1.0, zero).tolist() == [0.0]


@pytest.mark.slow
@pytest.mark.parametrize("payload", [0.0, 0.3])
def test_friction_under_load_is_what_it_is_on_the_robot(payload):
    """Its drives are told of weight, and not of what their neighbours' accelerations do."""
    effects, fine = ["load_dependent_friction", "payload"], env_cfg(ANYMAL)
    set_physics_dt(fine, 0.00025)
    fine.set_effects(effects)
    truth = {**TRUTH, "load_dependent_friction.coefficient": 0.1, "payload.ratio": payload}
    recording = replayed(legs_chirp(fine, 0.5), truth, fine)
    whole = make_problem(recording, cfg=env_cfg(ANYMAL)).with_effects(effects)
    sought = whole.space.from_dict(truth)
    path = reference_path(whole.with_physics_dt(0.00025), sought, ["payload"])
    twins = twin_problem(whole, path).with_physics_dt(0.0025 / 3)
    assert float((moved_by(twins, sought)[:, 0] - torch.as_tensor(recording.dof_pos)).abs().max()) < 3e-4


@pytest.mark.slow
def test_soft_friction_is_what_it_is_on_the_robot():
    """MuJoCo scales it by what the whole robot lets a torque do, not by the joint's inertia alone."""
    fine = env_cfg(ANYMAL)
    set_physics_dt(fine, 0.00025)
    fine.set_effects(["soft_friction"])
    truth = {**TRUTH, "friction": 4.0, "soft_friction.time_constant": 0.02}
    recording = replayed(legs_chirp(fine, 0.5), truth, fine)
    plain = make_problem(recording, cfg=env_cfg(ANYMAL))
    whole = plain.with_effects(["soft_friction"])
    sought = whole.space.from_dict(truth)
    path = reference_path(whole.with_physics_dt(0.00025), sought)
    twins = twin_problem(whole, path).with_physics_dt(0.0025 / 3)
    measured = torch.as_tensor(recording.dof_pos)
    assert float((moved_by(twins, sought)[:, 0] - measured).abs().max()) < 3e-4
    hard = twin_problem(plain, path).with_physics_dt(0.0025 / 3)
    without = plain.space.from_dict({**TRUTH, "friction": 4.0})
    assert float((moved_by(hard, without)[:, 0] - measured).abs().max()) > 3e-3


def test_a_joint_s_own_payload_is_that_of_its_link_alone():
    cfg = env_cfg(ANYMAL)
    problem = make_problem(record(legs_chirp(cfg, 0.05), TRUTH, cfg=cfg), cfg=cfg)
    path = reference_path(problem, problem.space.from_dict(TRUTH), ["payload"])
    twice, whole = path.model_effects["payload", "ratio"].inertia, path.feel.inertia
    assert torch.allclose(twice[..., 2], whole[..., 2])  # the shank is all that the knee moves
    assert bool((twice[..., 0] < 0.5 * whole[..., 0]).all())  # the hip moves thigh and shank too


@pytest.mark.slow
def test_a_joint_without_neighbours_moves_alike_along_what_was_measured():
    """With noise on it, every third sample only, an encoder bias, and a payload sought beside the known load."""
    fine = env_cfg()
    set_physics_dt(fine, 0.00025)
    truth = {**CALM, "encoder_bias": 0.1}
    target = chirp(1.0)[::3]
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


@pytest.mark.slow
def test_a_weight_that_is_not_there_pulls_nowhere():
    """Also where the joint is far from the reference along which gravity is linear."""
    recording = record(chirp(1.0), CALM, cfg=env_cfg())
    whole = make_problem(recording).with_effects(["payload"])
    plain = whole.with_effects(())
    elsewhere = plain.space.from_dict({**CALM, "viscous_friction": 20.0})
    path = reference_path(plain, elsewhere, ["payload"])
    truth = whole.space.from_dict({**CALM, "payload.ratio": -1.0})
    twins = twin_problem(whole, path).with_physics_dt(0.0005)
    robot = moved_by(whole.with_physics_dt(0.0005), truth)
    assert float((path.position - robot).abs().max()) > 0.2
    assert float((moved_by(twins, truth) - robot).abs().max()) < 1e-3  # 8e-3 where its pull back stayed


@pytest.mark.slow
def test_a_joint_is_moved_by_what_its_neighbours_did_whatever_they_are_said_to_be():
    """A knee that is said to have a thirtieth of its friction moves wrongly, and its thigh would with it."""
    cfg, fine = env_cfg(ANYMAL), env_cfg(ANYMAL)
    set_physics_dt(fine, 0.00025)
    target, names = legs_chirp(cfg, 0.5), cfg.sim2real.joint_order
    truth = {**TRUTH, "friction": {name: 3.0 if name == "LF_KFE" else 0.1 for name in names}}
    problem = make_problem(replayed(target, truth, fine, noise=1e-4), cfg=cfg).with_physics_dt(0.00025)
    twins = twin_problem(problem, reference_path(problem, problem.space.from_dict(TRUTH)))
    moved = moved_by(twins, problem.space.from_dict(truth))[:, 0].numpy()
    off = np.sqrt(np.mean((moved - replayed(target, truth, fine).dof_pos) ** 2, axis=0))
    assert off[[names.index("LF_HAA"), names.index("LF_HFE")]].max() < 5e-5  # 3e-4 along the wrong knee's motion


SPRUNG = FOUR_BAR.replace('"rocker"', '"rocker" stiffness="0.6" springref="0.3" damping="0.02" armature="0.002"')


RUBBING = FOUR_BAR.replace('"rocker"', '"rocker" frictionloss="0.02"')


LEANING = FINGER.replace('stiffness="0.02"', 'stiffness="0.2"')


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [FOUR_BAR, SPRUNG, RUBBING, LEANING], ids=["four_bar", "sprung", "rubbing", "leaning"]
)
def test_a_crank_feels_what_follows_it(tmp_path, model):
    """Inertia, springs and friction of joints without drives, along the loop that they close.

    What leans on its stop carries its spring there: felt by the crank, it was named as an asymmetry of its friction.
    """
    path = tmp_path / "four_bar.xml"
    path.write_text(model)
    cfg = env_cfg(lambda: cfg_from_model(path))
    cfg.scene.robot.init_state.joint_pos = {"crank": 0.8, "(coupler|rocker)": 0.0}
    truth = {"armature": 0.004, "viscous_friction": 0.05, "friction": 0.04, "encoder_bias": 0.0, "delay": 2.0}
    target = 0.8 + chirp(0.4, 0.5, 4.0, 0.3)
    whole = make_problem(record(target, truth, cfg=cfg), cfg=cfg).with_physics_dt(0.00025)
    assert not whole.joints_stand_alone
    sought = whole.space.from_dict(truth)
    twins = twin_problem(whole, reference_path(whole, sought))
    moved = moved_by(whole, sought)
    assert float((moved_by(twins, sought) - moved).abs().max()) < 1e-3
    other = whole.space.from_dict({**truth, "friction": 0.06})  # beside its reference
    assert float((moved_by(twins, other) - moved_by(whole, other)).abs().max()) < 2e-3


@pytest.mark.slow
def test_effects_of_hinges_are_asked_for_on_a_robot_with_a_slide_too(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body><joint name="a" axis="0 1 0" range="-1 1"/>'
        '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3"/><body pos="0 0 -0.3">'
        '<joint name="b" type="slide" axis="1 0 0" range="-0.1 0.1"/><geom size="0.03" pos="0.05 0 0"/></body></body>'
        '</worldbody><actuator><position joint="a" kp="20" kv="1"/><position joint="b" kp="90" kv="4"/></actuator>'
        "</mujoco>"
    )
    cfg = env_cfg(lambda: cfg_from_model(path))
    cfg.sim2real.slide_joints = ("b",)
    recording = record(chirp(1.0) * np.array([1.0, 0.1]), {**CALM, "armature": 0.02, "friction": 0.1}, cfg=cfg)
    whole = make_problem(recording, cfg=cfg)
    path = reference_path(whole, whole.space.from_dict(CALM), ["com_offset", "payload"])
    assert float(path.model_effects["com_offset", "angle"].torque[..., 0].abs().max()) > 0.1
    assert float(path.model_effects["payload", "ratio"].inertia[..., 1].min()) > 0.01


@pytest.mark.slow
def test_a_spring_at_a_joint_acts_on_it_alone_too(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body>'
        '<joint name="a" axis="0 1 0" range="-1 1" stiffness="6" springref="0.4"/>'
        '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3"/></body></worldbody>'
        '<actuator><position joint="a" kp="20" kv="1"/></actuator></mujoco>'
    )
    cfg = env_cfg(lambda: cfg_from_model(path))
    truth = {"armature": 0.02, "viscous_friction": 0.1, "friction": 0.1, "encoder_bias": 0.0, "delay": 1.0}
    whole = make_problem(record(chirp(0.4, 0.5, 4.0, 0.3), truth, cfg=cfg), cfg=cfg).with_physics_dt(0.00025)
    sought = whole.space.from_dict(truth)
    for path in (reference_path(whole, sought), measured_path(whole, sought)):
        assert float((moved_by(twin_problem(whole, path), sought) - moved_by(whole, sought)).abs().max()) < 5e-4
