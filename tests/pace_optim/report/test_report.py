"""The report says what a run found, holds everything it needs, and draws in a browser."""

import time
from itertools import pairwise

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Browser
from report_pages import NASTY, page_of
from run_folders import JOINTS, LABELS, make_result, make_trajectory, write_run

from pace_actuators.files import write_json, write_tensors
from pace_actuators.text import duration, value_and_error
from pace_optim.report import write_report
from pace_optim.report.markup import log_step
from pace_optim.report.sections import SECTIONS
from pace_optim.report.sections.correlation import strong_pairs
from pace_optim.report.sections.failure import _apart
from pace_optim.report.sections.parameters import _beside, nice_ticks
from pace_optim.report.sections.trajectories import samples_to_draw


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("logs") / "leg" / "26_01_01_00-00-00")


@pytest.fixture(scope="module")
def page(run):
    return page_of(run)


def test_it_names_every_joint_parameter_and_error(page):
    for joint in JOINTS:
        assert joint in page.text
    for words in ("Armature", "Viscous friction", "Friction", "Encoder bias", "Delay", "kg m²"):
        assert words in page.text
    assert "The held-out error is 4.3 mrad (RMS of all joints)" in page.text
    assert "The training error is 3.1 mrad." in page.text
    assert "The worst joint is ankle with 6.1 mrad." in page.text
    assert "12.50 0.25 ms 0 25" in page.text and "5 control steps of 2.5 ms" in page.text  # the delay
    assert "at its upper bound" in page.text and "cannot be separated from encoder bias" in page.text
    assert "resampled from 500 Hz." in page.text
    assert "scripts/fit.py --task Pace-Leg-v0" in page.text


def test_a_value_s_look_alikes_have_their_joints():
    """A viscous friction could not be separated "from viscous friction", that of another joint."""
    assert _beside("viscous_friction/knee", "viscous_friction/hip") == "viscous friction of knee"
    assert _beside("encoder_bias/hip", "viscous_friction/hip") == "encoder bias"
    assert _beside("delay/all", "viscous_friction/hip") == "delay"


def test_it_loads_nothing(page):
    assert all(load.startswith("data:") for load in page.loads), page.loads
    assert page.tags.count("script") > 1


def test_its_tags_are_balanced_and_its_ids_unique(page):
    assert not page.unbalanced
    assert len(page.ids) == len(set(page.ids))


@pytest.mark.slow
def test_what_a_run_says_is_escaped(tmp_path):
    folder = write_run(tmp_path / "run", make_result(warnings=[NASTY], notes=[NASTY], robot_name=NASTY, task=NASTY))
    content = make_trajectory()
    content["recordings"][0]["name"] = NASTY
    write_tensors(folder / "best_trajectory.pt", content)
    page = page_of(folder)
    assert NASTY in page.text
    assert "img" not in page.tags and not page.unbalanced
    assert "alert(1)</script>" not in write_report(folder).read_text("utf-8")


@pytest.mark.parametrize(("count", "folded"), [(3, 0), (4, 0), (5, 2)])
def test_many_warnings_do_not_hide_the_page(tmp_path, count, folded):
    result = make_result(warnings=[f"warning {i} of many" for i in range(count)])
    html = write_report(write_run(tmp_path / "run", result)).read_text("utf-8")
    shown, _, rest = html[html.index("read before") : html.index("Error of each joint")].partition("<details>")
    assert shown.count("of many") == count - folded and rest.count("of many") == folded
    assert (f"<summary>{folded} more</summary>" in rest) == bool(folded)


def test_a_warning_s_table_keeps_its_columns(tmp_path):
    warning = 'limits are wrong [W3]\n  joint  stated\n  knee       30\n  "effort_limit": {"knee": 50.0}'
    html = write_report(write_run(tmp_path / "run", make_result(warnings=[warning]))).read_text("utf-8")
    assert '<pre class="rows">joint  stated\nknee       30</pre><pre>&#34;effort_limit&#34;' in html


@pytest.mark.slow
def test_warnings_come_before_everything_else(tmp_path):
    text = page_of(write_run(tmp_path / "run", make_result(warnings=["friction of hip is at its upper bound"]))).text
    assert text.index("1 warning: read before") < text.index("Error of each joint") < text.index("Drag to zoom")
    text = page_of(write_run(tmp_path / "other", make_result())).text
    assert "No warnings" in text


def test_a_fit_that_was_cut_short_says_so(tmp_path):
    result = make_result(stop_reasons=["max_iteration 20"])
    text = page_of(write_run(tmp_path / "run", result)).text
    assert "stopped before it had converged (max_iteration 20)" in text


