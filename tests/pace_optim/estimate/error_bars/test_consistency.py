"""Recordings that disagree are named, with the gain that would explain it; those that agree are left in peace."""

import dataclasses

import numpy as np
import pytest
import torch
from problems import chirp, env_cfg, make_problem, record

from pace_envs import ManagerBasedRLEnv
from pace_envs.tasks.pace import Parameter
from pace_optim.estimate.error_bars import consistency
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.consistency import check_consistency
from pace_optim.estimate.least_squares import least_squares
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive

GAINS = {"soft": (60.0, 1.0), "middle": (85.0, 2.0), "stiff": (120.0, 4.0)}


def checked(recordings):
    problem = make_problem(recordings)
    start = torch.zeros(problem.space.size, dtype=torch.float64)
    evaluator = problem.training_evaluator()
    best = least_squares(evaluator, [start])[0]
    return check_consistency(problem, best.x, best.score)


@pytest.fixture(scope="module")
def recordings():
    return [
        record(chirp(0.6), drive={"stiffness": kp, "damping": kd}, name=name, noise=1e-4, seed=seed)
        for seed, (name, (kp, kd)) in enumerate(GAINS.items())
    ]


@pytest.mark.slow
def test_recordings_at_three_gains_agree(recordings):
    found = checked(recordings)
    assert found.recordings == ("soft", "middle", "stiff")
    assert found.sentences == ()
    assert all(len(values) == 3 for values in found.values.values())
    assert found.simulated_steps > 0


@pytest.mark.slow
def test_a_damping_that_is_misreported_by_30_percent_is_named_with_its_recording_and_its_size(recordings):
    wrong = dataclasses.replace(
        recordings[2], drive=Drive(stiffness=np.array([120.0]), damping=np.array([4.0 / 1.3])), name="wrong"
    )
    sentences = checked([*recordings[:2], wrong]).sentences
    assert any("Viscous friction" in s and "differs between wrong and" in s for s in sentences)
    gain = [s for s in sentences if "behaves as if" in s]
    assert len(gain) == 1
    assert gain[0].startswith("wrong behaves as if its damping were 30% higher than stated (4 instead of 3.08")


@pytest.mark.slow
@pytest.mark.parametrize("place", range(3))
def test_the_recording_to_refit_is_known_beforehand(recordings, place):
    kp, kd = list(GAINS.values())[place]
    drive = Drive(stiffness=np.array([kp * 1.25]), damping=np.array([kd]))
    wrong = [*recordings]
    wrong[place] = dataclasses.replace(recordings[place], drive=drive, name="wrong")
    gain = [s for s in checked(wrong).sentences if "behaves as if" in s]
    assert len(gain) == 1 and gain[0].startswith("wrong behaves as if its stiffness were 20% lower than stated")


def test_of_many_joints_the_first_are_shown_and_the_others_counted():
    keys = tuple(f"joint_{i}" for i in range(5))
    parameter = Parameter(name="friction", unit="N m", lower=(0.0,) * 5, upper=(1.0,) * 5, apply=print, keys=keys)
    space, std = ParameterSpace([parameter]), np.full((3, 5), 0.01)
    values = np.array([[0.1] * 5, [0.1] * 5, [0.5] * 5])

    def sentence(joints):
        values[2, joints:] = 0.1
        return consistency._disagreements(space, ("a", "b", "c"), values, std)[0]

    assert sentence(4).endswith("joint_1 0.5 ± 0.01 against 0.1 ± 0.007; and 2 more joints. [W17]")
    assert sentence(3).endswith("joint_1 0.5 ± 0.01 against 0.1 ± 0.007; and 1 more joint. [W17]")
    assert sentence(2).endswith("joint_1 0.5 ± 0.01 against 0.1 ± 0.007. [W17]")


def test_one_recording_has_nothing_to_disagree_with(recordings):
    problem = make_problem(recordings[:1])
    assert check_consistency(problem, torch.zeros(problem.space.size, dtype=torch.float64), 1.0).recordings == ()


def test_a_delay_longer_than_a_controller_of_another_rate_allows_is_refused(monkeypatch):
    def cfg(task, control_dt, couplings=None):
        other = env_cfg()
        other.decimation = 4
        return other

    monkeypatch.setattr("pace_optim.problem.problem.load_env_cfg", cfg)
    monkeypatch.setattr(ManagerBasedRLEnv, "__init__", lambda *args: pytest.fail("checked too late"))
    with pytest.raises(ValueError, match=r"bound is 100 ms \(10 control steps\), but the drive allows 25 ms"):
        load_problem("Pace-TestBench-v0")


@pytest.mark.slow
def test_recordings_are_fitted_alone_from_the_derivatives_that_are_known(recordings):
    """The same is said of each, for fewer simulations."""
    wrong = dataclasses.replace(recordings[2], drive=Drive(stiffness=np.array([120.0]), damping=np.array([3.6])))
    problem = make_problem([*recordings[:2], wrong])
    evaluator = problem.training_evaluator()
    start = torch.zeros(problem.space.size, dtype=torch.float64)
    best = least_squares(evaluator, [start])[0]
    there = assess(problem, evaluator, best.x).jacobian
    anew, known = (check_consistency(problem, best.x, best.score, there=given) for given in (None, there))
    assert known.simulated_steps < anew.simulated_steps
    assert [text[:60] for text in known.sentences] == [text[:60] for text in anew.sentences]
    for label, std in anew.std.items():
        for one, other, error, again in zip(
            anew.values[label], known.values[label], std, known.std[label], strict=True
        ):
            assert (error is None) == (again is None)
            if error is not None and again is not None:
                assert abs(one - other) < 0.5 * error and again == pytest.approx(error, rel=0.1)
