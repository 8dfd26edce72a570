"""Logs and models of users' kinds, with known values: what the benchmark of cases finds is right."""

import json

import cases
import pytest
from cases import CASES, run, table
from command_lines import run_script
from places import SHARED

FILES = SHARED / "cases"
pytestmark = pytest.mark.skipif(not FILES.is_dir(), reason="shared/cases is absent")
LEG_ACTS_AT = 7.5
"""Its loop takes commands over every 2.5 ms: they are 6 ms late, and act then [ms]."""


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    """The command lines of a case; as processes of their own, most of their time is their start."""

    def call(script, *arguments):
        done = run_script(script, *arguments)
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    monkeypatch.setattr(cases, "_call", call)


def test_the_rows_have_their_files():
    for case in CASES.values():
        for path in (*case.logs, *([case.task] if "/" in case.task else [])):
            assert (FILES / path).exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_clocks", "timer_19_9_hz", "four_bar", "leg_mcap"])
def test_a_fit_reaches_what_is_true(name, tmp_path):
    case = CASES[name]
    run(name, case, FILES, tmp_path)
    found = json.loads((tmp_path / f"{name}.found.json").read_text())
    for group in ("armature", "viscous_friction", "friction"):
        for value in found["parameters"][group].values():
            assert value == pytest.approx(case.right[group], rel=0.05)
    for value in found["parameters"]["encoder_bias"].values():
        assert value == pytest.approx(case.right["encoder_bias"], abs=2e-3)
    right = LEG_ACTS_AT if name == "leg_mcap" else case.right["delay_ms"]
    assert 1e3 * found["delay_s"] == pytest.approx(right, abs=0.4)
    assert ("up to 7.5 ms" in " ".join([*found["notes"], *found["findings"]])) == (name == "leg_mcap")
    assert name in table(tmp_path)


@pytest.mark.slow
def test_commands_logged_more_slowly_than_they_were_sent_are_told(tmp_path):
    run("lerobot_leg", CASES["lerobot_leg"], FILES, tmp_path)
    found = json.loads((tmp_path / "lerobot_leg.found.json").read_text())
    assert "The drive probably received more commands than were logged" in " ".join(found["warnings"])
