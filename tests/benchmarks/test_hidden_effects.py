"""The benchmark of hidden effects: its cases, its resuming, its tables."""

import json
from pathlib import Path

import hidden_effects
import hidden_effects_cases
import pytest
from hidden_effects_cases import Job, make_jobs
from hidden_effects_table import declared, in_declared_set, make_table, top_1

from pace_optim.data_collection.plant import Case, library_effects, outside_effects


def line(group, effects, verdict, added=(), confounded=(), seed=0):
    ranking = [{"effect": name, "confounded_with": list(confounded), "validation_rmse_after": 1e-4} for name in added]
    return {
        "case": f"{group}_{effects}_{seed}",
        "group": group,
        "effects": list(effects),
        "verdict": verdict,
        "added": list(added),
        "ranking": ranking,
        "size": 1e-3,
        "rmse": {"before": 1e-3, "after": 1.1e-4, "truth": 1e-4 if effects else None},
        "seconds": {"recordings": 1.0, "diagnosis": 3.0, "true_fit": 4.0},
    }


RIGHT = line("effects", ["backlash"], "effect", ["backlash@shared"])
TWIN = line("effects", ["payload"], "effect", ["torque_gain"], ["payload"])
PAIR = line("pairs", ["backlash", "stribeck_friction"], "effect", ["stribeck_friction", "backlash"])
FALSE_ALARM = line("clean", [], "effect", ["quadratic_friction"])


def test_every_group_has_its_cases_and_no_two_share_a_name():
    jobs = make_jobs(hidden_effects_cases.GROUPS, range(3, 5), "bench", "battery", Path("x"))
    effects = len(library_effects())
    assert len(jobs) == 2 * (2 * effects + len(outside_effects()) + 3 + 2)
    assert len({job.case.name for job in jobs}) == len(jobs) == len({job.folder for job in jobs})
    assert {job.case.seed for job in jobs} == {3, 4}
    assert all(job.case.background > 0 for job in jobs if job.group == "background")


@pytest.mark.parametrize(
    ("groups", "robot", "message"), [(["efects"], "bench", "Available"), (["clean"], "arm", "leg")]
)
def test_unknown_groups_and_robots_are_named(groups, robot, message):
    with pytest.raises(ValueError, match=message):
        make_jobs(groups, range(1), robot, "battery", Path("x"))


def test_a_twin_counts_for_the_declared_set_and_not_as_named():
    assert top_1(RIGHT) and in_declared_set(RIGHT) and declared(RIGHT) == {"backlash"}
    assert not top_1(TWIN) and in_declared_set(TWIN)
    assert top_1(PAIR) and not top_1({**PAIR, "added": ["backlash"]})


def test_the_tables_count_what_was_named_missed_and_invented():
    missed = line("effects", ["backlash"], "nothing_missing", seed=1)
    unknown = line("outside", ["friction_map"], "unknown")
    broken = {"case": "b", "group": "clean", "effects": [], "error": "ValueError: it broke"}
    table = make_table([RIGHT, TWIN, PAIR, FALSE_ALARM, missed, unknown, broken])
    assert "7 cases, 1 with an error" in table and "it broke" in table
    assert "false alarms: 1 of 1 clean cases, 0 outside cases given a name" in table
    rows = {row.split()[0]: row.split() for row in reversed(table.splitlines()) if row}  # the first counts
    assert rows["effects"][:5] == ["effects", "3", "2/3", "1/3", "2/3"]
    assert rows["backlash"][1:] == ["backlash", "1,", "nothing_missing", "1"]


def test_effects_beside_a_background_are_counted_by_how_far_they_exceed_it():
    def beside(ratio, named, verdict="effect"):
        alone = {"effects": ratio * 1e-3, "background": 1e-3}
        return {**line("background", ["backlash"], verdict, named, seed=ratio), "alone": alone}

    found = [beside(3.5, ["backlash", "payload"]), beside(4, ["payload", "backlash"])]
    table = make_table([*found, beside(1.2, ["backlash"]), beside(0.5, [], "unknown")])
    _, *rows = table[table.index("error of the effect") :].splitlines()[:4]
    assert [row.split()[-4:] for row in rows] == [
        ["2", "1/2", "2/2", "0/2"],
        ["1", "1/1", "1/1", "0/1"],
        ["1", "0/1", "0/1", "1/1"],
    ]


def test_results_of_fits_alone_make_a_table_without_a_diagnosis():
    fitted = {key: value for key, value in RIGHT.items() if key not in ("verdict", "added", "ranking")}
    assert "true effect known" in make_table([fitted]) and "false alarms" not in make_table([fitted])


def test_a_run_goes_on_where_it_was(tmp_path, monkeypatch):
    class Serial:
        def __init__(self, *args): ...
        def __enter__(self):
            return self

        def __exit__(self, *args): ...
        def imap_unordered(self, function, jobs):
            return map(function, jobs)

    ran = []
    monkeypatch.setattr(hidden_effects, "pinned_pool", Serial)
    monkeypatch.setattr(hidden_effects, "run_job", lambda job: ran.append(job) or {"case": job.case.name})
    jobs = [Job(group="clean", case=Case(seed=seed), folder=tmp_path) for seed in range(3)]
    results = tmp_path / "r.jsonl"
    results.write_text(
        json.dumps({"case": jobs[0].case.name}) + "\n" + json.dumps({"case": jobs[1].case.name, "error": "e"})
    )
    results.write_text(results.read_text() + "\n")
    hidden_effects.run_all(jobs, results, 1)
    assert ran == jobs[1:], "what ended with an error runs again"
    assert len(hidden_effects.read_results(results)) == 3


def test_a_case_that_breaks_becomes_a_line(tmp_path):
    job = Job(group="effects", case=Case(effects=("stribek",)), folder=tmp_path)
    result = hidden_effects_cases.run_job(job)
    assert "Did you mean 'stribeck_friction'" in result["error"] and result["effects"] == ["stribek"]
