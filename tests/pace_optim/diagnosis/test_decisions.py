"""What a diagnosis decided can be decided again from its log, and every number that it decides by is in one place."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from decisions import read_cases, save_cases, table
from diagnoses import errors_of
from places import ROOT
from search_worlds import STANDS_IN, searched

from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.selection.decisions import Decision, as_lines, read_decisions
from pace_optim.diagnosis.selection.rules import decide, decided
from pace_optim.joints.fits.block_errors import BlockErrors

FOLDERS = [ROOT / "pace_optim" / room for room in ("diagnosis", "joints/fits")]
CASES = read_cases(sorted((Path(__file__).parent / "decisions").glob("*.jsonl*")))
"""The decisions of the reference: benchmarks/ablation.md."""
PLAIN = {0, 1, -1, 2, 0.5, 10, 100, 1e3, -1e3}
"""Numbers of arithmetic and units: halves, squares, tenths, percent, milli."""
GUARDS = {"_RIDGE", "_LEAST", "_MOST", "_POINTS"}
"""Of the linear algebra, and of a grid over which a maximum is taken: none decides anything."""
TELLING = {"_EFFECTS", "_LEAST_TOLD"}
"""How much is printed, and how exactly."""


@pytest.mark.parametrize("case", CASES)
def test_decisions_of_whole_diagnoses_come_out_as_they_did(case):
    for decision in CASES[case]:
        assert decided(decision) == decision.taken, decision.rule


def test_every_move_of_a_search_is_logged_and_comes_out_as_it_did(tmp_path):
    log: list[Decision] = []
    searched(STANDS_IN, log=log.append)
    path = tmp_path / "decisions.jsonl"
    path.write_bytes(as_lines(log))
    read = read_decisions(path.read_text(encoding="utf-8"))
    assert {decision.rule for decision in read} == {"look_ahead"}
    for decision in read:
        assert [bool(name) for name in decided(decision)] == [bool(name) for name in decision.taken]


def test_saved_cases_are_read_as_they_were(tmp_path):
    log: list[Decision] = []
    searched(STANDS_IN, log=log.append)
    save_cases({"two": log, "none": []}, tmp_path / "saved.jsonl.gz")
    read = read_cases([tmp_path / "saved.jsonl.gz"])
    assert read["none"] == [] and as_lines(read["two"]) == as_lines(read_decisions(as_lines(log).decode()))


def test_a_joint_with_fewer_blocks_is_kept_as_json_and_read_as_it_was():
    """Of walks: NaN stood in the file, which is no JSON."""
    square = torch.tensor([[4.0, 2.0], [3.0, torch.nan]], dtype=torch.float64)
    before = BlockErrors(square=square, weight=torch.ones(2, dtype=torch.float64))
    made = Decision.of("trim", [0, 1], before, {"trimmed": before}, {"trimmed": [1]})

    def refused(name):
        raise AssertionError(name)

    text = as_lines([made]).decode()
    json.loads(text, parse_constant=refused)
    (read,) = read_decisions(text)
    for own, other in ((made.before, read.before), (made.after["trimmed"], read.after["trimmed"])):
        assert torch.equal(own.square.nan_to_num(-1.0), other.square.nan_to_num(-1.0))
    assert read.places("trimmed") == made.places("trimmed") == [1]


def test_a_table_says_which_rules_acted_and_what_other_numbers_would_do():
    log: list[Decision] = []
    decide("pool", [0], errors_of(1e-3), {"torque_gain": errors_of(1.01e-3)}, cfg=DEFAULT, log=log.append)
    strict = replace(DEFAULT, judging=replace(DEFAULT.judging, alike=1.0))
    rows = table({"one": log, "two": log}, strict).splitlines()
    assert rows[2] == "| pool | 2 | 2 | 2 of 2 | 2 |"


def test_another_comparison_decides_otherwise():
    errors, after = errors_of(1.2e-3), {"stribeck_friction": errors_of(1e-3, roll=1)}
    facts = {"candidates": 30, "first": False}
    taken = decide("add", [0], errors, after, cfg=DEFAULT, log=lambda _: None, **facts)
    assert taken == {}  # 1.2 times is less than a further effect must bring
    lenient = replace(DEFAULT, judging=replace(DEFAULT.judging, next_effect=1.1, clear=1.1))
    assert decide("add", [0], errors, after, cfg=lenient, log=lambda _: None, **facts) == {0: "stribeck_friction"}


def test_a_rise_far_below_the_floor_does_not_refuse_one_value():
    """A joint at 1e-9 rad rose to 1e-8 rad, both without meaning, and all joints kept separate values."""
    given = {"joints": [0, 1], "before": errors_of(1e-3, 1e-9), "cfg": DEFAULT, "log": lambda _: None}
    small, large = ({"torque_gain": errors_of(1e-3, rmse)} for rmse in (1e-8, 1e-4))
    assert decide("pool", after=small, **given) == {}  # as recorded without a floor
    assert decide("pool", after=small, floor=[1e-5, 1e-5], **given) == {0: "torque_gain", 1: "torque_gain"}
    assert decide("pool", after=large, floor=[1e-5, 1e-5], **given) == {}


def test_every_rule_can_be_switched_off_and_no_other():
    assert not DiagnosisCfg(off=("pool",)).has("pool") and DiagnosisCfg().has("pool")
    with pytest.raises(ValueError, match=r"no rule 'pol'.*pool"):
        DiagnosisCfg(off=("pol",))


def numbers(path: Path) -> list[str]:
    """Numbers of a file that are neither arithmetic nor guards against a division by zero."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body:  # constants with a name that says what they are
        if isinstance(node, ast.Assign):
            names = {n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)}
            if names <= GUARDS | TELLING:
                node.value = ast.Constant(value=0)
    for node in ast.walk(tree):  # axes
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "permute":
            node.args = []
    found = [n for n in ast.walk(tree) if isinstance(n, ast.Constant) and type(n.value) in (int, float)]
    return [f"{path.name}:{n.lineno}: {n.value}" for n in found if n.value not in PLAIN and abs(n.value) > 1e-8]


