"""A diagnosis: its arithmetic on what is known, and whether it names a hidden effect."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from command_lines import run_script
from diagnoses import hidden_run, make_trial, outcome_of
from places import ROOT
from problems import BENCH, DT
from run_folders import make_result

from pace_actuators.effects import available_effects, get_effect
from pace_actuators.files import write_json
from pace_optim.diagnosis import candidate_effects
from pace_optim.diagnosis.candidates.screening import _explained
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.diagnosis.method import search_effects
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.diagnosis.selection.comparison import judge
from pace_optim.diagnosis.verdict.verdict import confounded, ranking, verdict
from pace_optim.joints.fits.block_errors import BlockErrors, block_errors, check_long_enough
from pace_optim.joints.fits.model import labels
from pace_optim.terminal.parallel import parallel_map

STRIBECK, QUADRATIC, GAIN = (get_effect(n) for n in ("stribeck_friction", "quadratic_friction", "torque_gain"))
SPRING, CREEP = get_effect("parallel_spring"), get_effect("creeping_friction")
FOLDS = DEFAULT.candidates.folds


# ------------------------------------------------------------------ screening


def columns(probes=2, samples=2000, seed=0):
    """Error, Jacobian, changes and folds of one joint and one recording."""
    generator = torch.Generator().manual_seed(seed)
    jacobian = torch.randn(3, samples, 1, 1, generator=generator)
    changes = torch.randn(probes, samples, 1, 1, generator=generator)
    noise = torch.randn(samples, 1, 1, generator=generator)
    fold = (torch.arange(samples) // 100 % FOLDS)[:, None]
    return jacobian, changes, noise, fold


def test_what_a_probe_causes_it_explains_and_its_size_is_found():
    jacobian, changes, noise, fold = columns()
    # errors are simulated less measured: the measured motion has three times the probe's change
    error = 5 * jacobian[0] - 3 * changes[1] + 0.01 * noise
    scores, sizes = _explained(error, jacobian, changes[:, None], fold, FOLDS)
    assert scores[1, 0] > 0.999 and abs(float(scores[0, 0])) < 0.02
    assert float(sizes[1, 0, 0]) == pytest.approx(3.0, rel=1e-2)


def test_what_the_parameters_explain_is_no_effect_s():
    jacobian, changes, noise, fold = columns()
    changes[0] = 0.5 * jacobian[1]
    scores, _ = _explained(jacobian[1] + 0.01 * noise, jacobian, changes[:, None], fold, FOLDS)
    assert float(scores.abs().max()) < 0.02


def test_noise_is_explained_by_nothing_and_a_probe_without_change_by_zero():
    jacobian, changes, noise, fold = columns(probes=20)
    changes[3] = 0.0
    scores, _ = _explained(noise, jacobian, changes[:, None], fold, FOLDS)
    assert float(scores.max()) < 0.02 and float(scores[3, 0]) == 0.0


# ------------------------------------------------------------------ acceptance


def noisy_blocks(count, level, generator):
    square = level * (1 + 0.3 * torch.randn(count, 1, generator=generator, dtype=torch.float64)).square()
    return BlockErrors(square=square, weight=torch.ones(count, dtype=torch.float64))


def test_the_best_of_many_equals_is_no_finding():
    generator = torch.Generator().manual_seed(1)
    alarms = 0
    for _ in range(40):
        before = noisy_blocks(20, 1.0, generator)
        alarms += any(judge(before, noisy_blocks(20, 1.0, generator), 0, 25, True).significant for _ in range(25))
    assert alarms <= 3


def test_a_real_fall_is_a_finding():
    generator = torch.Generator().manual_seed(2)
    found = judge(noisy_blocks(20, 1.0, generator), noisy_blocks(20, 0.2, generator), 0, 25, True)
    assert found.significant and found.ratio == pytest.approx(5**0.5, rel=0.3) and found.t > 3


def test_one_block_proves_nothing():
    generator = torch.Generator().manual_seed(3)
    found = judge(noisy_blocks(1, 1.0, generator), noisy_blocks(1, 0.01, generator), 0, 1, True)
    assert not found.significant and found.ratio > 5


@pytest.mark.parametrize(
    ("better", "worse", "pairs", "significant"),
    [
        (0.3, 1.05, 6, False),  # t = 3.1, and 4.7 are needed
        (0.3, 2.0, 6, False),  # it does not fall
        (0.85, 0.95, 6, False),  # by less than counts
        (0.2, 0.25, 6, True),
    ],
)
def test_an_uneven_fall_is_no_finding(better, worse, pairs, significant):
    after = torch.tensor([[better], [worse]] * pairs, dtype=torch.float64)
    before = BlockErrors(square=torch.ones_like(after), weight=torch.ones(len(after), dtype=torch.float64))
    assert judge(before, replace(before, square=after), 0, 29, True).significant is significant


def test_a_further_effect_must_bring_more_than_the_first():
    before = BlockErrors(square=torch.full((20, 1), 1.0).double(), weight=torch.ones(20).double())
    scatter = 1 + 1e-3 * torch.arange(20).double()[:, None]
    after = BlockErrors(square=scatter / 1.2**2, weight=torch.ones(20).double())
    assert judge(before, after, 0, 10, True).significant
    assert not judge(before, after, 0, 10, False).significant


def test_blocks_are_seconds_of_the_samples_that_count():
    error = torch.ones(2400, 2, 1)
    error[:, 1] = 2.0
    where = torch.zeros(2400, 2, dtype=torch.bool)
    where[200:2200, 0], where[:410, 1] = True, True  # 5 s, and 1.025 s, whose last part is too short
    blocks = block_errors(error, where, 0.0025)
    assert blocks.square[:, 0].tolist() == [1.0] * 5 + [4.0]
    assert blocks.weight.tolist() == [400.0] * 6
    assert float(blocks.mse[0]) == pytest.approx(1.5)


def test_a_joint_that_is_never_free_in_held_out_data_is_not_judged():
    """It had an error of 1 rad, and effects of other joints explained 0 % of that."""
    error, where = torch.full((800, 1, 2), 1e-4).double(), torch.ones(800, 1, dtype=torch.bool)
    weight = torch.ones(800, 1, 2).double() * torch.tensor([1.0, 0.0])
    errors = block_errors(error * weight, where, 0.0025, weight=weight)
    assert errors.mse.tolist() == pytest.approx([1e-8, 0.0])
    assert not judge(errors, errors, 1, 10, first=True).significant


@pytest.mark.parametrize(
    ("seconds", "count", "weight"),
    [
        ([20.0], 20, 400),
        ([1.8], 6, 120),  # of a short recording: shorter blocks, and as many
        ([1.2, 0.6], 6, 120),
        ([1.0], 4, 100),  # none shorter than a quarter of a second
        ([0.6], 2, 100),
    ],
)
def test_blocks_of_short_recordings_are_shorter(seconds, count, weight):
    where = torch.zeros(8000, len(seconds), dtype=torch.bool)
    for r, duration in enumerate(seconds):
        where[: round(duration / 0.0025), r] = True
    blocks = block_errors(torch.ones(8000, len(seconds), 1), where, 0.0025)
    assert blocks.weight.tolist() == [weight] * count


def test_a_leg_that_hardly_swings_has_one_block_which_judges_nothing():
    where, weight = torch.ones(2000, 1, dtype=torch.bool), torch.zeros(2000, 1, 2)
    weight[100:340, 0, 0] = weight[100:144, 0, 1] = 2.0  # 0.6 s, and one swing of 0.11 s
    before, after = (block_errors(torch.full((2000, 1, 2), e), where, 0.0025, weight=weight) for e in (2e-2, 2e-3))
    assert before.square[:, 0] == pytest.approx(torch.full((6,), 1e-4).double())
    assert before.square[:, 1].isnan().tolist() == [False] + [True] * 5
    assert before.mse == pytest.approx(torch.full((2,), 1e-4).double())
    assert [judge(before, after, joint, 29, True).significant for joint in (0, 1)] == [True, False]


def test_recordings_too_short_to_judge_by_are_refused(tmp_path):
    where = torch.zeros(400, 2, dtype=torch.bool)
    where[:200, 0] = where[100:301:2, 1] = True
    check_long_enough(where, 0.0025)
    where[100:, 0] = False
    with pytest.raises(ValueError, match=r"lasts 0\.75 s, .* expected 1 s or more\. Record for .*--validation"):
        check_long_enough(where, 0.0025)
    run = hidden_run(tmp_path, None, duration=2.5)
    data = run.problem.dataset
    short = replace(data, train=data.train | (torch.arange(len(data.train)) > 40)[:, None])
    with pytest.raises(ValueError, match="too short to judge"):
        search_effects(replace(run.problem, dataset=short), torch.zeros(5), [GAIN], 1)


@pytest.mark.parametrize("before", [False, True])
def test_a_search_flushes_denormal_numbers_and_puts_the_processors_setting_back(before, monkeypatch):
    tiny, seen = sys.float_info.min, []

    def first_step(*_):
        seen.append((tiny / 2, *parallel_map(lambda own: [tiny / 2 for _ in own], [1, 2], [GAIN, None])))
        raise KeyboardInterrupt

    module = sys.modules[search_effects.__module__]
    monkeypatch.setattr(module, "check_long_enough", lambda *_, **__: None)
    monkeypatch.setattr(module, "fit_base", first_step)
    problem = SimpleNamespace(dataset=SimpleNamespace(validation=None, carried=None), control_dt=DT)
    try:
        torch.set_flush_denormal(before)
        with pytest.raises(KeyboardInterrupt):
            search_effects(problem, torch.zeros(5), [GAIN], 1)
        assert seen == [(0.0, 0.0, 0.0)]
        assert (tiny / 2 == 0.0) is before
    finally:
        torch.set_flush_denormal(False)


# ------------------------------------------------------------------ verdict


@pytest.mark.parametrize(
    ("after", "expected"),
    [([1.0], "nothing_missing"), ([1.4], "nothing_missing"), ([1.6], "unknown"), ([1.0, 1.6], "unknown")],
)
def test_the_verdict_weighs_what_is_left_against_the_floor(after, expected):
    """A walk with a weak motor ended at twice the noise on one joint, and nothing was said to be missing."""
    floor, named = torch.ones(len(after), dtype=torch.float64), torch.zeros(len(after), dtype=torch.bool)
    assert verdict(outcome_of(after, after), floor, named)[0] == expected


def test_effects_are_named_as_fit_takes_them():
    outcome = outcome_of([1.0] * 3, [1.0] * 3, [STRIBECK, GAIN], [[True] * 3, [True, False, True]])
    assert labels(outcome.final.model, ("a", "b", "c")) == ["stribeck_friction", "torque_gain@a|c@shared"]


def test_the_ranking_begins_with_what_was_added_and_names_its_rivals():
    trials = [
        [make_trial(QUADRATIC, 0, 2e-4), make_trial(STRIBECK, 0, 2.1e-4), make_trial(GAIN, 0, 9e-4, significant=False)],
        [make_trial(STRIBECK, 1, 3e-4), make_trial(QUADRATIC, 1, 8e-4), make_trial(GAIN, 1, 9e-4, significant=False)],
    ]
    models = {STRIBECK: "with stribeck", QUADRATIC: "with quadratic"}
    this = Round(trials=trials, chosen=[STRIBECK, STRIBECK], rivals=[[QUADRATIC], []], models=models)
    outcome = outcome_of([1e-3] * 2, [3e-4] * 2, [STRIBECK], rounds=[this])
    entries = ranking(outcome, ("hip", "knee"))
    assert [e["effect"] for e in entries] == ["stribeck_friction", "quadratic_friction", "torque_gain"]
    assert [e["added"] for e in entries] == [True, False, False]
    assert [e["significant"] for e in entries] == [True, True, False]
    assert entries[0]["confounded_with"] == ["quadratic_friction"]
    assert entries[1]["confounded_with"] == ["stribeck_friction"]
    assert entries[0]["joints"] == ["hip", "knee"]
    pair = confounded(outcome)[0]
    assert (pair.chosen, pair.rival, pair.joints) == (STRIBECK, QUADRATIC, [0])
    assert pair.models == ("with stribeck", "with quadratic")
    json.dumps(entries)


def test_what_stays_unexplained_may_decide_between_effects():
    """Beside others as large, a delay (0.92 mrad) lost to a bandwidth (0.78 mrad), and only that was named."""
    trials = [make_trial(STRIBECK, 0, 7.8e-4), make_trial(QUADRATIC, 0, 9.2e-4), make_trial(GAIN, 0, 9.9e-4)]
    this = Round(trials=[trials], chosen=[STRIBECK], rivals=[[]])
    assert this.with_doubtful(torch.tensor([7.8e-4**2 - 1e-4**2])).rivals == [[QUADRATIC]]
    assert this.with_doubtful(torch.tensor([0.0])).rivals == [[]]
    assert replace(this, chosen=[None]).with_doubtful(torch.tensor([1.0])).rivals == [[]]
    exchanged = this.exchanged(0, QUADRATIC, tie=False)  # what was put aside for it stays aside
    assert exchanged.with_doubtful(torch.tensor([0.0])).rivals == [[]]
    implausible = [trials[0], replace(trials[1], implausible=True)]
    assert replace(this, trials=[implausible]).with_doubtful(torch.tensor([7.8e-4**2])).rivals == [[]]


def test_what_pays_no_longer_beside_what_was_added_is_not_said_to_pay():
    """A delay stood as "would pay" on a joint that another joint's effect had brought to the noise."""
    trials = [
        [make_trial(STRIBECK, 0, 2e-4), make_trial(QUADRATIC, 0, 2.1e-4), make_trial(GAIN, 0, 9e-4)],
        [make_trial(SPRING, 1, 5e-4), make_trial(CREEP, 1, 9.9e-4, significant=False)],
    ]
    this = Round(trials=trials, chosen=[STRIBECK, None], rivals=[[], []])
    status = {}
    for left in (1e-4, 1e-3):
        entries = ranking(outcome_of([1e-3] * 2, [3e-4, left], [STRIBECK], [[True, False]], [this]), ("hip", "knee"))
        status[left] = {entry["effect"]: entry["status"] for entry in entries}
        assert entries[0]["tried"] == {"hip": [pytest.approx(1e-3), pytest.approx(2e-4)]}
    assert status[1e-4] == {
        "stribeck_friction": "added",
        "quadratic_friction": "as good",
        "torque_gain": "leaves more",
        "parallel_spring": "leaves more",
        "creeping_friction": "does not pay",
    }
    assert status[1e-3]["parallel_spring"] == "would pay"


