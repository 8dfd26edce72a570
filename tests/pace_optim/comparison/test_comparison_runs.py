"""Runs compared from the command line: what is written, what is printed, and what is refused."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Browser
from command_lines import run_script
from places import ROOT
from problems import BENCH, record
from run_folders import JOINTS, make_result, make_trajectory, write_run

import pace_optim.identification.fit as fit_module
from pace_actuators.files import write_tensors
from pace_optim.comparison import compare, comparison_lines
from pace_optim.comparison.compare import _carried
from pace_optim.identification.fit import fit
from pace_optim.recording import Load, load_recording, save_recording
from pace_optim.report import write_report
from pace_optim.report.sections.failure import _worst_place
from pace_optim.run.open import Run
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings
from pace_optim.run.summary import carried_by


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A fit of two repetitions and another load, 0.1 mrad of noise; the recordings' files by name."""
    folder = tmp_path_factory.mktemp("bench")
    made = {
        "first": record(name="first", noise=1e-4, seed=0),
        "again": record(name="again", noise=1e-4, seed=1),
        "heavy": record(name="heavy", load=Load(load_mass=1.6), noise=1e-4, seed=2),
        "other": record(name="other", load=Load(load_mass=1.3), noise=1e-4, seed=3),
    }
    files = {name: str(folder / f"{name}.npz") for name in made}
    for name, recording in made.items():
        save_recording(files[name], recording)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "write_report", lambda folder: None)
        settings = FitSettings(
            task=BENCH,
            data=[files["first"], files["again"]],
            validation=[files["heavy"]],
            optimizer="least_squares",
            log_dir=str(folder / "logs"),
        )
        _, run = fit(settings)
    return run, files


def written(run):
    return json.loads((run / "comparison.json").read_text())


def two_steps(tmp_path, **changes):
    """A base model and one more effect, on the same data, with a third of the error."""
    base, last = (write_run(tmp_path / name) for name in ("base", "last"))
    make_result(effects=["stribeck_friction"], **changes).save(last / "result.json")
    content = make_trajectory()
    for recording in content["recordings"]:
        recording["sim_dof_pos"] = recording["dof_pos"] + (recording["sim_dof_pos"] - recording["dof_pos"]) / 3
    write_tensors(last / "best_trajectory.pt", content)
    return base, last


# ---------------------------------------------------------------- what is written


@pytest.mark.slow
def test_a_good_fit_is_at_the_noise_floor(bench):
    run, _ = bench
    content = compare([run])
    assert content == written(run)
    assert content["version"] == 1 and content["run"] == str(run) and content["joint_names"] == ["servo"]
    joint = content["joints"]["servo"]
    assert joint["noise_floor"] == pytest.approx(1e-4, rel=0.15)
    assert joint["share_above_floor"] < 0.2 and "at the noise floor" in joint["sentence"]
    assert content["worst_places"] == [] and "a better model could explain little more" in content["summary"]
    result = json.loads((run / "result.json").read_text())
    assert joint["rmse"]["train"] == pytest.approx(result["rmse"]["train"]["servo"], rel=1e-4)
    assert joint["rmse"]["validation"] == pytest.approx(result["rmse"]["validation"]["servo"], rel=1e-4)
    assert (run / "report.html").is_file() and not content["notes"]


def test_repetitions_are_told_by_command_drive_and_load(bench):
    run, _ = bench
    recordings = compare([run])["recordings"]
    assert [r["repetitions"] for r in recordings] == [["again"], ["first"], []]
    sources = [r["noise_source"] for r in written(run)["joints"]["servo"]["recordings"]]
    assert sources == ["repetitions", "repetitions", "recording"]


def test_repetitions_that_differ_by_more_than_noise_are_no_proof_of_a_good_model(bench, tmp_path):
    """Their difference is the noise then, and the model was told to be as good as any."""
    run, files = bench
    changed = load_recording(files["again"])
    changed = replace(changed, name="worn", dof_pos=changed.dof_pos + 2e-3 * np.sin(changed.time)[:, None])
    save_recording(tmp_path / "worn.npz", changed)
    content = compare([run], data=[files["first"], str(tmp_path / "worn.npz")])
    note = next(note for note in content["notes"] if "have the same commands" in note)
    assert note.startswith("first, worn have") and "servo moved differently by" in note and "No one model" in note


def test_where_it_sits_is_there_for_each_recording(bench):
    run, _ = bench
    joint = compare([run])["joints"]["servo"]
    for where in (joint["where"], *(r["where"] for r in joint["recordings"])):
        assert {"speed", "direction", "since_reversal", "position", "load", "acceleration", "frequency"} <= set(where)
        for name, panel in where.items():
            if name != "frequency":
                assert len(panel["edges"]) == len(panel["time"]) + 1
                assert sum(panel["time"]) == pytest.approx(1.0, abs=1e-3), name
    assert [r["name"] for r in joint["recordings"]] == ["first", "again", "heavy"]