def test_every_tuned_number_is_in_the_configuration():
    without = ("diagnosis_cfg.py", "fitting_cfg.py", "settings.py")
    files = [path for folder in FOLDERS for path in folder.rglob("*.py") if path.name not in without]
    assert [each for path in files for each in numbers(path)] == []


@pytest.mark.parametrize("name", ["diagnosis/diagnosis_cfg.py", "joints/fits/fitting_cfg.py"])
def test_every_tuned_number_is_documented(name):
    tree = ast.parse((ROOT / "pace_optim" / name).read_text(encoding="utf-8"))
    for part in (node for node in tree.body if isinstance(node, ast.ClassDef)):
        for node, after in zip(part.body, part.body[1:], strict=False):
            if isinstance(node, ast.AnnAssign) and part.name != "DiagnosisCfg":
                assert isinstance(after, ast.Expr), node.target.id


def test_whoever_is_given_numbers_passes_them_on():
    """A default left in force somewhere would decide by other numbers than those that are saved."""
    given, calls = {}, []
    for path in (path for folder in FOLDERS for path in folder.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                arguments = [*node.args.args, *node.args.kwonlyargs]
                names = [a.arg for a in arguments if a.arg == "cfg"]
                if names:
                    given[node.name] = [a.arg for a in arguments].index(names[0])
            elif isinstance(node, ast.Call):
                calls.append((path.name, getattr(node.func, "attr", getattr(node.func, "id", "")), node))
    for path, name, call in calls:
        if name in given and name not in ("__init__", "Fits"):
            passed = [k.arg for k in call.keywords]
            count = len(call.args) + (isinstance(call.func, ast.Attribute) and name in ("judged", "beats"))
            assert "cfg" in passed or count > given[name], f"{path}:{call.lineno}: {name}"
