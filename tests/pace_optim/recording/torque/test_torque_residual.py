"""Measured torques, followed beside the positions."""

import json
from dataclasses import replace
from functools import partial
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch
from bench_recordings import CONTROL_DT, Bench, chirp, record

from pace_optim.estimate.error_bars.uncertainty import torque_noise
from pace_optim.identification import conclude
from pace_optim.identification import fit as fit_module
from pace_optim.identification.fit import fit, fit_with_torques, resume
from pace_optim.identification.optimization import Optimization
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.problem import load_problem
from pace_optim.recording.dataset import Torques
from pace_optim.run.open import open_problem
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine

TASK = "Pace-TestBench-v0"
BOTH = ["position", "effort"]
SCALE, OFFSET, NOISE = 1.05, 0.2, 0.05
GAINS = ["stiffness", "damping"]


def sensed(torque: np.ndarray) -> np.ndarray:
    return SCALE * torque + OFFSET + NOISE * np.random.default_rng(5).normal(size=len(torque))


def filtered(torque: np.ndarray, steps: int = 3) -> np.ndarray:
    result = torque.copy()
    for k in range(1, len(torque)):
        result[k] = result[k - 1] + (torque[k] - result[k - 1]) / steps
    return result


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A drive with a sensor of its torques; its gains are stated as half of what they are."""
    path = tmp_path_factory.mktemp("log") / "log.csv"
    return record(path, Bench(stated={"stiffness": 20.0, "damping": 0.5}), position=chirp(4.0), sensor=sensed)


def settings(data, folder, **more) -> FitSettings:
    return FitSettings(
        task=TASK, data=[str(data)], optimizer="least_squares", check_consistency=False, log_dir=str(folder), **more
    )


@pytest.fixture(scope="module")
def told() -> StringIO:
    return StringIO()


@pytest.fixture(scope="module")
def run(log, told, tmp_path_factory):
    """No option says what is fitted."""
    return fit_with_torques(settings(log, tmp_path_factory.mktemp("runs"), unknown=GAINS), ProgressLine(told))


@pytest.mark.slow
def test_torques_on_which_gains_depend_are_followed_where_positions_end_above_the_noise(run, told):
    result, folder = run
    first = Path(FitSettings.load(folder / "settings.json")[0].instead_of)
    assert first.parent == folder.parent and FitResult.load(first).times_noise > 3 > 1.2 > result.times_noise
    assert "as damping, stiffness depend on them" in told.getvalue()
    assert "their noise is left of the torques: this fit is kept" in told.getvalue()


@pytest.mark.slow
def test_an_interrupted_fit_with_torques_resumes_to_the_same_result(tmp_path, monkeypatch):
    """Where torques have got their noise; steps that are simulated again count once."""
    bench = Bench(stated={"stiffness": 20.0, "damping": 0.5})
    log = record(tmp_path / "log.csv", bench, position=chirp(1.5), sensor=sensed)
    asked = settings(log, tmp_path / "runs", unknown=GAINS, residual=BOTH, physics_dt=CONTROL_DT)
    whole, _ = fit(asked)
    written = Optimization._after_iteration

    def interrupted(self, descents):
        written(self, descents)
        if descents[-1].stage.startswith("torque noise"):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Optimization, "_after_iteration", interrupted)
        half, folder = fit(asked)
    resumed, _ = resume(folder)
    assert half.stop_reasons == ["interrupted"]
    same = ("parameters", "std", "rmse", "torque_noise", "torque_rmse", "stop_reasons", "simulated_steps", "warnings")
    assert [getattr(resumed, name) for name in same] == [getattr(whole, name) for name in same]


@pytest.fixture
def short(tmp_path):
    """A log whose positions end above the noise."""
    bench = Bench(stated={"stiffness": 20.0, "damping": 0.5})
    log = record(tmp_path / "log.csv", bench, position=chirp(1.0), sensor=sensed)
    return settings(log, tmp_path / "runs", unknown=GAINS, physics_dt=CONTROL_DT)


@pytest.mark.slow
def test_a_fit_that_is_interrupted_in_its_checks_is_not_followed_by_one_with_torques(short, monkeypatch):
    """Ctrl-C began a second fit; the first one's --resume then counted it as ended."""

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(conclude, "change_without_step", interrupted)
        first, folder = fit_with_torques(short)
    assert first.stop_reasons[-1] == "checks interrupted" and len(list(folder.parent.iterdir())) == 1
    monkeypatch.setattr(fit_module, "_by_torques", lambda first, *_: (first, "goes on"))
    resumed, goes_on = resume(folder)
    assert goes_on == "goes on" and not resumed.is_interrupted