@pytest.mark.slow
def test_other_recordings_are_simulated_with_their_own_load(bench):
    run, files = bench
    content = compare([run], data=[files["other"], files["first"]])
    other, first = content["joints"]["servo"]["recordings"]
    assert set(other["rmse"]) == {"validation"} and other["rmse"]["validation"] == pytest.approx(1e-4, rel=0.3)
    assert set(first["rmse"]) == {"train"}  # the run was fitted to it
    assert content["data"] == [files["other"], files["first"]]
    own = compare([run])["joints"]["servo"]["recordings"][0]
    assert first["rmse"]["train"] == pytest.approx(own["rmse"]["train"], rel=1e-6)


def test_recordings_of_a_file_with_gaps_are_known_to_be_trained_on_or_not(bench, tmp_path):
    """What was trained on was listed by file: two parts of one file took the next file's, and the last had none."""
    run, files = bench
    whole = load_recording(files["other"])
    series = {name: np.concatenate([getattr(whole, name)] * 2) for name in ("dof_pos", "des_dof_pos")}
    series["time"] = np.concatenate([whole.time, whole.time + 2.0])
    np.savez(tmp_path / "gap.npz", **series, joint_names=["servo"], load_mass=1.3)
    content = compare([run], data=[str(tmp_path / "gap.npz"), files["first"]])
    assert [each["trained_share"] for each in content["recordings"]] == [0.0, 0.0, 1.0]


@pytest.mark.slow
def test_the_robots_own_sample_named_again_is_known_to_have_been_trained_on(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "write_report", lambda folder: None)
        _, run = fit(FitSettings(task=BENCH, optimizer="least_squares", log_dir=str(tmp_path)))
    again = compare([run], data=[str(ROOT / "assets" / "test_bench" / "chirp.npz")])
    assert again["recordings"][0]["trained_share"] == pytest.approx(0.7)


@pytest.mark.slow
def test_a_finer_physics_step_is_simulated_anew(bench):
    run, _ = bench
    coarse, fine = compare([run]), compare([run], physics_dt=0.00125)
    assert fine["physics_dt"] == 0.00125 and fine["rmse"]["train"] != coarse["rmse"]["train"]
    assert coarse["rmse"]["train"] < fine["rmse"]["train"]  # fitted at the coarse step: it fits there alone
    problem = Run.open(run).problem(physics_dt=0.00125)
    found = problem.space.from_dict(FitResult.load(run).parameters)
    score = float(problem.training_evaluator().residuals(found[None]).score[0])
    assert fine["rmse"]["train"] == pytest.approx(score**0.5, rel=1e-3)  # told with four digits
    compare([run])


def test_without_the_recordings_files_it_says_what_it_cannot(tmp_path):
    content = compare([write_run(tmp_path / "run")])
    assert "load" not in content["joints"]["hip"]["where"]
    assert any("no load torque" in note for note in content["notes"])
    assert set(content["joints"]) == set(JOINTS) and len(content["worst_places"]) <= 3


def test_the_ladder_is_in_the_last_run_alone(tmp_path):
    base, last = two_steps(tmp_path)
    ladder = compare([base, last])["ladder"]
    assert "ladder" not in written(base) and written(last)["ladder"] == ladder
    assert [step["name"] for step in ladder["steps"]] == ["base model", "stribeck_friction"]
    assert ladder["steps"][1]["ratio_to_previous"]["validation"] == pytest.approx(3.0, rel=1e-3)
    assert ladder["steps"][1]["rmse"]["train"]["all"] == pytest.approx(0.003 / 2**0.5 / 3, rel=0.05)
    assert (
        'id="ladder"' in (last / "report.html").read_text() and 'id="ladder"' not in (base / "report.html").read_text()
    )
    text = "\n".join(comparison_lines(written(last)))
    assert "stribeck_friction" in text and "3.00, 3.00" in text and "noise floor" in text


def test_the_error_is_split_by_recording_and_by_the_drive_s_state(bench):
    run, _ = bench
    content = compare([run])
    lines = comparison_lines(content)
    start = next(i for i, line in enumerate(lines) if line.startswith("recording"))
    assert [line.split()[0] for line in lines[start + 1 : start + 4]] == ["first", "again", "heavy"]
    heavy = content["joints"]["servo"]["recordings"][2]["rmse"]
    assert float(lines[start + 3].split()[1]) == pytest.approx(1e3 * next(iter(heavy.values())), rel=0.3)
    assert not any(line.startswith("drive") for line in lines)  # it is never off
    content["joints"]["servo"]["where"]["drive"] = {"rms": [0.002, 0.001]}
    off, on = comparison_lines(content)[(i := lines.index("", start)) + 2 : i + 4]
    assert off.split() == ["off", "2.00", "2.00", "servo"] and on.split() == ["on", "1.00", "1.00", "servo"]