@pytest.mark.parametrize(
    ("after", "significant", "said"),
    [
        (3e-4, True, "the error falls from 1 to 0.3 mrad with it (t = 4.0 over blocks of up to one second). Sign: "),
        (9.5e-4, False, "falls from 1 to 0.95 mrad with it, less than the 1.1 times that count. Sign: "),
        (5e-4, False, "falls from 1 to 0.5 mrad with it, too unevenly to count (t = 4.0 over blocks"),
        (2e-3, False, "the error does not fall: from 1 to 2 mrad with it. Sign: "),
    ],
)
def test_the_evidence_says_what_came_of_an_effect_and_why_it_does_not_count(after, significant, said):
    this = Round(trials=[[make_trial(GAIN, 0, after, significant)]], chosen=[None], rivals=[[]])
    assert said in ranking(outcome_of([1e-3], [1e-3], rounds=[this]), ("hip",))[0]["evidence"]


def test_the_ranking_begins_with_what_was_added_in_any_round():
    trials = [[make_trial(GAIN, 0, 2e-4), make_trial(QUADRATIC, 0, 3e-4)]], [[make_trial(STRIBECK, 0, 1e-4)]]
    rounds = [
        Round(trials=own, chosen=[effect], rivals=[[]], models={})
        for own, effect in zip(trials, (GAIN, STRIBECK), strict=True)
    ]
    outcome = outcome_of([1e-3], [1e-4], [STRIBECK, GAIN], rounds=rounds)
    names = [e["effect"] for e in ranking(outcome, ["hip"])]
    assert names == ["torque_gain", "stribeck_friction", "quadratic_friction"]
    largest_first = [e["effect"] for e in ranking(outcome, ["hip"], order=[STRIBECK, GAIN])]
    assert largest_first == ["stribeck_friction", "torque_gain", "quadratic_friction"]
    assert labels(outcome.final.model, ["hip"], [GAIN, STRIBECK])[0].startswith("torque_gain")
    # where that is not what is missing, it is told first nevertheless, and counts for nothing
    unknown = ranking(outcome, ["hip"], "unknown", [STRIBECK, GAIN])
    assert [e["effect"] for e in unknown] == largest_first and not any(e["added"] for e in unknown)


