"""PACE's search: recovery, trees, the best of the run, checkpoints, objectives of a user's own."""

import mujoco
import numpy as np
import pytest
import torch
from problems import (
    PENDULUMS_TRUTH,
    TRUTH,
    chirp,
    make_problem,
    normalised,
    pendulums_cfg,
    pendulums_target,
    range_error,
    record,
)

from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.estimate.convergence import TargetScore
from pace_optim.estimate.search import search
from pace_optim.estimate.tree_strategy import DIVERGED_SCORE


@pytest.fixture(scope="module")
def bench():
    return make_problem(record(chirp(0.25, 2.0, 8.0)))


@pytest.fixture(scope="module")
def longer():
    return make_problem(record(chirp(0.6)))


def two_trees(folder, duration):
    cfg = pendulums_cfg(folder)
    return make_problem(record(pendulums_target(duration), PENDULUMS_TRUTH, cfg=cfg), cfg=cfg)


@pytest.fixture(scope="module")
def pendulums(tmp_path_factory):
    """Too short to identify much by."""
    return two_trees(tmp_path_factory.mktemp("model"), 0.2)


@pytest.fixture(scope="module")
def swinging(tmp_path_factory):
    """Long enough."""
    return two_trees(tmp_path_factory.mktemp("model"), 0.5)


def run(problem, population=16, generations=60, *, kind=CMAESOptimizer, after=None, epsilon=None, **options):
    cfg = CMAESOptimizerCfg(max_iteration=generations, epsilon=epsilon, **options.pop("cfg", {}))
    optimizer = kind(problem.space, population, cfg, **{"seed": 1, **options})
    search(optimizer, problem.evaluator().rollout(population), after)
    return optimizer


def rolled(problem, x):
    return float(problem.evaluator().residuals(problem.space.to_physical(x[None])).score)


# ---------------------------------------------------------------- recovery


@pytest.mark.slow
@pytest.mark.parametrize("delay_mode", ["command", "effort"])
def test_the_truth_is_found_on_the_bench(delay_mode):
    truth = {**TRUTH, "delay": 1.4}
    problem = make_problem(record(chirp(0.25, 2.0, 8.0), truth, delay_mode=delay_mode), delay_mode=delay_mode)
    optimizer = run(problem, generations=100, criteria=[TargetScore(1e-10)])
    assert optimizer.best_score <= 1e-10
    assert range_error(problem, optimizer.best, truth) < 0.01


@pytest.mark.slow
def test_several_recordings_are_searched_together():
    problem = make_problem([record(chirp(0.3)), record(chirp(0.3), drive={"stiffness": 40.0})])
    optimizer = run(problem, generations=100, criteria=[TargetScore(1e-9)])
    assert optimizer.stop_reasons == ["score below 1e-09"]
    assert range_error(problem, optimizer.best) < 0.02


def test_the_search_starts_at_the_centre_with_sigma_and_stays_in_the_bounds(bench):
    optimizer = CMAESOptimizer(bench.space, 400, CMAESOptimizerCfg(sigma=0.3), seed=0)
    optimizer.ask()
    x = optimizer.normalised
    assert float(x.abs().max()) <= 1.0
    assert float(x.mean(dim=0).abs().max()) < 0.1
    assert x.std(dim=0).tolist() == pytest.approx([0.3] * 5, rel=0.2)
    assert torch.allclose(bench.space.to_physical(x), optimizer.candidates)
    wide = CMAESOptimizer(bench.space, 400, CMAESOptimizerCfg(sigma=3.0), seed=0)
    wide.ask()
    assert float(wide.normalised.abs().max()) <= 1.0


def test_slices_are_those_of_paces_tutorial(bench):
    optimizer = CMAESOptimizer(bench.space, 4, CMAESOptimizerCfg())
    indices = [optimizer.armature_idx, optimizer.damping_idx, optimizer.friction_idx, optimizer.bias_idx]
    assert indices == [slice(i, i + 1) for i in range(4)] and optimizer.delay_idx == slice(4, 5)


# ---------------------------------------------------------------- one strategy per tree