# ---------------------------------------------------------------- the command line


def test_the_command_prints_the_places_and_ends_with_the_run(tmp_path):
    base, last = two_steps(tmp_path)
    done = run_script("compare", base, last)
    code, out, err = done.returncode, done.stdout, done.stderr
    assert code == 0, err
    lines = out.splitlines()
    assert lines[-1] == f"run: {last}" and lines[0].startswith("joint")
    for joint in JOINTS:  # once in the table; a recording or a run may name the worst
        assert sum(line.startswith(joint) for line in lines) == 1
    sentences = {p["joint"]: p["sentence"].removeprefix(f"{p['joint']}: ") for p in written(last)["worst_places"]}
    for joint, sentence in sentences.items():
        row = next(i for i, line in enumerate(lines) if line.startswith(joint))
        assert sentence in "".join(lines[row + 1 : row + 3])


def test_joints_at_the_noise_count_where_few_joints_are_said_to_hold_the_error():
    """Of six joints at 0.1 mrad, the one at 0.13 was said to hold 100 % of the squared error."""
    errors = {joint: 1.0e-4 for joint in "abcde"} | {"f": 1.3e-4}
    compared = [SimpleNamespace(content={"rmse": {"train": own}}) for own in errors.values()]
    assert _carried(list(errors), compared) == ""
    compared[-1].content["rmse"] = {"train": 1e-4, "validation": 9e-3}
    assert _carried(list(errors), compared).startswith("f holds 99.9 %")


def test_a_few_joints_that_hold_nearly_all_of_the_error_are_named():
    """Four calves held 99 % of a quadruped's error, and a reader added it up."""
    errors = {f"{leg}_{part}": 1.0 for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh")}
    calves = {f"{leg}_calf": 40.0 for leg in ("FL", "FR", "RL", "RR")}
    assert carried_by(errors | calves | {"all": 20.0}) == (
        "FL_calf, FR_calf, RL_calf and RR_calf hold 99.9 % of the squared error."
    )
    assert carried_by(errors) == "" and carried_by({"a": 9.0, "b": 1.0}) == "" and carried_by({"a": 0.0}) == ""


def test_help_shows_an_example():
    assert "example:\n  scripts/compare.py " in run_script("compare", "--help").stdout


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: [p / "nothing"], "There is no run"),
        (lambda p: [p], "result.json does not exist"),
        (lambda p: [write_run(p / "a"), p / "a"], "named twice"),
        (lambda p: [write_run(p / "a"), "--data", p / "gone.npz"], ""),
    ],
)
def test_bad_input_is_one_message(make, message, tmp_path):
    done = run_script("compare", *make(tmp_path))
    code, err = done.returncode, done.stderr
    assert code == 2 and err.startswith("error: ") and err.count("\n") == 1
    assert message in err


def test_an_unfinished_run_is_refused(tmp_path):
    run = write_run(tmp_path / "a")
    (run / "best_trajectory.pt").unlink()
    with pytest.raises(ValueError, match=r"best_trajectory\.pt yet"):
        compare([run])


def test_a_simulation_that_diverged_is_refused(tmp_path):
    run = write_run(tmp_path / "a")
    content = make_trajectory()
    content["recordings"][1]["sim_dof_pos"][5] = torch.nan
    write_tensors(run / "best_trajectory.pt", content)
    with pytest.raises(ValueError, match="simulation of steps diverges"):
        compare([run])


def renamed(content):
    content["recordings"][1]["name"] = "stairs"


def moved(content):
    content["recordings"][0]["dof_pos"] += 0.1


def shorter(content):
    for key in ("time", "des_dof_pos", "dof_pos", "sim_dof_pos", "train"):
        content["recordings"][0][key] = content["recordings"][0][key][:-10]


def split_elsewhere(content):
    content["recordings"][0]["train"][:] = True


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (renamed, "the recordings: chirp, steps against chirp, stairs"),
        (moved, "the content of chirp"),
        (shorter, "the length of chirp: 800 against 790 samples"),
        (split_elsewhere, "what was trained on of chirp: 70 % against 100 %"),
    ],
)
def test_runs_on_other_recordings_do_not_stand_side_by_side(change, message, tmp_path):
    base, last = two_steps(tmp_path)
    content = make_trajectory()
    change(content)
    write_tensors(last / "best_trajectory.pt", content)
    with pytest.raises(ValueError, match=message):
        compare([base, last])
    assert not (base / "comparison.json").exists()


def test_runs_of_other_tasks_do_not_stand_side_by_side(tmp_path):
    with pytest.raises(ValueError, match="the task: Pace-Leg-v0 against Pace-Arm-v0"):
        compare(two_steps(tmp_path, task="Pace-Arm-v0"))


