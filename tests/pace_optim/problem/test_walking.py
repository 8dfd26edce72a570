"""Recordings of robots whose base moves: the legs of a walking robot are identified while they swing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recordings import conform, recording, says
from walking import DT, crawler, walking_problem, write_log

from pace_envs import ManagerBasedRLEnv, load_env_cfg
from pace_envs.compiler import host
from pace_optim.estimate.derivatives import stencil
from pace_optim.estimate.error_bars.assessment import _LATE, _late_forces
from pace_optim.problem.free_phases import FreePhases, encoder_noise
from pace_optim.problem.moving_base import base_path, imu_pose, joints_of_feet, on_moving_base
from pace_optim.problem.problem import load_problem
from pace_optim.recording.carried import Carried, force_noise, free_phases, part_of_phase
from pace_optim.recording.data import ImuPose
from pace_optim.recording.dataset import make_dataset
from pace_optim.recording.parts import informative_parts


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A trot."""
    return walking_problem(tmp_path_factory.mktemp("walk"), duration=1.6)


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    """Compile at once, however short a recording is."""
    monkeypatch.setattr(host, "_PATIENCE", 0)


def steps_of(problem, x):
    """Where one Gauss-Newton step from x leads, physical (size,)."""
    evaluator, space = problem.training_evaluator(), problem.space
    around = stencil(x, problem.colouring, first=3e-3)
    residuals = evaluator.residuals(space.to_physical(torch.cat([x[None], around.vectors])))
    hessian, gradient = around.jacobian(residuals).normal_equations()
    scale = hessian.diagonal().clamp(min=1e-30).sqrt()
    whole = torch.linalg.pinv(hessian / scale[:, None] / scale, rtol=1e-7, hermitian=True)
    jacobian = around.jacobian(residuals)
    return space.to_physical(x - whole @ (gradient / scale) / scale), residuals, jacobian


@pytest.mark.slow
def test_swinging_legs_have_the_truth_at_the_bottom_of_their_error(walk):
    problem, truth = walk
    found, residuals, jacobian = steps_of(problem, problem.space.to_normalised(truth))
    assert float(residuals.joint_score[0].sqrt().max()) < 2e-4  # of 1e-4 of noise
    for name, within in (("armature", 0.03), ("viscous_friction", 0.05)):
        own = problem.space[name]
        error = (found[own] / truth[own] - 1).abs()
        assert float(error.max()) < 2 * within and float(error.median()) < within, name
    assert float((found - truth)[problem.space["delay"]].abs().max()) * DT < 1e-3
    # error bars know of forces that act later than the rows say: d - kp τ, a - (kd + d) τ, delay + τ
    space, x = problem.space, problem.space.to_normalised(truth)
    late = torch.as_tensor(_late_forces(jacobian, problem.training_evaluator(), x))
    hessian = jacobian.normal_equations()[0] * residuals.where.sum()
    move = torch.linalg.pinv(hessian, rtol=1e-13, hermitian=True) @ late * space.slope(x)
    assert move[space["viscous_friction"]] == pytest.approx(-40 * _LATE, rel=0.02)
    assert move[space["armature"]] == pytest.approx(
        (-(0.5 + truth[space["viscous_friction"]]) * _LATE).numpy(), rel=0.1
    )
    assert float(move[space["delay"]]) == pytest.approx(_LATE / DT, rel=0.02)


def test_without_the_motion_of_the_base_the_error_is_many_times_the_noise(walk):
    problem, truth = walk
    carried = problem.dataset.carried
    still = torch.zeros_like(carried.base)
    still[..., 5] = 9.81
    resting = replace(problem, dataset=replace(problem.dataset, carried=replace(carried, base=still)))
    scores = []
    for each in (problem, resting):
        evaluator = each.evaluator()
        std = carried.start_std[..., 0]
        evaluator.phases = FreePhases(blocks=(), factors=(), noise=std, floor=std)  # errors as they are
        scores.append(float(evaluator.residuals(truth[None]).score[0]))
    assert scores[1] > 100 * scores[0]


