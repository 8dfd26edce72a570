"""Fits end to end on the bench: what is found, what is written, and interruption."""

import dataclasses
import io
import json
import math
import pickle
import time

import numpy as np
import pytest
import torch
from problems import BENCH, TRUTH, chirp, record

import pace_optim.identification.fit as fit_module
from pace_envs import load_env_cfg
from pace_optim.estimate.least_squares import Descent
from pace_optim.estimate.way_down import WayDown
from pace_optim.identification import conclude
from pace_optim.identification.fit import fit, resume
from pace_optim.identification.optimization import Optimization
from pace_optim.identification.setup import load_for_fit
from pace_optim.recording import Drive, Load, load_recording, save_recording
from pace_optim.run.folder import RunFolder
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings
from pace_optim.run.summary import summary
from pace_optim.terminal.progress import ProgressLine

DESIGN_KEYS = {
    "version",
    "task",
    "robot_name",
    "joint_names",
    "effects",
    "delay_mode",
    "physics_dt",
    "parameters",
    "delay_s",
    "std",
    "units",
    "at_bound",
    "score",
    "rmse",
    "recordings",
    "optimizer",
    "seed",
    "generations",
    "simulated_steps",
    "wall_time_s",
    "stop_reasons",
}
RANGES = {"armature": 1.0, "viscous_friction": 7.0, "friction": 2.0, "encoder_bias": 0.2, "delay": 10.0}


