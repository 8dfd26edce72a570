"""Replaying recordings: the truth leaves nothing, each recording meets its own facts, candidates stay apart."""

import dataclasses
import gc
import tracemalloc

import numpy as np
import pytest
import torch
from problems import (
    DT,
    TRUTH,
    chirp,
    env_cfg,
    legs_chirp,
    make_problem,
    pendulums_cfg,
    pendulums_target,
    physical,
)
from problems import PENDULUMS_TRUTH as TWO
from problems import record as recorded

from pace_envs import set_physics_dt
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.problem import evaluator
from pace_optim.problem.rollout import Rollout
from pace_optim.recording import Drive, Load
from pace_optim.recording.time_base import interpolate_smooth
from pace_optim.recording.windows import Windows

EXACT = 1e-12  # [rad²]
ANYMAL_TRUTH = {"armature": 0.1, "viscous_friction": 4.5, "friction": 0.05, "encoder_bias": 0.05}


def record(target=None, *facts, **more):
    """Half a second where no motion is given."""
    return recorded(chirp(0.5) if target is None else target, *facts, **more)


def scores(problem, *truths, where=None):
    vectors = torch.stack([physical(problem, truth) for truth in truths])
    return problem.evaluator().residuals(vectors, where).score


def test_candidates_that_are_simulated_in_parts_keep_their_own_priors(monkeypatch):
    problem = make_problem(record())
    problem.space.prior[:] = 0.5
    candidates = torch.stack(
        [physical(problem), *problem.space.to_physical(torch.eye(problem.space.size))[:2].double()]
    )
    whole = problem.evaluator().residuals(candidates)
    monkeypatch.setattr(evaluator, "_WIDEST", 2)
    parts = problem.evaluator().residuals(candidates)
    assert torch.equal(parts.prior.x, whole.prior.x)
    assert torch.allclose(parts.score, whole.score, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("delay_mode", ["command", "effort"])
@pytest.mark.parametrize("delay", [0.0, 1.0, 1.37])
def test_the_truth_replays_exactly_on_the_bench(delay_mode, delay):
    truth = {**TRUTH, "delay": delay}
    problem = make_problem(record(truth=truth, delay_mode=delay_mode), delay_mode=delay_mode)
    assert scores(problem, truth) <= EXACT
    assert scores(problem, {**truth, "delay": delay + 0.1}) > 1e-9


@pytest.mark.parametrize("delay_mode", ["command", "effort"])
@pytest.mark.parametrize("delay", [5.0, 2.63])
def test_the_truth_replays_exactly_with_the_joints_in_another_order_than_the_models(delay_mode, delay):
    shuffled = [7, 2, 11, 0, 5, 9, 1, 10, 4, 3, 8, 6]
    names = env_cfg("Pace-AnymalD-v0").sim2real.joint_order
    each = {key: {name: value * (1 + 0.05 * i) for i, name in enumerate(names)} for key, value in ANYMAL_TRUTH.items()}
    truth = {**each, "delay": delay}
    cfg = env_cfg("Pace-AnymalD-v0")
    recording = record(legs_chirp(cfg, 0.5), truth, cfg=cfg, delay_mode=delay_mode)
    columns = {key: getattr(recording, key)[:, shuffled] for key in ("dof_pos", "des_dof_pos")}
    recording = dataclasses.replace(recording, joint_names=tuple(names[i] for i in shuffled), **columns)
    problem = make_problem(recording, cfg=cfg, delay_mode=delay_mode)
    assert problem.joint_names == names
    assert scores(problem, truth) <= EXACT


def test_the_truth_replays_exactly_when_the_robots_own_order_is_not_the_models(tmp_path):
    cfg = pendulums_cfg(tmp_path)
    swapped = dataclasses.replace(cfg.sim2real, joint_order=("right", "left"))
    turned = dataclasses.replace(cfg, sim2real=swapped)
    recording = record(pendulums_target(0.5), TWO, cfg=cfg)  # columns left, right
    problem = make_problem(recording, cfg=turned)
    assert problem.joint_names == ("right", "left")
    assert scores(problem, TWO) <= EXACT


@pytest.mark.slow
def test_a_finer_physics_step_replays_exactly_and_differs_from_the_coarse_one():
    fine = env_cfg()
    set_physics_dt(fine, DT / 5)
    recording = record(cfg=fine)
    assert scores(make_problem(recording, cfg=fine), TRUTH) <= EXACT
    assert scores(make_problem(recording), TRUTH) > 1e-10


def unlike_recordings():
    """Different gains, limits, loads, lengths, and drives that are off for a while."""
    off = np.ones(301, dtype=bool)
    off[100:180] = False
    return [
        record(name="plain"),
        record(chirp(0.6), name="soft", drive={"stiffness": 30.0, "damping": 1.0}),
        record(name="weak", drive={"effort_limit": 6.0, "velocity_limit": 4.0, "saturation_effort": 20.0}),
        record(name="heavy", load=Load(load_mass=2.0, load_length=0.15, arm_mass=0.3)),
        record(name="added", load=Load(added_mass={"load": 0.7})),
        record(chirp(0.75), name="off", torque_enable=off),
    ]


@pytest.mark.slow
def test_each_recording_is_simulated_with_its_own_facts(monkeypatch):
    # drives that pay to be compiled round the last digit otherwise, and here only some do
    monkeypatch.setattr("pace_envs.compiled_drive.robot_kernel.CompiledRobot.positions", lambda *_: None)
    recordings = unlike_recordings()
    problem = make_problem(recordings)
    other = {**TRUTH, "armature": 0.15, "friction": 0.1}
    every = problem.evaluator().residuals(torch.stack([physical(problem), physical(problem, other)]))
    assert float(every.score[0]) <= EXACT
    for r, recording in enumerate(recordings):
        alone = make_problem(recording)
        error = alone.evaluator().residuals(physical(alone, other)[None]).error[0, :, 0]
        assert float(error.abs().max()) > 1e-4
        assert torch.equal(every.error[1, : len(error), r], error)
        assert not every.error[1, len(error) :, r].any()  # padding counts for nothing


def test_an_infinite_stall_torque_is_no_torque_speed_line_whatever_no_load_speed_is_configured():
    """Above the configured no-load speed the motor braked with all that it had."""
    fast, slow = {"velocity_limit": np.inf}, {"velocity_limit": 1.0}
    drives = [{"saturation_effort": np.inf, "effort_limit": 200.0, **speed} for speed in (fast, slow)]
    target = chirp(amplitude=1.0)
    errors = [
        make_problem(dataclasses.replace(record(target), drive=Drive(**{k: np.array([v]) for k, v in drive.items()})))
        for drive in drives
    ]
    first, second = (problem.evaluator().residuals(physical(problem)[None]).error for problem in errors)
    assert torch.equal(first, second)


def test_facts_are_not_left_over_from_one_recording_to_the_next_rollout():
    problem = make_problem(unlike_recordings())
    evaluator = problem.evaluator()
    first = evaluator.residuals(physical(problem)[None]).error
    evaluator.residuals(physical(problem, {**TRUTH, "delay": 7.0, "encoder_bias": -0.05})[None])
    assert torch.equal(evaluator.residuals(physical(problem)[None]).error, first)


@pytest.mark.parametrize(
    "fact",
    [
        {"drive": {"stiffness": 60.0}},
        {"drive": {"damping": 2.0}},
        {"drive": {"effort_limit": 6.0}},
        {"load": Load(load_mass=1.5)},
        {"load": Load(added_mass={"load": 0.5})},
    ],
)
def test_a_fact_that_is_not_told_leaves_an_error(fact):
    recording = record(**fact)
    untold = dataclasses.replace(recording, drive=record().drive, load=Load())
    assert scores(make_problem(recording), TRUTH) <= EXACT
    assert scores(make_problem(untold), TRUTH) > 1e-8


def test_weights_of_each_candidate_sum_to_one_over_its_training_samples():
    problem = make_problem([record(), record(chirp(0.6))], train_fraction=0.7)
    rollout = problem.evaluator().rollout(3)
    total = torch.zeros(6, 1, dtype=torch.float64)
    rollout.start(physical(problem).repeat(3, 1))
    for _ in rollout:
        total += rollout.weight
    per_candidate = total.view(3, 2).sum(dim=1)
    assert torch.allclose(per_candidate, torch.ones(3, dtype=torch.float64), rtol=1e-12)
    samples = problem.dataset.train.sum(dim=0).double()
    assert torch.allclose(total.view(3, 2)[0], samples / samples.sum(), rtol=1e-12)


def test_nothing_after_the_last_training_sample_is_simulated_or_scored():
    problem = make_problem(record(), train_fraction=0.5)
    rollout = problem.evaluator().rollout(1)
    rollout.start(physical(problem)[None])
    assert sum(1 for _ in rollout) == round(0.5 * 201)
    assert rollout.simulated_steps == round(0.5 * 201) - 1
    moved = dataclasses.replace(record(), dof_pos=record().dof_pos + np.where(np.arange(201) < 125, 0, 0.3)[:, None])
    assert scores(make_problem(moved, train_fraction=0.5), TRUTH) <= EXACT


def test_candidates_do_not_influence_each_other():
    problem = make_problem([record(), record(chirp(0.6), drive={"stiffness": 30.0})])
    evaluator = problem.evaluator()
    generator = torch.Generator().manual_seed(1)
    x = 2 * torch.rand(7, problem.space.size, generator=generator, dtype=torch.float64) - 1
    together = evaluator.residuals(problem.space.to_physical(x))
    for i in (0, 3, 6):
        alone = evaluator.residuals(problem.space.to_physical(x[i : i + 1]))
        assert torch.equal(together.error[i], alone.error[0])
    swapped = evaluator.residuals(problem.space.to_physical(x.flip(0)))
    assert torch.equal(swapped.error.flip(0), together.error)


def test_a_diverging_candidate_leaves_the_others_as_they_were():
    cfg = env_cfg()
    cfg.sim2real.set_bounds("encoder_bias", 0.0, 0.0)
    problem = make_problem(record(truth={**TRUTH, "encoder_bias": 0.0}), cfg=cfg)
    evaluator = problem.evaluator()
    good = physical(problem, {**TRUTH, "encoder_bias": 0.0})
    bad = good.clone()
    bad[problem.space["encoder_bias"]] = torch.nan
    result = evaluator.residuals(torch.stack([bad, good]))
    assert result.score[0] == torch.inf and float(result.score[1]) <= EXACT
    again = evaluator.residuals(torch.stack([good, good])).score  # the same environment, after the divergence
    assert float(again.max()) <= EXACT


@pytest.mark.slow
def test_several_drive_groups_replay_as_one():
    cfg = env_cfg("Pace-AnymalD-v0")
    (drive,) = cfg.scene.robot.actuators.values()
    truth = {**ANYMAL_TRUTH, "delay": 3.3}
    recording = record(legs_chirp(cfg, 0.5), truth, cfg=cfg)
    cfg.scene.robot.actuators = {
        "knees": dataclasses.replace(drive, joint_names_expr=".*KFE"),
        "hips": dataclasses.replace(drive, joint_names_expr=".*(HAA|HFE)"),
    }
    assert scores(make_problem(recording, cfg=cfg), truth) <= EXACT


def test_a_recording_sampled_slower_than_the_control_is_compared_at_its_samples():
    full = record(np.repeat(chirp()[::4], 4, axis=0)[:201])  # targets held for four control steps
    slow = dataclasses.replace(full, **{key: getattr(full, key)[::4] for key in ("time", "dof_pos", "des_dof_pos")})
    problem = make_problem(slow)
    assert int(problem.dataset.sampled.sum()) == 51
    assert scores(problem, TRUTH) <= EXACT


@pytest.mark.slow
def test_a_search_stores_nothing_of_the_size_of_population_times_time():
    problem = make_problem(record(chirp(2.0)))
    population, steps = 64, 801
    rollout = problem.evaluator().rollout(population)
    optimizer = CMAESOptimizer(problem.space, population, CMAESOptimizerCfg())
    whole = population * steps * 8  # one float64 per candidate, step and joint [bytes]

    def generation():
        optimizer.ask()
        optimizer.update_simulator(rollout)
        for sim_dof_pos, real_dof_pos in rollout:
            optimizer.tell(sim_dof_pos, real_dof_pos)
        arrays = tracemalloc.get_traced_memory()[1]  # at the last sample, while everything is still at hand
        tensors = tensor_bytes()
        optimizer.evolve()
        return arrays, tensors

    generation()
    before = tensor_bytes()
    tracemalloc.start()
    arrays, tensors = generation()
    tracemalloc.stop()
    assert arrays < whole / 2
    assert tensors - before < whole / 2


def tensor_bytes():
    """Memory of all tensors that are alive."""
    gc.collect()  # what waits for collection, in this test or from one before it, is not
    tensors = [thing for thing in gc.get_objects() if type(thing) in (torch.Tensor, torch.nn.Parameter)]
    return sum({t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}.values())


def test_pairs_that_are_simulated_at_once_are_those_of_stepping():
    problem = make_problem(record())
    rollout = problem.evaluator().rollout(2)
    pairs = []
    for way in (rollout.__iter__, rollout.at_once):
        rollout.start(torch.stack([physical(problem, {**TRUTH, "delay": delay}) for delay in (1.0, 1.37)]))
        pairs.append([torch.stack([each.clone() for each in both]) for both in way()])
    assert len(pairs[0]) > 100
    torch.testing.assert_close(*map(torch.stack, pairs), rtol=0, atol=1e-14)


def test_the_number_of_environments_must_be_a_multiple_of_the_recordings():
    problem = make_problem([record(), record(chirp(0.6))])
    env = problem.make_env(5)
    with pytest.raises(
        ValueError, match=r"num_envs is 5, expected a multiple of the number of recordings \(2\): try 4"
    ):
        Rollout(env, problem.dataset, problem.space)
    env.close()


def test_speeds_are_at_hand_while_a_rollout_runs():
    problem = make_problem(record())
    rollout = problem.evaluator().rollout(2)
    rollout.start(physical(problem).repeat(2, 1))
    simulated, measured = [], []
    for _ in rollout:
        simulated.append(rollout.sim_dof_vel.clone())
        measured.append(rollout.real_dof_vel.clone())
    simulated, measured = torch.stack(simulated), torch.stack(measured)
    assert simulated.shape == measured.shape == (201, 2, 1)
    between = (simulated[1:] + simulated[:-1]) / 2  # the engine's speed is a backward difference
    largest = float(measured.abs().max())
    assert largest > 4 and float((between - measured[:-1])[5:-5].abs().max()) < 0.02 * largest


def test_samples_beside_the_grid_are_met_at_their_own_instants():
    """A timer that is 0.4 % late: the truth's own motion, read between its steps, leaves next to nothing."""
    whole = record(truth=TRUTH)
    time = np.arange(int(whole.duration / 0.0201)) * 0.0201
    cubic = interpolate_smooth(whole.time, whole.dof_pos, time)
    problem = make_problem(dataclasses.replace(whole, time=time, dof_pos=cubic, des_dof_pos=whole.des_dof_pos,
                                               des_time=whole.time, dof_vel=None))  # fmt: skip
    assert problem.dataset.sample_offset.abs().max() > 0.4 and len(time) == int(problem.dataset.sampled.sum())
    assert scores(problem, TRUTH, where=problem.dataset.sampled).sqrt() < 2e-5
    windows = Windows.of(problem.dataset, DT)
    cut = dataclasses.replace(problem, dataset=windows.cut(problem.dataset))
    assert scores(cut, TRUTH, where=windows.mask(problem.dataset.sampled)).sqrt() < 1e-3