def with_backlash(walk):
    """The trot's robot with a gap of 20 mrad in each gear, its encoders on the motors; and its parameters."""
    problem, truth = walk
    problem = problem.with_effects(["backlash"])
    values = {"gap": 0.02, "stiffness": 3000.0, "damping": 2.0, "encoder_side": 1.0}
    return problem, torch.cat([truth, torch.tensor(list(values.values())).double().repeat_interleave(8)])


@pytest.mark.slow
@pytest.mark.parametrize("robot", [lambda walk: walk, with_backlash])
def test_compiled_drives_move_as_the_environment_does(walk, robot, monkeypatch):
    problem, truth = robot(walk)
    problem = problem.on_pieces(0.2)
    shown = []
    for compiled in (True, False):
        rollout = problem.evaluator().rollout(2)
        if not compiled:
            monkeypatch.setattr(rollout._compiled, "positions", lambda *_: None)
        shift, push = torch.zeros(2, 8, 2, dtype=torch.float64), torch.zeros(2, 6, dtype=torch.float64)
        shift[1], push[1] = 0.01, 0.2
        rollout.start(truth.expand(2, -1), problem.dataset.sampled, shift=shift, push=push)
        shown.append(rollout.positions(torch.arange(60)))
    assert float((shown[0] - shown[1]).abs().max()) < 1e-9
    assert rollout.robot.effects == problem.effects
    count = problem.dataset.num_recordings
    assert float((shown[0][:, :count] - shown[0][:, count:]).abs().max()) > 1e-4


def test_a_base_that_rests_moves_joints_as_a_fixed_one_does(walk):
    problem, truth = walk
    carried = problem.dataset.carried
    base = torch.zeros_like(carried.base)
    base[..., 5] = 9.81
    free = torch.ones_like(carried.free)
    resting = replace(carried, base=base, free=free)
    results = []
    for each in (None, resting):
        dataset = replace(problem.dataset, carried=each)
        rollout = replace(problem, dataset=dataset).evaluator().rollout(1)
        rollout.start(truth[None], dataset.sampled)
        results.append(rollout.positions(torch.arange(300)))
    assert float((results[0] - results[1]).abs().max()) < 1e-10


@pytest.mark.parametrize(("robot", "rounding"), [(lambda walk: walk, 0.0), (with_backlash, 1e-15)])
def test_the_encoder_of_a_joint_that_stands_shows_what_it_showed(walk, robot, rounding):
    problem, truth = robot(walk)
    held = ~problem.dataset.carried.free
    rollout = problem.evaluator().rollout(1)
    rollout.start(truth[None], problem.dataset.sampled)
    shown, positions, _ = rollout.motion(len(held))
    error = shown - truth[problem.space["encoder_bias"]] - problem.dataset.measured[: len(held)]
    assert float(error[held].abs().max()) <= rounding
    twist = (shown - positions[..., -8:])[held].abs().max()
    assert (float(twist) > 0.009) == bool(problem.effects)  # links hang in their gaps
    share = (~held).double().mean(dim=0)
    assert bool((share > 0.1).all()) and bool((share < 0.9).all())


@pytest.mark.slow
def test_without_contacts_legs_are_in_the_air_while_their_torques_balance(walk, env):
    logged = walk[0].dataset.recordings[0]
    found = on_moving_base(replace(logged, contact=None, feet=()), env)
    assert "no contact is logged: a leg counts while its drives' torques balance" in found.notes[-1]
    for leg in range(4):
        free, wanted = found.free[:, 2 * leg], logged.free[:, 2 * leg]
        assert free.mean() == pytest.approx(wanted.mean(), rel=0.1)
        assert not (free & logged.contact[:, leg]).any()


@pytest.mark.slow
def test_legs_in_ropes_are_in_the_air_throughout(tmp_path):
    problem, _ = walking_problem(tmp_path, crawler(2, feet={}, swing=2.0), duration=0.8)
    assert bool(problem.dataset.carried.free[1:].all())
    assert any("all of the recording counts" in note for note in problem.dataset.recordings[0].notes)


