"""The verdict comes first: on the terminal, in the report, and how large what was found is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diagnoses import FITS, errors_of, joint_alone, make_diagnosis, make_evidence, outcome_of
from report_pages import page_of
from run_folders import write_run

from pace_actuators.effects import get_effect
from pace_actuators.files import write_json
from pace_actuators.text import percent, size_text
from pace_optim.commands.diagnose import run_and_tell
from pace_optim.diagnosis import Diagnosis
from pace_optim.diagnosis.findings.text import lines_of, size_lines
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.verdict.names import hint
from pace_optim.diagnosis.verdict.sizes import factor_of, size_of, sizes
from pace_optim.diagnosis.verdict.verdict import likes
from pace_optim.estimate.error_bars.uncertainty import sandwich
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import JointModel

GAIN, SPRING = get_effect("torque_gain"), get_effect("parallel_spring")
SIZE = {
    "effect": "torque_gain",
    "parameter": "gain",
    "joint": "knee",
    "value": 0.45,
    "std": 0.0023,
    "unit": "1",
    "factor": 0.45,
    "at_bound": False,
}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "0.45 ± 0.002 times what was stated"),
        ({"std": None, "at_bound": True}, "0.45 times what was stated, at its bound"),
        ({"factor": None, "value": 1.2345, "unit": "N m", "std": 0.01}, "1.234 ± 0.01 N m"),
        ({"factor": None, "value": 0.1, "std": None}, "0.1"),
    ],
)
def test_a_size_is_told_with_its_error_bar_and_as_a_factor_where_it_is_one(changes, text):
    assert size_text(SIZE | changes) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (1.0, "100 %"),
        (0.9999, "over 99.9 %"),
        (0.9966, "99.7 %"),
        (0.876, "88 %"),
        (0.0042, "0.4 %"),
        (7e-7, "below 0.1 %"),
        (0.0, "0 %"),
        (-0.02, "-2 %"),
    ],
)
def test_a_share_is_told_as_a_person_reads_it(share, text):
    """It said 7e-05 %, and 100 % where joints were left at three floors."""
    assert percent(share) == text


@pytest.mark.parametrize(("std", "told"), [(0.01, 0.01), (0.0, None), (None, None), (float("nan"), None)])
def test_an_error_bar_that_is_no_number_is_left_out(std, told):
    assert size_of(GAIN, GAIN.parameters[0], 0.9, std, "hinge")["std"] == told


def test_what_multiplies_what_was_stated_is_a_factor():
    gain = GAIN.parameters[0]
    assert factor_of(GAIN, gain, gain.null) == 1.0
    assert factor_of(get_effect("torque_offset"), get_effect("torque_offset").parameters[0], 2.0) is None


def test_the_verdict_is_printed_first_then_likes_and_advice_and_sizes_with_the_fit():
    content = make_diagnosis() | {
        "sizes": [SIZE | {"at_bound": True}],
        "likes": {"torque_gain": ["payload"]},
        "advice": ["Record more."],
    }
    lines = lines_of(Diagnosis(**content))
    assert lines[0] == "verdict: effect" and lines[1] == content["summary"]
    assert lines[2:4] == ["torque_gain cannot be separated from payload.", "- Record more."]
    (size,) = size_lines(content["sizes"])
    assert size.startswith("  torque gain of knee: ") and size.endswith("times what was stated, at its bound")


def test_a_command_prints_the_verdict_once_and_the_three_next_steps_last(tmp_path, monkeypatch, capsys):
    """It stood before and after the fit of the whole robot."""
    runs = [str(write_run(tmp_path / name)) for name in ("run", "refit")]
    found = Diagnosis(
        **make_diagnosis() | {"runs": runs, "paying": ["stribeck_friction"], "evidence": ["It explains."]}
    )

    def diagnosed(_, progress, on_verdict):
        on_verdict(found)
        return found

    monkeypatch.setattr("pace_optim.commands.diagnose.diagnose", diagnosed)
    run_and_tell(None)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "each joint alone: effect, stribeck_friction; the fit of the whole robot decides"
    assert lines.count(found.summary) == lines.count("It explains.") == lines.count("verdict: effect") == 1
    assert [line.partition(":")[0] for line in lines[-5:]] == ["next", "next", "next", "report", "run"]
    (row,) = (line for line in lines if line.startswith("  stribeck_friction"))
    assert row.split(maxsplit=2)[1:] == ["added", "hip 4.30 -> 0.400, knee 4.30 -> 0.400, ankle 4.30 -> 0.400"]


def test_the_report_opens_with_the_verdict_its_sizes_and_the_run_that_has_it(tmp_path):
    folder, refit = write_run(tmp_path / "run"), write_run(tmp_path / "refit")
    content = make_diagnosis() | {
        "sizes": [SIZE | {"joint": f"joint_{i}", "value": i, "factor": None} for i in range(6)],
        "likes": {"torque_gain": ["payload"]},
    }
    content["runs"] = [str(folder), str(refit)]
    for each in (folder, refit):
        write_json(each / "diagnosis.json", content)
    pages = [page_of(each) for each in (folder, refit)]
    for page in pages:
        first = page.text.split("Error of each joint")[0]
        assert "Missing in this run: Stribeck friction at hip, knee, ankle" in first
        assert "stribeck_friction" in first and "torque_gain cannot be separated from payload" in first
    html = (folder / "report.html").read_text("utf-8"), (refit / "report.html").read_text("utf-8")
    assert 'href="../refit/report.html"' in html[0] and 'href="../run/report.html"' in html[1]


def ended(problem, final):
    """A search that ended with a model at 1 mrad."""
    errors = errors_of(*[1e-3] * len(final.x))
    return Outcome(problem=problem, base=final, base_errors=errors, final=final, final_errors=errors)


def test_sizes_and_error_bars_are_those_of_least_squares():
    robot = joint_alone()
    model, none = JointModel.base(robot.problem), torch.zeros(1, 1, dtype=torch.float64)
    extended, values = model.extended(robot.truth_values, GAIN, torch.tensor([True]), none + GAIN.parameters[0].null)
    now = FITS.side_by_side(robot.twins, [Fitted.start(extended, values)], max_iteration=2, keep_jacobian=True)[0]
    outcome = ended(robot.twins, now)
    (size,) = sizes(FITS, outcome, torch.ones(1), ("servo",))
    assert size["effect"] == "torque_gain" and size["joint"] == "servo" and not size["at_bound"]
    assert size["factor"] == pytest.approx(1.0, abs=0.02) and 0 < size["std"] < 0.02
    (far,) = sizes(FITS, outcome, torch.zeros(1), ("servo",))  # more is missing there
    assert far == size | {"std": None}


def hinge_and_slide(effect, *values):
    """A model of two joints with an effect, and its physical values."""
    robot = joint_alone()
    base = JointModel.base(robot.problem)
    base = replace(
        base,
        has=torch.zeros(0, 2, dtype=torch.bool),
        lower=base.lower.repeat(2, 1),
        upper=base.upper.repeat(2, 1),
        ranges=base.ranges.repeat(2, 1),
        slides=torch.tensor([False, True]),
        efforts=base.efforts.repeat(2),
        loops=base.loops.repeat(2),
    )
    own = torch.tensor([values] * 2, dtype=torch.float64)
    return base.extended(robot.truth_values.repeat(2, 1), effect, torch.tensor([True, True]), own)


def test_sizes_of_a_slide_have_its_units(monkeypatch):
    """A slide's spring had 200 N m/rad."""
    now = Fitted.start(*hinge_and_slide(SPRING, 2.0, 0.1))
    fits = SimpleNamespace(looked_closely=lambda _, now: now)
    monkeypatch.setattr("pace_optim.diagnosis.verdict.sizes.standard_deviations", lambda now: torch.zeros_like(now.x))
    monkeypatch.setattr("pace_optim.diagnosis.verdict.sizes._step_shares", lambda *_: torch.zeros_like(now.x))
    outcome = ended(None, now)
    found = sizes(fits, outcome, torch.ones(2), ("hip", "lift"))
    assert [size["unit"] for size in found] == ["N m/rad", "rad", "N/m", "m"]
    evidence = {1: make_evidence(1e-4, 1e-6, 1e-8)}
    assert [size["unit"] for size in hint(SPRING, 1, evidence, outcome, now).sizes] == ["N/m", "m"]