def test_without_validation_it_says_how_little_that_says(tmp_path):
    result = make_result(rmse={"train": make_result().rmse["train"], "validation": {}})
    folder = write_run(tmp_path / "run", result)
    content = make_trajectory()
    for recording in content["recordings"]:
        recording["train"] = torch.ones_like(recording["train"])
    write_tensors(folder / "best_trajectory.pt", content)
    text = page_of(folder).text
    assert "The training error is 3.1 mrad (RMS of all joints)" in text
    assert "Nothing was kept for validation" in text


@pytest.mark.slow
def test_sections_whose_files_are_missing_are_left_out(tmp_path):
    folder = write_run(tmp_path / "run")
    assert {"trajectories", "scores", "parameters"} <= set(page_of(folder).ids)
    for name in ("best_trajectory.pt", "history.json", "config.pt", "settings.json"):
        (folder / name).unlink()
    ids = set(page_of(folder).ids)
    assert "parameters" in ids and not {"trajectories", "scores"} & ids


def test_a_folder_without_a_result_is_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"result\.json does not exist"):
        write_report(tmp_path)


@pytest.mark.slow
def test_recordings_that_disagree_are_shown(tmp_path):
    folder = write_run(tmp_path / "run")
    assert "consistency" not in page_of(folder).ids
    content = {
        "recordings": ["chirp", "steps"],
        "values": {label: [1.0, 1.1] for label in LABELS},
        "std": {label: [0.01, None] for label in LABELS},
        "sentences": ["armature is another in steps."],
    }
    write_json(folder / "consistency.json", content)
    page = page_of(folder)
    assert "consistency" in page.ids and "armature is another in steps." in page.text


def test_values_that_are_no_numbers_do_not_break_it(tmp_path):
    folder = write_run(tmp_path / "run")
    content = make_trajectory()
    content["recordings"][0]["sim_dof_pos"][10:] = torch.nan
    write_tensors(folder / "best_trajectory.pt", content)
    assert "trajectories" in page_of(folder).ids


@pytest.mark.slow
def test_twelve_joints_stay_below_three_megabytes(tmp_path):
    names = [f"joint_{i}" for i in range(12)]
    folder = write_run(tmp_path / "run", make_result(joint_names=names))
    generator = torch.Generator().manual_seed(0)

    def recording(samples):
        motion = torch.randn(samples, 12, generator=generator, dtype=torch.float64)
        time = torch.arange(samples, dtype=torch.float64) * 0.0025
        part = {"time": time, "des_dof_pos": motion, "dof_pos": motion + 0.1, "sim_dof_pos": motion, "train": time < 9}
        return part | {"name": f"{samples}"}

    write_tensors(folder / "best_trajectory.pt", {"joint_names": names, "recordings": [recording(8000)]})
    assert write_report(folder).stat().st_size < 3e6
    content = {"joint_names": names, "recordings": [recording(60_000) for _ in range(3)]}
    write_tensors(folder / "best_trajectory.pt", content)
    start = time.perf_counter()
    assert write_report(folder).stat().st_size < 3.1e6
    assert time.perf_counter() - start < 10.0


def test_thinned_curves_keep_their_extremes_and_ends():
    count = 50_000
    curve = np.sin(np.arange(count) * 0.01)
    curve[12_345], curve[40_001] = 9.0, -7.0
    other = np.zeros(count)
    other[777] = 3.0
    kept = samples_to_draw((curve, other), 4000)
    assert {0, 777, 12_345, 40_001, count - 1} <= set(kept.tolist())
    assert len(kept) <= 4010 and np.all(np.diff(kept) > 0)
    assert np.array_equal(samples_to_draw((curve[:4000],), 4000), np.arange(4000))


@pytest.mark.parametrize(
    ("value", "std", "expected"),
    [
        (0.0138, 0.0033, ("0.0138", "0.0033")),
        (4.5, None, ("4.5", "–")),
        (0.1, 5e-11, ("0.1", "5.0e-11")),
        (123.4, 25.0, ("123", "25")),
    ],
)
def test_values_are_written_to_the_digits_that_are_known(value, std, expected):
    assert value_and_error(value, std) == expected


def test_strong_pairs_are_found_once_and_strongest_first():
    matrix = [[1.0, -0.95, None], [-0.95, 1.0, 0.99], [None, 0.99, 1.0]]
    assert strong_pairs(["a", "b", "c"], matrix) == [(0.99, "c", "b"), (-0.95, "b", "a")]


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.113, 0.27), (4.2, 4.9), (1e-5, 3e-5)])
def test_ticks_are_round_and_inside(low, high):
    ticks = nice_ticks(low, high)
    assert 2 <= len(ticks) <= 6 and low - 1e-12 <= ticks[0] and ticks[-1] <= high + 1e-12


def test_ticks_of_a_figure_are_more_than_one_and_do_not_overlap():
    assert log_step([0.3, 1.0, 3.0]) == "D2" and log_step([0.1, 90.0]) == 1
    edges = ["−0.05", "−0.031", "−0.012", "−0.0038", "0.0038", "0.012", "0.031", "0.05"]
    shown = [(i, text) for i, text in enumerate(_apart(edges, 9)) if text]
    assert len(shown) >= 4
    for (i, one), (j, other) in pairwise(shown):
        assert (j - i) * 40 / 9 > 0.5 * (len(one) + len(other))