class Silent(ProgressLine):
    def say(self, text):
        pass


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Files: clean, noisy, one at other gains, one with another load."""
    folder = tmp_path_factory.mktemp("recordings")
    target = chirp(0.5)
    short = record(target)
    made = {
        "clean": record(name="clean"),
        "noisy": record(target, name="noisy", noise=1e-4),
        "soft": record(target, name="soft", drive={"stiffness": 50.0}, noise=1e-4, seed=1),
        "heavy": record(target, name="heavy", load=Load(load_mass=1.6), noise=1e-4, seed=2),
        "wrong": dataclasses.replace(short, name="wrong", dof_pos=np.roll(short.dof_pos, 5, axis=0)),
    }
    for name, recording in made.items():
        save_recording(folder / f"{name}.npz", recording)
    return {name: str(folder / f"{name}.npz") for name in made}


def settings(folder, *data, **changes):
    content = {"task": BENCH, "data": list(data), "num_envs": 16, "log_dir": str(folder), "epsilon": 1e-9}
    return FitSettings(**{**content, **changes})


def run(folder, *data, **changes):
    return fit(settings(folder, *data, **changes), Silent())


@pytest.fixture
def no_report(monkeypatch):
    monkeypatch.setattr(fit_module, "write_report", lambda folder: None)


@pytest.fixture(scope="module")
def whole(recordings, tmp_path_factory):
    """Fits that nobody interrupts, each made once; their folders are not changed."""
    made = {}

    def of(data, **options):
        key = (data, *sorted(options.items()))
        if key not in made:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(fit_module, "write_report", lambda folder: None)
                made[key] = run(tmp_path_factory.mktemp("whole"), recordings[data], **options)
        return made[key]

    return of


def range_error(result):
    return max(
        abs(value - TRUTH[name]) / RANGES[name] for name, keys in result.parameters.items() for value in keys.values()
    )


# ---------------------------------------------------------------- what is found and written


@pytest.mark.slow
@pytest.mark.parametrize(("optimizer", "score"), [("hybrid", 1e-12), ("least_squares", 1e-12), ("cmaes", 1e-8)])
def test_each_optimizer_finds_the_truth_and_leaves_the_runs_folder(optimizer, score, recordings, tmp_path):
    result, folder = run(
        tmp_path, recordings["clean"], optimizer=optimizer, max_iteration=70, save_optimization_process=True
    )
    assert result.score <= score and range_error(result) < 0.01
    assert folder.parent == tmp_path / "test_bench"
    assert len(folder.name.split("_")) == 4 and len(folder.name.split("-")) == 3  # YY_MM_DD_HH-MM-SS
    names = {path.name for path in folder.iterdir()}
    assert {"result.json", "config.pt", "best_trajectory.pt", "report.html", "checkpoint.npz", "settings.json"} <= names
    assert any(name.startswith("events.out.tfevents") for name in names)
    assert not [name for name in names if name.endswith(".tmp")]
    assert FitResult.load(folder) == FitResult.load(folder / "result.json") == result
    check_schema(json.loads((folder / "result.json").read_text()), optimizer)
    check_tensors(folder, result)
    text = "\n".join(summary(result))
    assert "servo" in text and "delay mode command" in text and f"score {result.score:.3e}" in text
    if optimizer == "cmaes":
        check_search_files(folder, result)


def check_schema(content, optimizer):
    assert set(content) >= DESIGN_KEYS
    assert content["version"] == 1 and content["task"] == BENCH and content["robot_name"] == "test_bench"
    assert content["joint_names"] == ["servo"] and content["effects"] == [] and content["optimizer"] == optimizer
    assert content["delay_mode"] == "command" and content["physics_dt"] == 0.0025
    names = {"armature", "viscous_friction", "friction", "encoder_bias", "delay"}
    assert set(content["parameters"]) == set(content["std"]) == set(content["units"]) == names
    for name in names:
        expected = {"all"} if name == "delay" else {"servo"}
        assert set(content["parameters"][name]) == set(content["std"][name]) == expected
    assert content["delay_s"] == pytest.approx(0.0025 * content["parameters"]["delay"]["all"])
    assert set(content["rmse"]) == set(content["recordings"]) == {"train", "validation"}
    assert set(content["rmse"]["train"]) == set(content["rmse"]["validation"]) == {"servo", "all"}
    assert content["rmse"]["train"]["all"] == pytest.approx(math.sqrt(content["score"]), rel=1e-6)
    assert content["recordings"] == {"train": ["clean (first 70 %)"], "validation": ["clean (last 30 %)"]}
    assert content["simulated_steps"] > 0 and content["wall_time_s"] > 0 and content["stop_reasons"]


def check_tensors(folder, result):
    for name in ("config.pt", "best_trajectory.pt"):
        torch.load(folder / name, weights_only=True)
    config = torch.load(folder / "config.pt", weights_only=True)
    assert config["joint_order"] == ["servo"] and config["bounds_params"].shape == (5, 2)
    saved = torch.load(folder / "best_trajectory.pt", weights_only=True)
    (trajectory,) = saved["recordings"]
    error = trajectory["sim_dof_pos"] - trajectory["dof_pos"]
    train = trajectory["train"]
    assert float(error[train].square().sum(dim=1).mean()) == pytest.approx(result.score, rel=1e-9)
    assert train.sum() == round(0.7 * 401) and len(error) == 401
    with np.load(folder / "checkpoint.npz", allow_pickle=False) as content:
        assert all(content[key].dtype != object for key in content.files)


def check_search_files(folder, result):
    mean = torch.load(folder / "mean_070.pt", weights_only=True)
    assert mean.shape == (5,)
    progress = torch.load(folder / "progress.pt", weights_only=True)
    assert progress["params"].shape == (70, 16, 5) and progress["scores"].shape == (70, 16)
    assert float(progress["scores"].min()) == pytest.approx(result.score, rel=1e-6)
    history = json.loads((folder / "history.json").read_text())
    assert len(history["search_best"]) == result.generations == 70
    assert history["search_best"][-1] == pytest.approx(result.score, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("delay_mode", ["command", "effort"])
def test_hybrid_is_never_worse_than_either_alone(delay_mode, recordings, tmp_path, no_report):
    """On the recording of a drive that the model cannot follow exactly, and in the delay mode that is not its own."""
    scores = {
        optimizer: run(tmp_path, recordings["wrong"], optimizer=optimizer, max_iteration=10, delay_mode=delay_mode)[
            0
        ].score
        for optimizer in ("hybrid", "least_squares", "cmaes")
    }
    assert scores["hybrid"] <= (1 + 1e-6) * min(scores.values())


@pytest.mark.slow
def test_several_recordings_with_validation_files_are_fitted_together(recordings, tmp_path, no_report):
    result, folder = run(tmp_path, recordings["noisy"], recordings["soft"], validation=[recordings["heavy"]])
    assert result.recordings == {"train": ["noisy", "soft"], "validation": ["heavy"]}
    assert result.rmse["train"]["all"] == pytest.approx(1e-4, rel=0.1)
    assert result.rmse["validation"]["all"] == pytest.approx(1e-4, rel=0.3)
    for name, keys in result.parameters.items():
        for key, value in keys.items():
            assert abs(value - TRUTH[name]) < 4 * result.std[name][key], name
    saved = torch.load(folder / "best_trajectory.pt", weights_only=True)
    assert [r["name"] for r in saved["recordings"]] == ["noisy", "soft", "heavy"]
    assert json.loads((folder / "consistency.json").read_text())["recordings"] == ["noisy", "soft"]


@pytest.mark.slow
def test_validation_data_do_not_touch_the_result(recordings, tmp_path, no_report):
    first, _ = run(tmp_path, recordings["noisy"], validation=[recordings["heavy"]], optimizer="least_squares")
    other, _ = run(tmp_path, recordings["noisy"], validation=[recordings["wrong"]], optimizer="least_squares")
    assert first.parameters == other.parameters and first.score == other.score
    assert other.rmse["validation"]["all"] > 10 * first.rmse["validation"]["all"]
    assert any("does not carry over" in warning for warning in other.warnings)


@pytest.mark.slow
def test_a_finer_physics_step_and_a_delay_mode_are_kept_in_the_result(recordings, tmp_path, no_report):
    result, _ = run(tmp_path, recordings["clean"], optimizer="least_squares", physics_dt=0.00125, delay_mode="effort")
    assert result.physics_dt == 0.00125 and result.delay_mode == "effort" and result.control_dt == 0.0025
    assert result.delay_s == pytest.approx(0.0025 * result.parameters["delay"]["all"])


@pytest.mark.slow
def test_assumptions_are_told_once_and_before_the_search(recordings, tmp_path, no_report, capsys):
    result, _ = run(tmp_path, recordings["clean"], optimizer="least_squares")
    told = capsys.readouterr().err
    assert result.notes and all(told.count(note) == 1 for note in result.notes)
    assert not any(note in line for note in result.notes for line in summary(result))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_result(recordings, whole, tmp_path, no_report):
    (first, _), (second, _) = whole("noisy", optimizer="hybrid"), run(tmp_path, recordings["noisy"], optimizer="hybrid")
    assert first.parameters == second.parameters and first.score == second.score


@pytest.mark.slow
def test_two_runs_in_the_same_second_have_folders_of_their_own(recordings, tmp_path, no_report):
    folders = {run(tmp_path, recordings["clean"], optimizer="cmaes", max_iteration=1)[1] for _ in range(2)}
    assert len(folders) == 2


@pytest.mark.slow
def test_results_are_read_without_pickle(whole, monkeypatch):
    _, folder = whole("clean", optimizer="least_squares")

    def refuse(*args, **kwargs):
        raise AssertionError("pickle was used")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    assert FitResult.load(folder).score <= 1e-12


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist"),
        ("{", "is no JSON"),
        ('{"version": 99}', "no fit result of version 1"),
        ("[]", "no fit"),
    ],
)
def test_what_is_no_result_is_refused(content, message, tmp_path):
    if content is not None:
        (tmp_path / "result.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        FitResult.load(tmp_path / "result.json")


# ---------------------------------------------------------------- interruption and resuming


def interrupt_after(monkeypatch, method, count):
    """Make the n-th call of a checkpoint-writing method end in Ctrl-C."""
    original, calls = getattr(Optimization, method), []

    def wrapped(self, *args):
        original(self, *args)
        calls.append(1)
        if len(calls) == count:
            raise KeyboardInterrupt

    monkeypatch.setattr(Optimization, method, wrapped)


def same_result(resumed, whole):
    same = ("parameters", "score", "stop_reasons", "generations", "std", "rmse", "warnings", "simulated_steps")
    return all(getattr(resumed, name) == getattr(whole, name) for name in same)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("optimizer", "method", "count"),
    [
        ("cmaes", "_after_generation", 13),
        ("hybrid", "_after_generation", 3),
        ("hybrid", "_after_iteration", 1),
        ("hybrid", "_after_iteration", 5),
        ("least_squares", "_after_iteration", 4),
    ],
)
def test_an_interrupted_fit_ends_cleanly_and_resumes_to_the_same_result(
    optimizer, method, count, whole, recordings, tmp_path, no_report, monkeypatch
):
    options = {"optimizer": optimizer, "max_iteration": 20, "save_optimization_process": True}
    data = "wrong" if optimizer == "hybrid" else "noisy"  # the wrong one takes more iterations
    expected, whole_folder = whole(data, **options)
    with monkeypatch.context() as patch:
        interrupt_after(patch, method, count)
        half, folder = run(tmp_path, recordings[data], **options)
    assert half.stop_reasons == ["interrupted"] and (folder / "result.json").is_file()
    resumed, again = resume(folder, progress=Silent())
    assert again == folder and same_result(resumed, expected)
    assert json.loads((folder / "result.json").read_text())["stop_reasons"] == expected.stop_reasons
    if optimizer == "cmaes":
        one, other = (torch.load(f / "progress.pt", weights_only=True) for f in (folder, whole_folder))
        assert torch.equal(one["params"], other["params"]) and torch.equal(one["scores"], other["scores"])
        histories = [json.loads((f / "history.json").read_text())["search_best"] for f in (folder, whole_folder)]
        assert histories[0] == histories[1]


@pytest.mark.slow
def test_interrupted_twice_resumes_to_the_same_result(recordings, whole, tmp_path, no_report, monkeypatch):
    options = {"optimizer": "least_squares", "max_iteration": 20, "save_optimization_process": True}
    expected, _ = whole("noisy", **options)
    with monkeypatch.context() as patch:
        interrupt_after(patch, "_after_iteration", 3)
        _, folder = run(tmp_path, recordings["noisy"], **options)
    with monkeypatch.context() as patch:
        interrupt_after(patch, "_after_iteration", 2)
        resume(folder, progress=Silent())
    resumed, _ = resume(folder, progress=Silent())
    assert same_result(resumed, expected)


def test_interrupted_before_anything_is_known_still_ends_cleanly(recordings, tmp_path, no_report, monkeypatch):
    def at_once(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(WayDown, "begin", at_once)
    result, folder = run(tmp_path, recordings["clean"])
    assert result.stop_reasons == ["interrupted"] and (folder / "result.json").is_file()


@pytest.mark.slow
def test_a_result_is_written_before_it_is_checked_and_an_interrupted_check_leaves_it(
    recordings, tmp_path, no_report, monkeypatch
):
    """Ctrl-C during the checks left no result.json, although the result was printed."""

    def interrupted(*args):
        folder = next(tmp_path.rglob("result.json")).parent
        written.append(FitResult.load(folder))
        raise KeyboardInterrupt

    written = []
    monkeypatch.setattr(conclude, "change_without_step", interrupted)
    result, folder = run(tmp_path, recordings["noisy"], optimizer="least_squares")
    assert result.stop_reasons[-1] == conclude.CHECKS_INTERRUPTED
    assert written[0].parameters == FitResult.load(folder).parameters == result.parameters
    assert (folder / "best_trajectory.pt").is_file()
    with pytest.raises(KeyboardInterrupt):
        fit(settings(tmp_path / "passed_on", recordings["noisy"], optimizer="least_squares"), Silent(),
            assess_interrupted=False)  # fmt: skip


@pytest.mark.slow
def test_a_finished_run_resumes_to_itself(recordings, tmp_path, no_report):
    for optimizer in ("least_squares", "hybrid", "cmaes"):
        whole, folder = run(tmp_path, recordings["noisy"], optimizer=optimizer, max_iteration=4)
        settings = json.loads((folder / "settings.json").read_text())  # another version says the same in other words
        settings["resolved"]["configuration"]["sim2real"]["notes"] = ["bounds: as wide as can be"]
        (folder / "settings.json").write_text(json.dumps(settings))
        resumed, _ = resume(folder, progress=Silent())
        assert same_result(resumed, whole), optimizer


@pytest.mark.slow
def test_a_resumed_search_may_be_given_more_generations(recordings, tmp_path, no_report):
    whole, _ = run(tmp_path, recordings["noisy"], optimizer="cmaes", max_iteration=6)
    _, folder = run(tmp_path, recordings["noisy"], optimizer="cmaes", max_iteration=3)
    resumed, _ = resume(folder, max_iteration=6, progress=Silent())
    assert same_result(resumed, whole)


@pytest.mark.slow
def test_a_recording_that_has_changed_is_not_resumed(recordings, tmp_path, no_report):
    copy = tmp_path / "copy.npz"
    save_recording(copy, record(name="copy"))
    _, folder = run(tmp_path / "logs", str(copy), optimizer="cmaes", max_iteration=2)
    save_recording(copy, record(chirp(0.9), name="copy"))
    with pytest.raises(ValueError, match=r"copy\.npz has changed or gone since the run was started"):
        resume(folder)
    copy.unlink()
    with pytest.raises(ValueError, match=r"copy\.npz has changed or gone"):
        resume(folder)


def test_a_fit_in_which_everything_diverges_says_so(recordings, tmp_path, monkeypatch):
    wild = Drive(damping=np.array([1e8]), effort_limit=np.array([1e300]), saturation_effort=np.array([1e300]))
    recording = dataclasses.replace(load_recording(recordings["clean"]), drive=wild)
    path = save_recording(tmp_path / "wild.npz", recording)
    with pytest.raises(ValueError, match=r"the loop of servo is unstable at its step of 2\.5 ms\. kd dt / inertia"):
        run(tmp_path, str(path), optimizer="least_squares")  # told before anything is simulated
    monkeypatch.setattr("pace_optim.problem.problem.check_loops", lambda _, recordings: [""] * len(recordings))
    with pytest.raises(ValueError, match=r"simulation diverges.*Lower the bounds"):
        run(tmp_path, str(path), optimizer="least_squares")


def test_the_progress_names_what_runs_and_its_speed_and_is_never_silent(monkeypatch):
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr("pace_optim.terminal.progress.time.perf_counter", lambda: now[0])
    line = ProgressLine(out)
    now[0] = 100.0
    line.say("something before")
    now[0] = 120.0
    line.show("refine", done=2, total=10, error="error 1 mrad", spread=None, steps=2_000_000)
    assert "refine: 2/10 at most  error 1 mrad  100k steps/s  120 s" in out.getvalue()
    line.close()
    line.restart()
    assert line.elapsed == 0.0
    now[0] = 130.0
    line.say("the next fit")  # its clock begins anew; what is shown is the time of the command
    assert out.getvalue().endswith("\nthe next fit  130 s")


def test_the_progress_of_a_start_is_its_own(tmp_path):
    settings = FitSettings(task=BENCH, data=[str(save_recording(tmp_path / "r.npz", record()))], log_dir=str(tmp_path))
    problem, out = load_for_fit(settings, load_env_cfg(settings.task)), io.StringIO()
    run = Optimization(settings, problem, RunFolder(tmp_path), ProgressLine(out))
    x, stage = problem.space.start, "pieces"
    first = Descent(x=x, stage=stage, scores=[1e-8], iteration=4, stop_reason="converged")
    run._after_iteration([first, Descent(x=x, stage=stage)])
    run._after_iteration([first, Descent(x=x, stage=stage, scores=[1e-6], iteration=1)])
    run.progress.close()
    assert "fit on pieces: 4/15 at most  error of pieces 0.1 mrad" in out.getvalue()
    assert "fit on pieces from start 2: 1/15 at most  error of pieces 1 mrad" in out.getvalue()


def test_a_step_that_takes_long_is_named_again():
    out = io.StringIO()
    line = ProgressLine(out, seconds_between_times=0.1)
    line.wait_for("reading")
    assert out.getvalue() == ""
    time.sleep(0.35)
    line.close()
    assert out.getvalue().startswith("reading  0 s")


@pytest.mark.slow
def test_a_fit_that_took_long_tells_its_result_before_it_is_checked(tmp_path, monkeypatch):
    told = io.StringIO()
    monkeypatch.setattr("pace_optim.identification.conclude._LONG", 0.0)
    settings = FitSettings(task=BENCH, data=[str(save_recording(tmp_path / "r.npz", record()))], log_dir=str(tmp_path))
    fit(settings, ProgressLine(told))
    first, _, _ = told.getvalue().partition("That was the fit; checks follow")
    assert "error, all joints" in first and "armature" not in first  # the table comes once, at the end


def test_derivatives_are_taken_at_the_longest_step_that_the_drives_allow(tmp_path):
    (tmp_path / "stiff.xml").write_text(
        '<mujoco model="stiff"><compiler angle="radian"/><worldbody><body>'
        '<joint name="j" axis="0 1 0" range="-2 2"/>'
        '<inertial pos="0 0.02 -0.08" mass="0.5" diaginertia="2e-3 2e-3 1e-3"/></body></worldbody>'
        '<actuator><position joint="j" kp="160" kv="20" forcerange="-60 60"/></actuator></mujoco>'
    )
    recording = dataclasses.replace(record(), joint_names=("j",), drive=Drive(), load=Load())
    data = [str(save_recording(tmp_path / "r.npz", recording))]
    settings = FitSettings(task=str(tmp_path / "stiff.xml"), data=data, log_dir=str(tmp_path))
    run = Optimization(
        settings, load_for_fit(settings, load_env_cfg(settings.task)), RunFolder(tmp_path), ProgressLine()
    )
    fine, coarse = (evaluator._make_env(1).cfg.sim.dt for evaluator in (run.way.evaluator, run.way.evaluator._nearby))
    assert fine < coarse == 0.0025