def test_a_value_that_joints_share_has_the_error_bar_of_them_all_and_of_the_step(monkeypatch):
    model, physical = hinge_and_slide(GAIN, 1.0)
    generator = torch.Generator().manual_seed(0)
    one = torch.randn(model.size, 400, 1, 1, generator=generator).repeat(1, 1, 1, 2)
    error = 1e-4 * torch.randn(400, 1, 1, generator=generator).repeat(1, 1, 2)
    alone = replace(Fitted.start(model, physical), jacobian=one, error=error)
    shared = replace(alone, model=replace(model, shared=frozenset({GAIN})), jacobian=None)

    class Fits:
        change, beside = 0.0, 0.0

        def looked_at(self, problem, models):
            return [replace(each, jacobian=one, error=error) for each in models]

        def looked_closely(self, problem, now):
            return replace(now, jacobian=one, error=error)

        def trained_errors(self, problem, now):
            return error + self.change * one[model.columns(GAIN).start] + self.beside

    problem = SimpleNamespace(physics_dt=1e-3, with_physics_dt=lambda dt: None)
    stds = [
        [size["std"] for size in sizes(Fits(), ended(problem, final), torch.ones(2), ("hip", "knee"))]
        for final in (alone, shared)
    ]
    assert stds[0][0] == stds[0][1] > 0 and stds[1] == pytest.approx([stds[0][0] / np.sqrt(2)] * 2)
    # a finer step changes the errors as 0.01 more of the normalised gain does: the value makes up for that
    monkeypatch.setattr(Fits, "change", 0.01)
    (with_step, _) = sizes(Fits(), ended(problem, alone), torch.ones(2), ("hip", "knee"))
    slope = float(model.box.slope(alone.x)[0, model.columns(GAIN).start])
    assert with_step["std"] == pytest.approx(np.hypot(stds[0][0], 0.01 * slope * 4 / 3), rel=1e-3)
    # nothing of what no parameter makes up for is in the recording: this very step made it
    monkeypatch.setattr(Fits, "beside", 0.1 * torch.randn(400, 1, 2, generator=generator))
    (made_by_it, _) = sizes(Fits(), ended(problem, alone), torch.ones(2), ("hip", "knee"))
    assert made_by_it["std"] == pytest.approx(stds[0][0], rel=1e-6)