@pytest.mark.slow
def test_the_second_fit_with_torques_follows_a_resumed_first_one(short, tmp_path, monkeypatch):
    first, folder = fit(short)
    replace(first, contested=["stiffness"]).save(folder / "result.json")
    beside, path = fit(replace(short, residual=BOTH, instead_of=str(folder)))
    replace(beside, stop_reasons=["interrupted"]).save(path / "result.json")
    begun = []

    def begins(asked, *_, **__):
        begun.append(asked)
        return first, tmp_path

    monkeypatch.setattr(fit_module, "fit", begins)
    monkeypatch.setattr(fit_module, "_is_better", lambda result, *_: result is first)
    assert resume(path) == (first, tmp_path)
    assert [(asked.residual, asked.instead_of) for asked in begun] == [([], str(folder))]


@pytest.mark.slow
def test_filtered_torques_are_not_followed_by_themselves(tmp_path):
    """A low pass of 11 ms: with free gains the positions are followed better, by a drive that is not the robot's."""
    told, bench = StringIO(), Bench(stated={"stiffness": 20.0, "damping": 0.5})
    log = record(tmp_path / "log.csv", bench, position=chirp(4.0), sensor=partial(filtered, steps=5))
    result, _ = fit_with_torques(settings(log, tmp_path, unknown=GAINS), ProgressLine(told))
    assert "times the torques' noise is left of them: the fit of positions is kept" in told.getvalue()
    assert not result.torque_noise


def test_gains_and_what_a_sensor_adds_are_found_beside_the_drive(run):
    result, _ = run
    found = {name: values["servo"] for name, values in result.parameters.items() if "servo" in values}
    law = result.measured_drive["servo"]["log"]
    kp, kd = (law[name] * found[f"{effect}_gain.gain"] for name, effect in
              (("stiffness", "proportional"), ("damping", "derivative")))  # fmt: skip
    assert (kp, kd) == pytest.approx((40.0, 1.0), rel=0.01)
    assert (found["armature"], found["viscous_friction"], found["friction"]) == pytest.approx(
        (0.05, 0.5, 0.3), rel=0.02
    )
    for name, truth in (("torque_scale", SCALE), ("torque_offset", OFFSET)):
        assert abs(found[name] - truth) < 5 * result.std[name]["servo"] < 0.2 * truth
    assert result.torque_rmse["validation"]["servo"] == pytest.approx(NOISE, rel=0.1)
    assert any("follows dof_effort of servo" in note for note in result.notes)


@pytest.mark.slow
def test_a_run_is_opened_with_the_noise_that_its_torques_had(run):
    result, folder = run
    problem = open_problem(folder)
    assert problem.torque_noise == result.torque_noise == {"servo": pytest.approx(NOISE, rel=0.2)}
    alone = problem.on_positions()
    assert not alone.torque_noise and not any(label.startswith("torque") for label in alone.space.labels)


@pytest.mark.slow
def test_compiled_and_stepped_torques_are_those_of_the_law(run, monkeypatch):
    problem = open_problem(run[1]).with_effects(()).with_physics_dt(CONTROL_DT)
    physical = problem.space.to_physical(problem.space.start)
    physical[problem.space["delay"]] = 0.0
    torques, at = problem.dataset.torques, torch.arange(200)

    def simulated() -> list[torch.Tensor]:
        rollout = problem.evaluator().rollout(1)
        rollout.start(physical[None])
        return [each[:, 0] for each in rollout.positions_and_torques(at, torques)]

    shown, compiled = simulated()
    monkeypatch.setattr("pace_envs.compiled_drive.robot_kernel.CompiledRobot.positions", lambda *_: None)
    assert torch.allclose(compiled, simulated()[1], rtol=0.0, atol=1e-9)
    (recording,), bias = problem.dataset.recordings, physical[problem.space["encoder_bias"]]
    kp, kd = recording.drive.stiffness[0], recording.drive.damping[0]
    held = kp * (problem.dataset.command[at, 0] - shown + bias)
    speed = torch.gradient(shown, spacing=CONTROL_DT, dim=0)[0]
    assert torch.allclose(compiled[2:-2], (held - kd * speed)[2:-2], atol=0.1) and float(held.std()) > 1


