"""The report tells what a diagnosis found."""

from dataclasses import replace

import pytest
from browser import CHROMIUM, Browser
from diagnoses import make_diagnosis
from report_pages import NASTY, page_of
from run_folders import JOINTS, make_result, write_run

from pace_actuators.files import write_json
from pace_optim.report import write_report


def folder_with(path, content):
    folder = write_run(path)
    write_json(folder / "diagnosis.json", content)
    return folder


def test_a_run_that_was_not_diagnosed_has_no_such_section(tmp_path):
    assert "diagnosis" not in page_of(write_run(tmp_path / "run")).ids


def test_it_says_what_is_missing_and_on_what_evidence(tmp_path):
    page = page_of(folder_with(tmp_path / "run", make_diagnosis()))
    assert {"diagnosis", "effect-ranking"} <= set(page.ids) and "error-map" not in page.ids
    for text in (
        "Missing: Stribeck friction at hip, knee, ankle",
        "--effects stribeck_friction",
        "4.30 → 0.400",
        "does not pay",
        "floor of noise and numerics",
        "4 effects were tried.",
        "cannot separate stribeck_friction from presliding_friction",
        *JOINTS,
    ):
        assert text in page.text, text
    assert "pre" in page.tags and not page.unbalanced


@pytest.mark.slow
def test_the_run_with_what_was_missing_is_not_told_to_add_it(tmp_path):
    with_it = folder_with(tmp_path / "with", make_diagnosis())
    make_result(effects=["stribeck_friction"]).save(with_it / "result.json")
    without = page_of(folder_with(tmp_path / "alone" / "run", make_diagnosis())).text
    assert "Add it" in without and "This run is the fit with it." not in without
    text = page_of(with_it).text
    assert "This run is the fit with it." in text and "What was missing is in this run" in text
    assert "Add it" not in text and "Missing in this run" not in text
    # the report of a diagnosed run names the run beside it
    text = page_of(folder_with(tmp_path / "without", make_diagnosis())).text
    assert "Missing in this run: Stribeck friction" in text and "The run with it: with" in text
    assert (
        text.index("The run with it") < text.index("This run is the fit without it") < text.index("The held-out error")
    )
    assert "Add it" not in text


CURVE = "torque_over_position@hip"
MORE = {"more": {"hip": "0.4 mrad, 40 floors"}}
"""The hip ends far from its floor."""
COVERED = {
    "joints": make_diagnosis()["joints"] | {"hip": make_diagnosis()["joints"]["hip"] | {"effects": [CURVE[:20]]}}
}
COVERED |= {"free_form": [CURVE], "paying": ["stribeck_friction@knee|ankle", CURVE]}
COVERED["joints"]["hip"]["effects"] = ["torque_over_position"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "run", "headline"),
    [
        (COVERED, {}, "Missing: Stribeck friction at knee, ankle. Covered by a curve: hip"),
        ({}, {}, "Missing: Stribeck friction at hip, knee, ankle"),
        (MORE, {}, "Missing: Stribeck friction at hip, knee, ankle. More is missing on hip (0.4 mrad, 40 floors)"),
        ({}, {"effects": ["stribeck_friction"]}, "What was missing is in this run: Stribeck friction"),
        (
            {},
            {"effects": ["stribeck_friction"], "std_means_nothing": True, "times_noise": 40.0},
            "In this run: Stribeck friction at hip, knee, ankle. More is missing: the error is 40 times the noise",
        ),
        (
            {"added": [], "verdict": "unknown", "paying": [CURVE], "free_form": [CURVE]},
            {},
            "Something is missing, and no known effect has earned its name",
        ),
        (
            {"added": [], "verdict": "unknown", "paying": ["stribeck_friction", CURVE], "free_form": [CURVE]},
            {},
            "Something is missing, and no known effect has earned its name",
        ),
        (
            {"added": [], "verdict": "nothing_missing"},
            {"std_means_nothing": True, "times_noise": 40.0},
            "No effect is missing, but this fit ended at 40 times the noise",
        ),
    ],
)
def test_the_headline_never_claims_more_than_the_verdict(tmp_path, content, run, headline):
    """ "100 % explained" stood beside "something else is missing"."""
    folder = folder_with(tmp_path / "run", make_diagnosis() | content)
    make_result(**run).save(folder / "result.json")
    text = page_of(folder).text
    assert text.count(headline) == 1
    good = headline.startswith(("What was", "Missing: ")) and "More" not in headline
    assert ('class="callout bad"' not in write_report(folder).read_text("utf-8").partition("Error of each")[0]) == good


