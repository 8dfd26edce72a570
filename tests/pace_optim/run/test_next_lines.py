"""What to type after a fit and after a diagnosis."""

from pathlib import Path

import pytest
from run_folders import make_result

from pace_optim.run.summary import above_noise, next_lines, summary


@pytest.mark.parametrize(("times", "verb"), [(1.2, "export"), (2.6, "diagnose"), (40.0, "diagnose")])
def test_one_rule_says_whether_something_is_missing(times, verb):
    """A fit at 2.6 times the noise named neither that something is missing nor the command that finds it."""
    result = make_result(times_noise=times)
    (line,) = next_lines(result, Path("run"))
    assert f"{verb}.py run" in line
    assert any("something is missing" in each for each in summary(result)) == (verb == "diagnose")


def test_after_a_diagnosis_all_three_next_steps_are_named():
    lines = next_lines(make_result(times_noise=2.6), Path("run"), diagnosed=True)
    assert [line.split()[1] for line in lines] == [f"scripts/{verb}.py" for verb in ("compare", "replay", "export")]


@pytest.mark.parametrize("reasons", [("interrupted",), ("converged", "checks interrupted")])
def test_a_fit_that_was_interrupted_is_resumed_first(reasons):
    """It ended without a next command, and a refit with the right effect was said to lack physics."""
    result = make_result(times_noise=3.2, stop_reasons=reasons)
    (line,) = next_lines(result, Path("run"))
    assert line.endswith("fit.py --resume run")
    assert ("interrupted" in above_noise(result)) == ("interrupted" in reasons)