@pytest.mark.slow
def test_a_filtered_torque_does_not_spoil_a_fit(tmp_path):
    log = record(tmp_path / "log.csv", Bench(), position=chirp(4.0), sensor=filtered)
    result, _ = fit(settings(log, tmp_path, residual=BOTH))
    found = {name: values["servo"] for name, values in result.parameters.items() if "servo" in values}
    assert (found["armature"], found["viscous_friction"], found["friction"]) == pytest.approx(
        (0.05, 0.5, 0.3), rel=0.02
    )
    assert result.torque_noise["servo"] > 0.05


@pytest.mark.slow
def test_torques_that_say_nothing_are_left_out_and_told(tmp_path):
    told = np.sin(np.arange(1600) / 40)
    log = record(tmp_path / "log.csv", Bench(), position=chirp(4.0), effort=told, sensor=lambda _: told)
    with pytest.raises(ValueError, match="repeats the torque that is commanded"):
        load_problem(TASK, data=[log], residual=BOTH)
    assert load_problem(TASK, data=[log]).dataset.torques is None
    log = record(tmp_path / "log.csv", Bench(), position=chirp(4.0))
    with pytest.raises(ValueError, match="no recording has any"):
        load_problem(TASK, data=[log], residual=BOTH)


@pytest.mark.slow
def test_a_limit_that_a_torque_shows_is_refined(tmp_path):
    log = record(tmp_path / "log.csv", Bench(current_limit=8.0), position=chirp(4.0), sensor=sensed)
    facts = json.loads(log.with_suffix(".json").read_text())
    log.with_suffix(".json").write_text(json.dumps({**facts, "effort_limit": 1e3}))
    problem = load_problem(TASK, data=[log], unknown=["effort_limit", *GAINS], residual=BOTH)
    assert problem.effects == ["torque_limit@servo", "proportional_gain", "derivative_gain"]
    start = problem.space.to_physical(problem.space.start)
    assert float(start[problem.space["torque_limit.effort"]]) == pytest.approx(8.0 * SCALE, rel=0.03)
    assert np.isinf(problem.dataset.recordings[0].drive.effort_limit).all()


def test_the_noise_of_a_torque_is_that_of_white_noise_that_hides_as_much():
    rng, count = np.random.default_rng(0), 20_000
    torque, white = np.sin(np.arange(count) / 50), rng.normal(size=count)
    for left, noise in ((white, 1.0), (np.convolve(white, np.ones(9), mode="same"), 9.0)):
        measured = torch.as_tensor(torque)[:, None, None]
        known = torch.ones(count, 1, 1, dtype=torch.bool)
        torques = Torques(
            measured=measured, known=known, noise=torch.ones(1), floor=torch.zeros(1), position_noise=1.0,
            after=torch.zeros(count, 1), lag=torch.zeros(1),
        )  # fmt: skip
        error = torch.stack([torch.zeros(count), torch.as_tensor(left)], dim=1)[None, :, :, None].double()
        residuals = Residuals(
            error=error, where=torch.ones(count, 2, dtype=torch.bool), step=torch.arange(count), with_torques=True
        )
        assert torque_noise(residuals, torques) == [pytest.approx(noise, rel=0.1)]
        halves = replace(residuals, where=residuals.where & (torch.arange(count) < count // 2)[:, None])
        assert torque_noise(halves, torques) == [pytest.approx(noise, rel=0.15)]


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"residual": ["effort"]}, "position effort"),
        ({"residual": ["position", "effort"], "optimizer": "cmaes"}, "least"),
    ],
)
def test_residuals_that_cannot_be_are_refused(more, says):
    with pytest.raises(ValueError, match=says):
        FitSettings(**{"task": TASK, **more})