def test_the_covariance_of_white_noise_is_that_of_ordinary_least_squares():
    generator = np.random.default_rng(0)
    columns, error = generator.normal(size=(2, 4000, 1)), 0.1 * generator.normal(size=(4000, 1))
    flat = columns[..., 0]
    expected = 0.01 * np.linalg.inv(flat @ flat.T)
    assert np.sqrt(sandwich(columns, error).diagonal()) == pytest.approx(np.sqrt(expected.diagonal()), rel=0.1)


def test_what_only_a_sum_shows_is_known_by_its_bounds_alone():
    """An encoder bias and the phase of a ripple on a joint that gravity does not load: had error bars of 200 N m."""
    generator = np.random.default_rng(0)
    first, second = generator.normal(size=(2, 4000, 1))
    error = 0.1 * generator.normal(size=(4000, 1))
    covariance = sandwich(np.stack([first, first, second]), error, prior=1 / 3)
    apart = sandwich(np.stack([first, second]), error)
    assert covariance[0, 0] == pytest.approx(1 / 6, rel=0.01)  # half of what both were free by
    assert covariance[:2, :2].sum() == pytest.approx(apart[0, 0], rel=0.01)  # while their sum is known
    assert covariance[2, 2] == pytest.approx(apart[1, 1], rel=0.01)


def test_likes_are_the_rivals_of_what_the_model_has_in_the_end():
    other = get_effect("payload")
    round_ = SimpleNamespace(chosen=[GAIN, None], rivals=[[other], []], models={GAIN: None, other: None})
    outcome = outcome_of([1e-3, 1e-3], [1e-4, 1e-3], [GAIN], [[True, False]], [round_])
    assert likes(outcome) == {"torque_gain": ["payload"]}
    assert likes(outcome_of([1e-3] * 2, [1e-4] * 2, [GAIN], [[False, True]], [round_])) == {}