# ------------------------------------------------------------------ from a run's folder


@pytest.mark.slow
def test_a_hidden_effect_is_named(tmp_path):
    run = hidden_run(tmp_path, "stribeck_friction", duration=2.0).folder
    done = run_script("diagnose", run, "--no_refit", "--max_effects", 1)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "verdict: effect"
    assert done.stdout.splitlines()[-1] == f"run: {run}"
    content = json.loads((run / "diagnosis.json").read_text())
    first = content["ranking"][0]
    assert "stribeck_friction" in {first["effect"], *first["confounded_with"]}
    assert first["validation_rmse_after"] < 0.5 * first["validation_rmse_before"]
    assert content["added"] == [first["effect"]] and content["runs"] == [str(run)]
    assert (run / "report.html").is_file()


@pytest.mark.slow
def test_where_nothing_is_missing_nothing_is_named(tmp_path):
    run = hidden_run(tmp_path, None).folder
    done = run_script("diagnose", run, "--no_refit", "--max_effects", 1)
    assert done.returncode == 0, done.stderr
    content = json.loads((run / "diagnosis.json").read_text())
    assert content["verdict"] == "nothing_missing" and content["added"] == []


OWN = '''
from pace_actuators.effects import Effect, EffectParameter, register_effect

@register_effect
class Lean(Effect):
    """A constant torque."""

    name = "lean_of_my_own"
    stage = "transmission"
    parameters = (EffectParameter(name="torque", unit="N m", lower=-3.0, upper=3.0, null=0.0, start=0.1, meaning="T"),)
    equation = "τ + T"
    looks = "a constant lean"
    source = "a test"

    def transmission(self, s):
        s.effort += self.torque
'''


