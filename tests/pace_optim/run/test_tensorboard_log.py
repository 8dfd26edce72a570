"""What a fit writes for TensorBoard can be read back."""

import sys

import numpy as np
import pytest
import torch
from run_folders import JOINTS, make_result
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pace_envs.tasks.pace import PaceCfg, base_parameters
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.run.tensorboard_log import TensorBoardLog

GENERATIONS = 12


def evolve(optimizer: CMAESOptimizer) -> None:
    """One generation on a bowl, without a simulator."""
    optimizer.ask()
    optimizer.scores_buffer = optimizer.normalised[:, : len(JOINTS)].square()
    optimizer.evolve()


@pytest.fixture(scope="module")
def optimizer() -> CMAESOptimizer:
    bounds = {
        "armature": (1e-5, 1),
        "viscous_friction": (0, 7),
        "friction": (0, 1),
        "encoder_bias": (-0.1, 0.1),
        "delay": (0, 10),
    }
    cfg = PaceCfg(robot_name="r", data_dir="none", joint_order=JOINTS, bounds=bounds)
    return CMAESOptimizer(ParameterSpace(base_parameters(cfg)), 16, CMAESOptimizerCfg(epsilon=None))


@pytest.fixture(scope="module")
def events(tmp_path_factory, optimizer) -> EventAccumulator:
    folder = tmp_path_factory.mktemp("events")
    log = TensorBoardLog(folder, histogram_interval=5)
    for _ in range(GENERATIONS):
        evolve(optimizer)
        log.log_generation(optimizer)
    log.log_refinement(1, 1e-3)
    log.log_refinement(2, 1e-4)
    log.log_result(make_result(warnings=["a | bar", "second"]))
    log.close()
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "histograms": 0, "tensors": 0})
    events.Reload()
    return events


def test_every_generation_has_its_scores_and_its_best_parameters(events, optimizer):
    scalars = set(events.Tags()["scalars"])
    wanted = {f"score/{name}" for name in ("best", "generation_min", "generation_median", "generation_max")}
    wanted |= {f"best/{label}" for label in optimizer.space.labels} | {f"spread/{p}" for p in optimizer.space.slices}
    assert wanted <= scalars
    for tag in wanted:
        assert [event.step for event in events.Scalars(tag)] == list(range(1, GENERATIONS + 1))
    best = optimizer.space.to_physical(optimizer.best)
    for label, value in zip(optimizer.space.labels, best.tolist(), strict=True):
        assert events.Scalars(f"best/{label}")[-1].value == pytest.approx(value, rel=1e-6)


def test_scores_are_those_of_the_whole_robot(events, optimizer):
    total = np.array(optimizer.history).sum(axis=2)
    assert [e.value for e in events.Scalars("score/generation_max")] == pytest.approx(total.max(axis=1).tolist())
    assert [e.value for e in events.Scalars("score/generation_min")] == pytest.approx(total.min(axis=1).tolist())


def test_parameters_are_distributed_in_physical_units(events, optimizer):
    ours = {tag for tag in events.Tags()["histograms"] if tag.startswith("population/")}
    assert ours == {f"population/{label}" for label in optimizer.space.labels}
    for histogram in (events.Histograms("population/delay/all"), events.Histograms(f"population/armature/{JOINTS[0]}")):
        assert [event.step for event in histogram] == [1, 5, 10]
        assert all(event.histogram_value.num == 16 for event in histogram)
    assert events.Histograms("population/delay/all")[0].histogram_value.max > 1.0  # control steps, not normalised


def test_refinement_and_result_are_there(events):
    assert [(e.step, e.value) for e in events.Scalars("refinement/score")] == [
        (1, pytest.approx(1e-3)),
        (2, pytest.approx(1e-4)),
    ]
    result = make_result()
    assert events.Scalars(f"result/armature/{JOINTS[1]}")[0].value == pytest.approx(
        result.parameters["armature"][JOINTS[1]]
    )
    scalars = events.Tags()["scalars"]
    assert "result/rmse/validation" in scalars and f"result/rmse/train/{JOINTS[0]}" in scalars
    assert "result/std/delay/all" in scalars
    assert f"result/std/friction/{JOINTS[2]}" not in scalars  # at its bound, so it has no error bar


def test_warnings_are_a_table(events):
    text = events.Tensors("result/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "| a \\| bar |" in text and "| second |" in text


def test_nothing_is_written_before_the_first_event(tmp_path):
    log = TensorBoardLog(tmp_path)
    log.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_importing_it_does_not_import_tensorboard():
    import subprocess

    code = "import sys, pace_optim.run.tensorboard_log; sys.exit('tensorboard' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_a_diverged_generation_is_logged_as_any_other(tmp_path, optimizer):
    optimizer.ask()
    optimizer.scores_buffer = torch.full((16, len(JOINTS)), torch.nan, dtype=torch.float64)
    optimizer.evolve()
    log = TensorBoardLog(tmp_path)
    log.log_generation(optimizer)
    log.close()
    assert list(tmp_path.glob("events.*"))