# ---------------------------------------------------------------- the report


@pytest.mark.slow
def test_twelve_joints_and_six_recordings_stay_below_twelve_megabytes(tmp_path):
    names = [f"joint_{i}" for i in range(12)]
    run = write_run(tmp_path / "run")
    rmse = {name: 1e-4 for name in (*names, "all")}
    make_result(joint_names=names, rmse={"train": rmse, "validation": rmse}).save(run / "result.json")
    time = torch.arange(8000, dtype=torch.float64) * 0.0025
    noise = np.random.default_rng(0)

    def recording(k):
        position = 0.5 * torch.sin((2 + k) * time)[:, None] * torch.ones(12, dtype=torch.float64)
        measured = position + 1e-4 * torch.as_tensor(noise.standard_normal((8000, 12)))
        part = {"time": time, "des_dof_pos": position, "dof_pos": measured, "sim_dof_pos": position}
        return part | {"name": f"r{k}", "train": time < 14}

    content = {"joint_names": names, "recordings": [recording(k) for k in range(6)]}
    write_tensors(run / "best_trajectory.pt", content)
    compare([run])
    assert (run / "report.html").stat().st_size < 3.2e6


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    base, last = two_steps(tmp_path_factory.mktemp("logs"))
    compare([base, last])
    browser = Browser(tmp_path_factory.mktemp("profile"))
    browser.open(write_report(last), ready="document.documentElement?.dataset.drawn === 'true'")
    yield browser, written(last)
    browser.close()


@pytest.mark.slow
def test_the_page_opens_without_a_complaint_and_draws_every_figure(browser):
    page, _ = browser
    assert not page.problems
    drawn = page.evaluate(
        "[...document.querySelectorAll('#ladder .canvas, #failure .canvas')]"
        ".map((c) => c.querySelectorAll('svg.main-svg').length)"
    )
    assert len(drawn) == 7 and all(drawn)


@pytest.mark.parametrize(("worst", "place"), [([], (1, 0)), ([{"joint": "b"}], (2, 1))])
def test_the_worst_place_is_a_joint_and_its_worst_recording(worst, place):
    errors = {"a": [0.1, 0.3, 0.2], "b": [0.1, 0.2, 0.4]}
    joints = {
        name: {"recordings": [{"rmse": {"train": None, "validation": each}} for each in own]}
        for name, own in errors.items()
    }
    assert _worst_place({"joint_names": ["a", "b"], "worst_places": worst, "joints": joints}) == place


def test_the_curves_open_where_the_error_is_largest(browser):
    page, content = browser
    joint = content["worst_places"][0]["joint"]
    errors = [max(filter(None, each["rmse"].values())) for each in content["joints"][joint]["recordings"]]
    assert joint != JOINTS[0] or errors[0] < max(errors)  # otherwise the first ones would do
    for name, index in (("joint", JOINTS.index(joint)), ("recording", errors.index(max(errors)))):
        chosen = f"document.querySelector('.chooser [data-choice={name}] input:checked').value"
        assert page.evaluate(chosen) == str(index)


def test_the_sections_are_in_the_order_of_reading(browser):
    page, _ = browser
    ids = page.evaluate("[...document.querySelectorAll('section')].map((s) => s.id)")
    wanted = ["overview", "ladder", "trajectories", "failure", "parameters", "correlation"]
    assert [name for name in ids if name in wanted] == wanted


@pytest.mark.slow
def test_choosing_a_joint_and_a_recording_shows_its_numbers(browser):
    page, content = browser
    for r, j in ((0, 1), (1, 2)):
        for name, i in (("recording", r), ("joint", j)):
            page.click(f"document.querySelector('.chooser [data-choice={name}] input[value=\"{i}\"]')")
        page.evaluate("new Promise((done) => setTimeout(done, 300))")
        expected = content["joints"][JOINTS[j]]["recordings"][r]["where"]["velocity"]
        bars = page.evaluate("Array.from(document.querySelector('[data-figure=where] .canvas').data[0].y)")
        assert bars == pytest.approx([100 * share for share in expected["error"]], rel=2e-3, abs=1e-6)
        said = page.evaluate("document.querySelector('[data-figure=where] .said').textContent")
        assert JOINTS[j] in said
    assert not page.problems


def test_clicking_on_a_place_shows_its_joint(browser):
    page, _ = browser
    page.click("document.querySelector('#failure [data-joint=ankle]')")
    chosen = "document.querySelector('.chooser [data-choice=joint] input:checked').value"
    assert page.evaluate(chosen) == str(JOINTS.index("ankle"))
    shown = page.evaluate("document.querySelector('.explorer [data-choice=joint] input:checked').value")
    assert shown == str(JOINTS.index("ankle"))