@pytest.mark.slow
def test_the_run_with_a_wrong_link_is_not_told_to_add_it(tmp_path):
    mass = {"parameter": "link_mass", "unit": "kg", "file": 0.5, "found": 0.8, "std": 0.01}
    wrong = [{"link": "shank", "parts": ["mass"], "values": [mass], "label": "shank@mass"}]
    told = make_diagnosis("link") | {"added": [], "paying": [], "links": wrong}
    without, with_it = (folder_with(tmp_path / name, told) for name in ("alone/without", "with"))
    result = make_result()
    link = {"parameters": {"shank": 0.8}, "std": {"shank": 0.01}, "units": "kg"}
    result = replace(result, **{name: {**getattr(result, name), "link_mass": value} for name, value in link.items()})
    result.save(with_it / "result.json")
    text = page_of(without).text
    assert "Wrong in the model file: Mass of the link shank" in text and "--links shank@mass" in text
    text = page_of(with_it).text
    assert "What was missing is in this run" in text and "Add it" not in text


def test_commands_in_the_advice_can_be_copied(tmp_path):
    text = write_report(folder_with(tmp_path / "run", make_diagnosis())).read_text("utf-8")
    assert "<pre>scripts/data_collection.py --task Pace-Leg-v0 --excitation ramp</pre>" in text


def test_what_is_unknown_has_an_error_map(tmp_path):
    page = page_of(folder_with(tmp_path / "run", make_diagnosis("unknown")))
    assert "error-map" in page.ids
    assert "no known effect has earned its name" in page.text and "explains 80 % of it" in page.text


def test_nothing_missing_needs_no_chart(tmp_path):
    page = page_of(folder_with(tmp_path / "run", make_diagnosis("nothing_missing")))
    assert "Nothing is missing" in page.text and "effect-ranking" not in page.ids


def test_its_texts_are_escaped(tmp_path):
    content = make_diagnosis()
    content |= {"summary": NASTY, "advice": [NASTY], "data": [NASTY], "added": [NASTY]}
    content["ranking"][0] |= {"effect": NASTY, "evidence": NASTY}
    page = page_of(folder_with(tmp_path / "run", content))
    assert NASTY in page.text and "img" not in page.tags and not page.unbalanced


@pytest.mark.slow
@pytest.mark.parametrize("verdict", ["effect", "unknown"])
def test_it_is_drawn_without_a_complaint(tmp_path, verdict):
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    browser = Browser(tmp_path / "profile")
    try:
        report = write_report(folder_with(tmp_path / "run", make_diagnosis(verdict)))
        browser.open(report, ready="document.documentElement?.dataset.drawn === 'true'")
        assert not browser.problems
        assert browser.evaluate("document.querySelectorAll('#effect-ranking .barlayer .point').length") == 6
        assert browser.evaluate("document.querySelectorAll('#error-map .main-svg').length > 0") == (
            verdict == "unknown"
        )
    finally:
        browser.close()


def test_a_command_can_be_copied_where_joints_have_spaces_and_there_are_several(tmp_path):
    """`fit.py … --effects torque_ripple@A1 shoulder|A2` is two effects and a pipe."""
    folder = write_run(tmp_path / "run")
    write_json(folder / "diagnosis.json", make_diagnosis() | {"added": ["torque_ripple@A1 shoulder|A2"], "paying": []})
    assert "--effects 'torque_ripple@A1 shoulder|A2'" in page_of(folder).text


def test_a_curve_has_a_table_of_its_knots(tmp_path):
    """A user could not write a friction law from "9 values: see the report"."""
    knots = {
        "variable": "speed [rad/s]",
        "value": "friction [N m]",
        "at": [0.0, 0.24, 0.63],
        "torque": [6.4, 4.39, 3.86],
    }
    folder = write_run(tmp_path / "run")
    make_result(curves={"friction_over_speed": {"knee": knots}}).save(folder / "result.json")
    text = page_of(folder).text
    assert "knee, speed [rad/s] 0 0.24 0.63" in text and "friction [N m] 6.4 4.39 3.86" in text


def test_the_top_of_the_page_has_law_size_and_error_of_each_joint(tmp_path):
    content = make_diagnosis()
    size = {"effect": "stribeck_friction", "parameter": "effort", "joint": "knee", "value": 1.8, "std": 0.01}
    content["sizes"] = [size | {"unit": "N m", "factor": None, "at_bound": False}]
    content["joints"]["knee"]["training_rmse"] = 6e-4
    top = page_of(folder_with(tmp_path / "run", content)).text.partition("Error of each joint")[0]
    assert "knee stribeck_friction effort 1.8 ± 0.01 N m 4.30 0.400 / 0.600 2 / 3" in " ".join(top.split())