def test_error_bars_know_of_an_imu_that_is_late(walk):
    problem, truth = walk
    carried, phases = problem.dataset.carried, problem.evaluator().free_phases(truth)
    late = torch.cat([carried.base[:1], carried.base[:-1]])
    raw = []
    for base in (carried.base, late):
        own = replace(carried, base=base)
        evaluator = replace(problem, dataset=replace(problem.dataset, carried=own)).evaluator()
        std = carried.start_std[..., 0]
        evaluator.phases = FreePhases(blocks=(), factors=(), noise=std, floor=std)
        raw.append(evaluator.residuals(truth[None]))
    change, step = (raw[1].error - raw[0].error)[0], raw[0].step
    square = np.zeros(2)
    for i, (block, factor) in enumerate(zip(phases.blocks, phases.factors, strict=True)):
        rows = (step >= block.first) & (step < block.end)
        if int(rows.sum()) < block.end - block.first:
            continue
        error = (change[rows, block.recording][:, block.joints] / phases.noise[block.recording, block.joints]).flatten()
        square += [
            float(error @ torch.linalg.solve(covariance, error))
            for covariance in (factor @ factor.T, phases.expected(i))
        ]
    assert 0 < square[1] < square[0] / 5


def test_a_swing_that_something_disturbs_hardly_counts(walk):
    problem, truth = walk
    phases = problem.evaluator().free_phases(truth)
    block = next(i for i, each in enumerate(phases.blocks) if each.first == each.begin + 1)
    own = phases.blocks[block]
    measured = problem.dataset.measured.clone()
    measured[own.first : own.end, 0, own.joints] += 0.02 * torch.linspace(0, 1, own.end - own.first)[:, None].sin()
    touched = replace(problem, dataset=replace(problem.dataset, measured=measured)).evaluator().free_phases(truth)
    wider = [float(b.square().sum() / a.square().sum()) for a, b in zip(phases.factors, touched.factors, strict=True)]
    assert wider[block] > 100 and max(w for i, w in enumerate(wider) if i != block) < 3