def test_durations_read_well():
    assert [duration(s) for s in (8.8, 200, 8100)] == ["8.8 s", "3 min 20 s", "2 h 15 min"]


def test_every_section_has_its_own_anchor(page):
    assert len(SECTIONS) >= 7
    assert {"overview", "trajectories", "parameters", "correlation", "scores", "recordings", "making"} <= set(page.ids)


# ------------------------------------------------------------------ in a browser


@pytest.fixture(scope="module")
def browser(run, tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    browser = Browser(tmp_path_factory.mktemp("profile"))
    browser.open(write_report(run), ready="document.documentElement?.dataset.drawn === 'true'")
    yield browser
    browser.close()


@pytest.mark.slow
def test_it_opens_without_a_complaint_or_a_request(browser, run):
    assert not browser.problems
    own = (run / "report.html").resolve().as_uri()
    assert [url for url in browser.requests if url != own and not url.startswith(("data:", "about:"))] == []


def test_the_trajectories_open_on_the_largest_error(browser):
    recordings = make_trajectory()["recordings"]
    rms = np.array([(r["sim_dof_pos"] - r["dof_pos"]).square().mean(dim=0).sqrt().numpy() for r in recordings])
    r, j = np.unravel_index(rms.argmax(), rms.shape)
    assert (r, j) != (0, 0)
    for name, index in (("recording", r), ("joint", j)):
        chosen = f"document.querySelector('.explorer [data-choice={name}] input:checked').value"
        assert browser.evaluate(chosen) == str(index)


def test_every_figure_is_drawn(browser):
    drawn = "[...document.querySelectorAll('.canvas')].map((c) => c.querySelectorAll('svg.main-svg').length)"
    assert len(browser.evaluate(drawn)) == 3
    assert all(count > 0 for count in browser.evaluate(drawn))
    paths = "document.querySelectorAll('.explorer .scatterlayer .js-line').length"
    assert browser.evaluate(paths) == 4
    assert browser.evaluate(
        "document.querySelectorAll('.explorer .shapelayer path, .explorer .layer-below path').length"
    )


SHOWN = "document.querySelector('.explorer .canvas').data.map((trace) => Array.from(trace.y))"


def shown(browser) -> list[np.ndarray]:
    target, measured, simulated, error = browser.evaluate(SHOWN)[:4]
    return [np.array(values) for values in (target, measured, simulated, error)]


@pytest.mark.parametrize(("r", "j"), [(0, 1), (0, 2), (1, 0)])
def test_choosing_a_joint_and_a_recording_shows_their_curves(browser, r, j):
    for name, i in (("recording", r), ("joint", j)):
        browser.click(f"document.querySelector('[data-choice={name}] input[value=\"{i}\"]')")
    recording = make_trajectory()["recordings"][r]
    target, measured, simulated, error = shown(browser)
    assert target == pytest.approx(recording["des_dof_pos"][:, j].numpy(), abs=2e-6)
    assert measured == pytest.approx(recording["dof_pos"][:, j].numpy(), abs=2e-6)
    assert simulated == pytest.approx(recording["sim_dof_pos"][:, j].numpy(), abs=2e-6)
    expected = 1e3 * (recording["sim_dof_pos"] - recording["dof_pos"])[:, j].numpy()
    assert error == pytest.approx(expected, abs=1e-4)
    assert "mrad" in browser.evaluate("document.querySelector('.errors-here').textContent")


def test_clicking_on_a_joint_s_error_shows_it(browser):
    browser.click("document.querySelector('[data-joint=knee]')")
    assert browser.evaluate("document.querySelector('[data-choice=joint] input:checked').value") == "1"


@pytest.mark.slow
def test_the_score_can_be_seen_over_steps_and_time(browser):
    for label, last in (
        ("Simulated steps", 400_000 * 30 + 90_000 * 8),
        ("Time", 0.8 * 30 + 0.2 * 8),
        ("Iterations", 38),
    ):
        buttons = "[...document.querySelectorAll('#score .views button')]"
        browser.click(f"{buttons}.find((b) => b.textContent === '{label}')")
        shown_last = browser.evaluate("document.querySelector('#score .canvas').data.at(-1).x.at(-1)")
        assert shown_last == pytest.approx(last)


@pytest.mark.slow
def test_it_is_dark_where_the_reader_s_screen_is(run, tmp_path):
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    browser = Browser(tmp_path, dark=True)
    try:
        browser.open(write_report(run), ready="document.documentElement?.dataset.drawn === 'true'")
        assert browser.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(21, 23, 26)"
        assert not browser.problems
    finally:
        browser.close()