class Watching(CMAESOptimizer):
    """Keeps the delays that the drives got, (population, joints) of each generation."""

    def update_simulator(self, rollout):
        super().update_simulator(rollout)
        (drive,) = rollout.robot.actuators.values()
        lags = drive.time_lags
        self.delays = [*getattr(self, "delays", []), lags if lags.ndim == 2 else lags[:, None].expand(-1, 2)]


@pytest.fixture(scope="module")
def apart(swinging):
    """A search of one strategy per tree."""
    return run(swinging, generations=60, trees=swinging.trees, kind=Watching)


@pytest.mark.slow
def test_one_strategy_per_tree_is_better_than_a_joint_one_of_the_same_cost(swinging, apart):
    together = run(swinging, generations=60)
    assert [len(s.entries) for s in apart.strategies] == [5, 5] and len(together.strategies) == 1
    assert apart.best_score <= together.best_score
    assert rolled(swinging, apart.best) <= rolled(swinging, together.best)
    assert range_error(swinging, apart.best, PENDULUMS_TRUTH) < 0.1


def test_the_delay_ends_as_one_value_of_all_trees(swinging, apart):
    optimizer = apart
    assert 0 <= optimizer.line_generation < 60
    delays = {float(s.best_x[s.entries.tolist().index(8)]) for s in optimizer.strategies}
    assert len(delays) == 1 and float(optimizer.best[8]) in delays
    assert rolled(swinging, optimizer.best) == pytest.approx(optimizer.best_score, rel=1e-9)
    truth = float(normalised(swinging, PENDULUMS_TRUTH)[8])
    assert float(optimizer.best[8]) == pytest.approx(truth, abs=0.05)


def test_all_candidates_have_one_delay_once_the_trees_agree(apart):
    line, delays = apart.line_generation, apart.delays
    assert 0 < line < 60 == len(delays)
    assert any(not torch.equal(lags[:, 0], lags[:, 1]) for lags in delays[:line])  # each tree has its own
    assert all(torch.equal(lags[:, 0], lags[:, 1]) for lags in delays[line:])
    assert all(float(lags.max() - lags.min()) == 0 for lags in delays[line + 1 :])


def test_trees_do_not_see_each_others_scores(pendulums):
    """A strategy's candidates are the same whatever the other tree's scores are."""
    asked = []
    for factor in (1.0, 1e-3):
        optimizer = CMAESOptimizer(pendulums.space, 8, CMAESOptimizerCfg(max_iteration=99), trees=pendulums.trees)
        scores = np.random.default_rng(0).random((5, 8, 2))
        scores[:, :, 1] = (scores[:, :, 1] + factor) ** 2
        optimizer.restore(list(scores))
        optimizer.ask()
        asked.append(optimizer.normalised[:, [0, 2, 4, 6]])
    assert torch.equal(*asked)


def test_a_joint_strategy_stays_available(pendulums):
    cfg = CMAESOptimizerCfg(per_tree=False)
    assert len(CMAESOptimizer(pendulums.space, 8, cfg, trees=pendulums.trees).strategies) == 1


# ---------------------------------------------------------------- the best of the run


@pytest.fixture(scope="module", params=[False, True], ids=["together", "apart"])
def unbroken(request, pendulums):
    """A search of 20 generations, of all joints together or of each tree."""
    trees = pendulums.trees if request.param else None
    return trees, run(pendulums, 8, 20, trees=trees)


def test_the_best_is_never_worse_than_any_score_that_was_told(unbroken):
    split, optimizer = unbroken
    told = np.stack(optimizer.history)
    first = optimizer.line_generation if split else 0
    assert optimizer.best_score <= told[first:].sum(axis=2).min()
    for g, strategy in enumerate(optimizer.strategies):
        if not split:
            assert strategy.best_score == told[:, :, g].min()


def test_the_best_of_an_early_generation_is_kept(bench):
    optimizer = CMAESOptimizer(bench.space, 4, CMAESOptimizerCfg())
    rollout = bench.evaluator().rollout(4)
    for generation in range(3):
        optimizer.ask()
        optimizer.update_simulator(rollout)
        optimizer.scores_buffer[:] = 0.5 + generation
        if generation == 0:
            optimizer.scores_buffer[2] = 0.125
            first = optimizer.normalised[2].clone()
        optimizer.evolve()
    assert optimizer.best_score == 0.125 and torch.equal(optimizer.best, first)
    assert optimizer.best_scores == [0.125] * 3