def test_the_noise_of_encoders_is_that_of_free_joints(walk):
    problem, _ = walk
    carried = problem.dataset.carried
    error = 2e-4 * torch.randn(carried.free.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    error[~carried.free] *= 100
    assert encoder_noise(carried, error) == pytest.approx(torch.full_like(carried.start_std[..., 0], 2e-4), rel=0.2)


def test_chatter_is_no_swing_and_a_swing_keeps_a_margin():
    standing = np.ones(400, dtype=bool)
    standing[100:200] = False
    standing[210:214] = standing[216:217] = False
    free = free_phases(standing, DT)  # 30 ms after lift-off, 10 ms before touch-down
    assert np.flatnonzero(free).tolist() == list(range(112, 196))
    standing[150] = True  # one sample of contact cuts it
    assert not free_phases(standing, DT)[146:163].any()
    part = part_of_phase(free)
    assert (
        part[112] == pytest.approx(0.5 / 84)
        and part[195] == pytest.approx(83.5 / 84)
        and np.isnan(part[[111, 196]]).all()
    )


def test_what_happens_between_samples_is_noise_of_the_accelerometer():
    rng = np.random.default_rng(0)
    time = np.arange(2000) * DT
    smooth = np.stack([np.sin(20 * time)] * 3, axis=1)
    noisy = smooth + 0.05 * rng.standard_normal(smooth.shape)
    assert np.median(force_noise(noisy, DT)) == pytest.approx(0.05, rel=0.1)
    noisy[1000:1004] += 5 * rng.standard_normal((4, 3))
    assert force_noise(noisy, DT)[1000].min() > 0.3


def test_the_frame_turns_by_the_slope_of_the_gyroscope():
    base = torch.zeros(3, 1, 6, dtype=torch.float64)
    base[:, 0, 0], base[:, 0, 5] = torch.tensor([0.0, 1.0, 1.0]), torch.tensor([9.0, 10.0, 11.0])
    empty = torch.zeros(3, 1, 1, dtype=torch.float64)
    carried = Carried(
        base=base, point=empty[0], measured=empty[..., None], free=empty > 0, start_std=empty, force_std=empty
    )
    motion = carried.motion(2, 0.5)
    assert motion[0, :, 0, 0].tolist() == [0.25, 0.75] and motion[0, :, 0, 3].tolist() == [2.0, 2.0]
    assert motion[0, :, 0, 8].tolist() == [9.25, 9.75] and motion[2, :, 0, 3].tolist() == [0.0, 0.0]
    # drives that hold their torques for a control step: the force of a sample is that of the step before it
    held = carried.motion(2, 0.5, 0.5)
    assert held[0, :, 0, 8].tolist() == [9.75, 10.25] and held[..., :6].equal(motion[..., :6])


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    write_log(folder, crawler(), 0.1)
    cfg = load_env_cfg(str(folder / "robot.xml"), DT)
    return ManagerBasedRLEnv(cfg)


@pytest.mark.parametrize("foot", ["fl_foot", "fl_shank", "fl", "FL"])
def test_a_foot_is_a_geom_a_body_or_a_leg(env, foot):
    assert joints_of_feet(env, [foot, "rr"], "walk") == [[0, 1], [6, 7]]


def test_an_unknown_foot_and_a_wrong_imu_are_refused(env):
    model = env.sim.model
    with pytest.raises(ValueError, match=says("feet names 'fl_hoof'", "fl_shank", "Correct the name")):
        joints_of_feet(env, ["fl_hoof"], "walk")
    with pytest.raises(ValueError, match=says("no site 'gyro'", "it has imu", "fact imu")):
        imu_pose(model, ImuPose(site="gyro"), "walk")
    with pytest.raises(ValueError, match=says("on 'fl_thigh'", "joints move")):
        imu_pose(model, ImuPose(body="fl_thigh"), "walk")
    axes, point = imu_pose(model, ImuPose(body="trunk", pos=(0.1, 0, 0), quat=(0, 0, 0, 1)), "walk")
    site, at = imu_pose(model, ImuPose(), "walk")
    assert axes == pytest.approx(site @ np.diag([-1, -1, 1])) and point - at == pytest.approx([0.05, -0.01, -0.02])


def test_of_minutes_of_walking_the_parts_that_swing_most_are_used():
    steps = 40 * 400
    time = DT * np.arange(steps)
    free = np.zeros((steps, 3), dtype=bool)
    free[4000:6000] = free[10000:12000] = True
    frame = np.tile([0, 0, 0, 0, 0, 9.81], (steps, 1))
    walk = conform(recording(time))
    walk = replace(walk, frame=frame, frame_point=np.zeros(3), free=free, command=walk.dof_pos)
    parts = informative_parts(walk, 10.0)
    assert [part.name for part in parts] == ["leg 10 to 15 s", "leg 25 to 30 s"]
    assert "10 s that move the joints most are used (25 %)" in parts[0].notes[-1]
    assert parts[0].free.all() and len(parts[0].frame) == len(parts[0].command) == 2000


def test_a_base_turns_with_its_gyroscope_and_goes_where_its_feet_push_it(env):
    steps, joints = 400, env.scene["robot"].joint_names
    lean = np.linspace(0, 0.3, steps)
    walk = recording(
        DT * np.arange(steps),
        joint_names=joints,
        dof_pos=np.stack([lean if joint.endswith("hip") else 0 * lean for joint in joints], axis=1),
        contact=np.ones((steps, 4), dtype=bool),
        feet=("fl", "fr", "rl", "rr"),
        frame=np.stack([0 * lean, 0 * lean, 1.0 + 1e-9 * lean, 0 * lean, 0 * lean, 9.81 + 0 * lean], axis=1),
        frame_point=np.zeros(3),
    )
    path = base_path(walk, env.sim.model, joints)
    assert path.feet[0] == ("fl_shank", pytest.approx([0, 0, -0.16]))
    assert 2 * np.arctan2(path.pose[:, 6], path.pose[:, 3]) == pytest.approx(DT * np.arange(steps), abs=1e-6)
    straight = base_path(replace(walk, frame=walk.frame * [1, 1, 1e-9, 1, 1, 1]), env.sim.model, joints)
    assert straight.pose[-1, 0] == pytest.approx(0.32 * np.sin(0.3), abs=1e-6)  # legs of 0.32 m lean back
    assert np.ptp(straight.pose[:, 2]) == pytest.approx(0.32 * (1 - np.cos(0.3)), abs=1e-6)
    assert base_path(replace(walk, frame=walk.frame[:1].repeat(steps, axis=0)), env.sim.model, joints) is None


def test_a_registered_robot_that_walks_is_simulated_with_finer_steps(tmp_path):
    steps = 200
    names = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
    position = np.tile([0.0, 0.8, -1.5], (steps, 4)) + 0.1 * np.sin(np.arange(steps) / 20)[:, None]
    fields = {"time": DT * np.arange(steps), "dof_pos": position, "des_dof_pos": position, "joint_names": names}
    used = []
    for shake in (0.0, 1.0):
        base = {"base_ang_vel": shake * position[:, :3], "base_lin_acc": np.tile([0, 0, 9.81], (steps, 1))}
        np.savez(tmp_path / "walk.npz", **fields, **base)
        problem = load_problem("Pace-Go2-v0", data=[tmp_path / "walk.npz"], tell=lambda _: None)
        used.append((problem.physics_dt, problem.env_cfg.sim.integrator))
    assert used == [(DT, "implicitfast"), (DT / 4, "leapfrog")]


@pytest.mark.slow
def test_a_leg_that_stands_throughout_is_named(tmp_path):
    always = crawler(1).simulate(1.0)["contact"]
    always[:, 3] = True
    problem, _ = walking_problem(tmp_path, duration=1.0, contact=always)
    assert any("rr_hip, rr_knee: always held by the ground" in note for note in problem.dataset.recordings[0].notes)


@pytest.mark.slow
def test_legs_on_which_no_foot_is_named_are(tmp_path):
    simulated = crawler(1).simulate(1.0)
    problem, _ = walking_problem(
        tmp_path, duration=1.0, contact=simulated["contact"][:, :3], feet=simulated["feet"][:3]
    )
    assert any("No foot is on the legs or arms of rr_hip" in note for note in problem.dataset.recordings[0].notes)


@pytest.mark.parametrize(("duration", "turns"), [(1.0, 1), (12.0, 3)])
def test_a_walk_is_trained_and_validated_on_in_turns(duration, turns):
    walk = conform(recording(DT * np.arange(round(duration / DT))))
    frame = np.tile([0, 0, 0, 0, 0, 9.81], (walk.num_samples, 1))
    walk = replace(walk, frame=frame, frame_point=np.zeros(3), command=walk.dof_pos)
    data = make_dataset([walk])
    assert int((data.train[1:, 0] > data.train[:-1, 0]).sum()) == turns - 1
    assert float(data.train.double().mean()) == pytest.approx(0.7, abs=0.01)
    assert bool(data.validation.any()) and not bool((data.validation & data.train).any())


def test_of_a_leg_that_seldom_swings_swings_are_held_out():
    """All of a front leg's swings were trained on, and 1 rad stood for its held-out error."""
    walk = conform(recording(DT * np.arange(round(12.0 / DT))))
    free = np.zeros((walk.num_samples, walk.num_joints), dtype=bool)
    free[:, 1:] = True
    for begin in (1.0, 5.3, 9.2):  # none in the last 1.2 s of 4 s
        free[(walk.time > begin) & (walk.time < begin + 0.3), 0] = True
    frame = np.tile([0, 0, 0, 0, 0, 9.81], (walk.num_samples, 1))
    walk = replace(walk, frame=frame, frame_point=np.zeros(3), command=walk.dof_pos, free=free)
    data = make_dataset([walk])
    part = float(free[data.train[:, 0].numpy(), 0].sum() / free[:, 0].sum())
    assert float(data.train.double().mean()) == pytest.approx(0.7, abs=0.01)
    assert 0.5 < part < 0.9
