"""PACE's two tutorials, statement by statement: its formula beside what ours does.

The page docs/coming_from_pace.md shows the statements as they are typed, and tests/docs/test_docs.py types them. How a
delay, a default and a missing ``super()`` are taken is in tests/pace_envs/test_config.py, ``tell`` in
tests/pace_optim/estimate/test_own_objective.py, files and tags in tests/pace_optim/run/test_paces_files.py.
"""

import math
import re

import numpy as np
import pytest
import torch
from places import ROOT

from pace_actuators import ActuatorActions, PaceDCMotor
from pace_envs import load_env_cfg
from pace_optim import CMAESOptimizer
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizerCfg
from pace_optim.estimate.convergence import ScoreSpread, SearchState
from pace_optim.motion.signals import make_excitation
from pace_optim.problem.parameter_space import ParameterSpace

PAGE = ROOT / "docs" / "coming_from_pace.md"
N = 12


@pytest.fixture(scope="module")
def cfg(tmp_path_factory):
    """The configuration that the page types."""
    from pace_actuators.own_code import import_named

    text = re.search(r"cat > anymal_pace_env_cfg.py <<'END'\n(.*?)\nEND\n", PAGE.read_text(), re.DOTALL).group(1)
    path = tmp_path_factory.mktemp("page") / "anymal_pace_env_cfg.py"
    path.write_text(text)
    import_named(str(path))
    import gymnasium

    yield load_env_cfg("Isaac-Pace-Anymal-D-v0")
    del gymnasium.registry["Isaac-Pace-Anymal-D-v0"]


@pytest.fixture(scope="module")
def optimizer(cfg):
    return CMAESOptimizer(ParameterSpace.of(cfg.sim2real), 8, CMAESOptimizerCfg(), seed=0)


def test_basics_the_configuration_holds_what_the_tutorial_sets(cfg):
    assert (cfg.sim.dt, cfg.decimation, cfg.scene.robot.fix_base) == (0.0025, 1, True)
    assert cfg.scene.robot.init_state.pos == (0.0, 0.0, 1.0)
    drive = cfg.scene.robot.actuators["legs"]
    assert (drive.saturation_effort, drive.effort_limit, drive.velocity_limit, drive.max_delay) == (140, 89, 8.5, 10)
    assert cfg.sim2real.robot_name == "anymal_d_sim" and len(cfg.sim2real.joint_order) == N
    bounds = torch.cat([*cfg.sim2real.bounds.values()])
    assert bounds.shape == (49, 2)
    assert bounds[:12].tolist() == [[pytest.approx(1e-5), 1.0]] * 12 and bounds[12:24].tolist() == [[0.0, 7.0]] * 12
    assert bounds[24:36].tolist() == [[0.0, 0.5]] * 12 and bounds[48].tolist() == [0.0, 10.0]


def test_basics_the_vector_is_laid_out_as_in_paces(optimizer):
    slices = [optimizer.armature_idx, optimizer.damping_idx, optimizer.friction_idx, optimizer.bias_idx]
    assert slices == [slice(k * N, (k + 1) * N) for k in range(4)]
    assert optimizer.delay_idx == slice(4 * N, 4 * N + 1)


def test_basics_the_excitation_is_paces_chirp(cfg):
    duration, f0, f1 = 20.0, 0.1, 10.0
    (made,) = make_excitation(
        "chirp", cfg.sim2real, control_dt=0.0025, duration=duration, min_frequency=f0, max_frequency=f1
    )
    t = np.arange(len(made.des_dof_pos)) * 0.0025
    chirp = np.sin(2 * math.pi * (f0 * t + ((f1 - f0) / (2 * duration)) * t**2))
    bias, scale = np.tile([0.0, 0.4, 0.8], 4), np.tile([0.25, 0.5, -2.0], 4)
    directions = np.array([1, 1, 1, -1, 1, 1, 1, -1, -1, -1, -1, -1.0])
    assert np.allclose(made.des_dof_pos, (chirp[:, None] + bias) * directions * scale, atol=1e-9)


def test_basics_the_controller_sees_the_position_less_its_bias(cfg):
    drive = PaceDCMotor(cfg.scene.robot.actuators["legs"], cfg.sim2real.joint_order, slice(None), 3)
    drive.update_encoder_bias(torch.full((3, N), 0.05))
    drive.update_time_lags(torch.zeros(3))
    drive.reset([0, 1, 2])
    zero = torch.zeros(3, N)
    effort = drive.compute(ActuatorActions(zero), zero + 0.1, zero).joint_efforts
    assert torch.allclose(effort, torch.full((3, N), 85.0 * (0.0 - (0.1 - 0.05))))


def test_advanced_parameters_are_normalised_to_minus_one_and_one(optimizer, cfg):
    params, (low, high) = torch.rand(5, 49, dtype=torch.float64) * 2 - 1, torch.cat([*cfg.sim2real.bounds.values()]).T
    expected = low + (params + 1) / 2 * (high - low)
    assert torch.allclose(optimizer.space.to_physical(params), expected)


def test_advanced_the_search_stops_at_paces_spread_of_scores_or_its_last_iteration():
    def state(scores):
        return SearchState(generation=1, scores=np.array(scores), best_scores=[min(scores)], spread=np.ones(1))

    rule = ScoreSpread(1e-2)
    assert rule(state([1.0, 1.005])) and rule(state([1.0, 1.02])) is None
    assert CMAESOptimizerCfg() == CMAESOptimizerCfg(
        max_iteration=200, epsilon=1e-2, sigma=0.5, save_interval=10, save_optimization_process=False
    )


def test_advanced_the_optimizers_class_is_imported_and_extended_as_in_the_tutorial():
    class CustomCMAESOptimizer(CMAESOptimizer):
        def tell(self, sim_dof_pos, real_dof_pos):
            pass

    for name in ("ask", "tell", "evolve", "finished", "update_simulator", "close"):
        assert callable(getattr(CustomCMAESOptimizer, name))