def test_the_best_rolled_again_gives_the_score_that_was_told(bench):
    optimizer = run(bench, generations=15)
    assert rolled(bench, optimizer.best) == pytest.approx(optimizer.best_score, rel=1e-9)


def test_a_diverging_candidate_gets_the_worst_score_and_the_search_goes_on(bench):
    optimizer = CMAESOptimizer(bench.space, 4, CMAESOptimizerCfg())
    optimizer.ask()
    optimizer.update_simulator(bench.evaluator().rollout(4))
    optimizer.scores_buffer[:, 0] = torch.tensor([torch.nan, torch.inf, 1e30, 0.5])
    optimizer.evolve()
    assert optimizer.generation_scores[:, 0].tolist() == [DIVERGED_SCORE] * 3 + [0.5]
    assert optimizer.best_score == 0.5
    assert bool(optimizer.ask().isfinite().all())


# ---------------------------------------------------------------- checkpoints


@pytest.mark.parametrize("stop_at", [1, 11, 18])
def test_a_restored_search_continues_bit_for_bit(pendulums, unbroken, stop_at):
    trees, whole = unbroken
    half = run(pendulums, 8, 20, trees=trees, after=lambda o: o.generation == stop_at and o.stop("interrupted"))
    assert half.generation == stop_at
    fresh = CMAESOptimizer(pendulums.space, 8, CMAESOptimizerCfg(max_iteration=20, epsilon=None), seed=1, trees=trees)
    fresh.restore(half.history, half.line_generation)
    assert fresh.generation == stop_at and fresh.best_scores == half.best_scores
    search(fresh, pendulums.evaluator().rollout(8))
    assert np.array_equal(np.stack(fresh.history), np.stack(whole.history))
    assert torch.equal(fresh.best, whole.best) and torch.equal(fresh.mean, whole.mean)
    assert fresh.best_score == whole.best_score and fresh.line_generation == whole.line_generation


def test_a_checkpoint_of_other_settings_is_refused(pendulums):
    optimizer = CMAESOptimizer(pendulums.space, 8, CMAESOptimizerCfg())
    with pytest.raises(ValueError, match=r"shape \(6, 2\), expected \(8, 1\)"):
        optimizer.restore([np.zeros((6, 2))])