@pytest.mark.slow
def test_an_effect_of_one_s_own_is_named_and_kept_when_its_refit_is_broken_off(warm, tmp_path):
    run = hidden_run(tmp_path, "torque_offset", duration=2.0).folder
    broken = """
import importlib, runpy, sys
module = importlib.import_module("pace_optim.diagnosis.diagnose")

def fit(settings, progress, **_):
    assert settings.effects == ["lean_of_my_own"] and settings.start["lean_of_my_own.torque"]["servo"] != 0.0
    raise KeyboardInterrupt

module.fit = fit
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    (tmp_path / "lean_effects.py").write_text(OWN)
    script = str(ROOT / "scripts" / "diagnose.py")
    options = ["--only", "--effects", "lean_effects:Lean", "--max_effects", "1"]
    done = warm.run("-c", broken, script, run, *options, cwd=tmp_path)
    assert done.returncode == 0 and "the diagnosis stands" in done.stderr, done.stderr
    assert done.stdout.startswith("each joint alone: effect, lean_of_my_own") and "\nverdict: effect\n" in done.stdout
    assert (run / "report.html").is_file()
    content = json.loads((run / "diagnosis.json").read_text())
    assert content["tried"] == ["lean_of_my_own"] and content["added"] == ["lean_of_my_own"]
    assert content["runs"] == [str(run)]


def test_candidates_are_all_registered_effects_or_only_one_s_own():
    every = candidate_effects()
    assert set(every) == {effect for effect in map(get_effect, available_effects()) if not effect.free_form}
    assert candidate_effects(["torque_gain"], only=True) == [GAIN]
    assert candidate_effects(["torque_gain"]) == every


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["RUN"], "is no run: it has no settings.json"),
        (["RUN", "--max_effects", "0"], "max_effects is 0, expected at least 1"),
        (["RUN", "--only"], "--only needs the effects to try"),
        (["FITTED", "--effects", "no_such_effect"], "There is no effect 'no_such_effect'"),
    ],
)
def test_bad_input_is_one_line_and_status_2(tmp_path, arguments, message):
    fitted = tmp_path / "fitted"
    fitted.mkdir()
    make_result(task=BENCH).save(fitted / "result.json")
    write_json(fitted / "settings.json", {"settings": {"task": BENCH}, "digests": {}})
    done = run_script("diagnose", *({"RUN": tmp_path, "FITTED": fitted}.get(word, word) for word in arguments))
    assert done.returncode == 2 and message in done.stderr, done.stderr
    assert "Traceback" not in done.stderr and len(done.stderr.strip().splitlines()) == 1
    assert not (fitted / "diagnosis.json").exists()