def test_the_same_seed_gives_the_same_search_and_another_seed_another(bench):
    first, second, third = (run(bench, 8, 4, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(np.stack(first.history), np.stack(second.history))
    assert not np.array_equal(np.stack(first.history), np.stack(third.history))


def test_the_global_random_state_is_left_alone(bench):
    np.random.seed(5)
    before = np.random.get_state()[1].copy()
    run(bench, 4, 2)
    assert np.array_equal(before, np.random.get_state()[1])


def test_fewer_generations_than_a_run_has_had_begin_no_line_and_are_refused(pendulums, unbroken):
    """The line began in a generation of the past: its winner was a candidate of another delay."""
    trees, _ = unbroken
    half = run(pendulums, 8, 20, trees=trees, after=lambda o: o.generation == 10 and o.stop("interrupted"))
    assert half.line_generation == -1

    def restored(generations):
        cfg = CMAESOptimizerCfg(max_iteration=generations, epsilon=None)
        fresh = CMAESOptimizer(pendulums.space, 8, cfg, seed=1, trees=trees)
        fresh.restore(half.history, half.line_generation)
        return fresh

    fresh = restored(11)
    assert fresh.best_scores == half.best_scores and torch.equal(fresh.best, half.best)
    search(fresh, pendulums.evaluator().rollout(8))
    assert fresh.line_generation == (10 if trees else -1) and fresh.generation == 11
    with pytest.raises(ValueError, match="has had 10 generations, more than max_iteration 9"):
        restored(9)


@pytest.mark.parametrize("generations", [2, 3, 5, 9])
def test_a_search_of_few_generations_ends_with_one_delay_too(pendulums, generations):
    optimizer = run(pendulums, 8, generations, trees=pendulums.trees)
    assert optimizer.line_generation == generations - 1


# ---------------------------------------------------------------- objectives of PACE's advanced tutorial


class PositionAndVelocity(CMAESOptimizer):
    def tell(self, sim_dof_pos, real_dof_pos):
        position = sim_dof_pos - self.sim_params[:, self.bias_idx] - real_dof_pos
        velocity = self.rollout.sim_dof_vel - self.rollout.real_dof_vel
        self.add_score(position.square() + 1e-4 * velocity.square())


class VelocityOnly(CMAESOptimizer):
    def tell(self, sim_dof_pos, real_dof_pos):
        self.add_score((self.rollout.sim_dof_vel - self.rollout.real_dof_vel).square())


class EndEffector(CMAESOptimizer):
    """Distance of the tips from where an outside camera sees them."""

    def update_simulator(self, rollout):
        super().update_simulator(rollout)
        self.step, self.sim = 0, rollout.env.sim
        self.tips = self.sim.bind("site_xpos")

    def tell(self, sim_dof_pos, real_dof_pos):
        self.sim.forward()
        self.add_score((self.tips - self.seen[self.step]).square().sum(dim=(1, 2)))
        self.step += 1


def seen_by_a_camera(problem, truth):
    """Where the tips were, (T, sites, 3) [m]."""
    env = problem.make_env(1)
    model = env.sim.model
    data, bias = mujoco.MjData(model), problem.space.from_dict(truth)[problem.space["encoder_bias"]].numpy()
    positions = []
    for q in problem.dataset.recordings[0].dof_pos + bias:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        positions.append(data.site_xpos.copy())
    env.close()
    return torch.as_tensor(np.stack(positions))


@pytest.mark.slow
def test_position_and_velocity_weighted_recover_the_truth(longer):
    optimizer = run(longer, generations=80, kind=PositionAndVelocity)
    assert range_error(longer, optimizer.best) < 0.15
    assert rolled(longer, optimizer.best) < 1e-7


@pytest.mark.slow
def test_velocity_alone_recovers_what_moves_but_not_where_the_arm_is(longer):
    optimizer = run(longer, generations=80, kind=VelocityOnly)
    error = (optimizer.best - normalised(longer)).abs() / 2
    assert float(error[:2].max()) < 0.05 and float(error[4]) < 0.1  # armature, viscous friction, delay
    assert optimizer.best_score > 0


@pytest.mark.slow
def test_the_end_effectors_error_recovers_the_truth_with_a_joint_strategy(swinging):
    class Camera(EndEffector):
        seen = seen_by_a_camera(swinging, PENDULUMS_TRUTH)

    optimizer = run(swinging, 16, 80, kind=Camera, trees=swinging.trees, cfg={"per_tree": False})
    assert len(optimizer.strategies) == 1
    assert optimizer.best_score < 1e-5
    error = (optimizer.best - normalised(swinging, PENDULUMS_TRUTH)).abs() / 2
    assert float(error[:2].max()) < 0.05  # armatures


def test_the_truth_scores_nothing_in_each_objective(bench, pendulums):
    class Camera(EndEffector):
        seen = seen_by_a_camera(pendulums, PENDULUMS_TRUTH)

    for kind, problem, truth in (
        (CMAESOptimizer, pendulums, PENDULUMS_TRUTH),
        (PositionAndVelocity, bench, TRUTH),
        (Camera, pendulums, PENDULUMS_TRUTH),
    ):
        optimizer = kind(problem.space, 4, CMAESOptimizerCfg(per_tree=False))
        optimizer.ask()
        optimizer.candidates = problem.space.from_dict(truth).repeat(4, 1)
        optimizer.candidates[0, 0] *= 1.5
        rollout = problem.evaluator().rollout(4)
        optimizer.update_simulator(rollout)
        for sim_dof_pos, real_dof_pos in rollout:
            optimizer.tell(sim_dof_pos, real_dof_pos)
        optimizer.evolve()
        scores = optimizer.generation_scores.sum(axis=1)
        assert scores[1:].max() < 0.05 * scores[0], kind
        if kind is not PositionAndVelocity:  # measured speeds are differences
            assert scores[1:].max() < 1e-20, kind


def test_an_error_per_environment_counts_once(pendulums):
    optimizer = CMAESOptimizer(pendulums.space, 4, CMAESOptimizerCfg())
    optimizer.ask()
    rollout = pendulums.evaluator().rollout(4)
    optimizer.update_simulator(rollout)
    for _ in rollout:
        optimizer.add_score(torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64))
    optimizer.evolve()
    assert optimizer.generation_scores[:, 0].tolist() == pytest.approx([1.0, 2.0, 3.0, 4.0])


# ---------------------------------------------------------------- misuse and stopping


def test_misuse_is_answered_with_the_cure(pendulums):
    optimizer = CMAESOptimizer(pendulums.space, 4, CMAESOptimizerCfg(), trees=pendulums.trees)
    with pytest.raises(ValueError, match=r"no rollout to score\. Call update_simulator first"):
        optimizer.add_score(torch.zeros(4))
    with pytest.raises(ValueError, match="no scores to learn from"):
        optimizer.evolve()
    optimizer.ask()
    optimizer.update_simulator(pendulums.evaluator().rollout(4))
    with pytest.raises(ValueError, match=r"split into 2 independent trees.*per_tree=False"):
        optimizer.add_score(torch.zeros(4, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"has shape \(4, 3\), expected \(4, 2\)"):
        optimizer.add_score(torch.zeros(4, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"has shape \(3,\), expected \(4, 2\)"):
        optimizer.add_score(torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ValueError, match="population is 3, expected at least 4"):
        CMAESOptimizer(pendulums.space, 3, CMAESOptimizerCfg())


def test_a_rollout_of_another_size_is_refused(bench):
    optimizer = CMAESOptimizer(bench.space, 8, CMAESOptimizerCfg())
    optimizer.ask()
    with pytest.raises(ValueError, match=r"8 candidates.*the rollout simulates 4"):
        optimizer.update_simulator(bench.evaluator().rollout(4))


def test_evolving_twice_on_the_same_scores_is_refused(bench):
    optimizer = CMAESOptimizer(bench.space, 4, CMAESOptimizerCfg())
    optimizer.ask()
    optimizer.update_simulator(bench.evaluator().rollout(4))
    optimizer.evolve()
    with pytest.raises(ValueError, match="no scores to learn from"):
        optimizer.evolve()


@pytest.mark.slow
def test_paces_rule_stops_the_search_and_says_so(longer):
    optimizer = run(longer, 8, 60, epsilon=0.8)
    spread = np.stack(optimizer.history)[:, :, 0]
    relative = (spread.max(axis=1) - spread.min(axis=1)) / spread.min(axis=1)
    assert optimizer.stop_reasons == ["score spread below 0.8"]
    assert relative[-1] < 0.8 and (relative[:-1] >= 0.8).all()


def test_max_iteration_stops_the_search_and_says_so(bench):
    optimizer = run(bench, 4, 3)
    assert optimizer.generation == 3 and optimizer.stop_reasons == ["max_iteration 3"] and optimizer.finished()


def test_a_criterion_of_ones_own_stops_the_search(bench):
    optimizer = run(bench, 4, 30, criteria=[lambda state: "enough" if state.generation == 5 else None])
    assert optimizer.stop_reasons == ["enough"] and optimizer.generation == 5


def test_a_split_search_stops_only_when_every_tree_has(pendulums):
    def first_tree_early(state):
        return "early" if state.generation >= 3 and len(state.spread) == 5 else None

    optimizer = run(pendulums, 8, 40, trees=pendulums.trees, criteria=[first_tree_early])
    assert optimizer.stop_reasons == ["early"]
    assert optimizer.line_generation == 3  # when all trees had stopped, the delay was agreed on
    assert optimizer.generation > 4
    assert len({float(s.best_x[s.entries.tolist().index(8)]) for s in optimizer.strategies}) == 1
