"""Which rules of the diagnosis decided anything, and what other numbers would have decided; nothing is simulated.

python benchmarks/hidden_effects.py --cases effects,clean --seeds 5
python benchmarks/decisions.py logs/hidden_effects/bench_battery/*.jsonl
python benchmarks/decisions.py logs/hidden_effects/bench_battery/*.jsonl --numbers judging.alike=1.05 verdict.scatter=.1
python benchmarks/decisions.py logs/hidden_effects/*/*.jsonl --save reference.jsonl.gz
"""

from __future__ import annotations

import argparse
import ast
import gzip
import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.selection.decisions import Decision, as_lines, read_decisions
from pace_optim.diagnosis.selection.rules import decided


def main() -> None:
    """Read and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="decisions of diagnoses, or a saved file")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write them all to one compressed file")
    parser.add_argument(
        "--numbers", nargs="+", default=[], metavar="PART.NAME=VALUE", help="other values of fields of DiagnosisCfg"
    )
    args = parser.parse_args()
    cfg = with_numbers(DEFAULT, args.numbers)
    cases = read_cases(args.files)
    if args.save is not None:
        save_cases(cases, args.save)
    print(table(cases, cfg))


def with_numbers(cfg: DiagnosisCfg, numbers: Sequence[str]) -> DiagnosisCfg:
    """A configuration with other numbers, each as ``judging.alike=1.05``, or a Python tuple of them."""
    for each in numbers:
        place, value = each.split("=")
        part, name = place.split(".")
        cfg = replace(cfg, **{part: replace(getattr(cfg, part), **{name: ast.literal_eval(value)})})
    return cfg


def read_cases(files: Sequence[Path]) -> dict[str, list[Decision]]:
    """The decisions of each case: of a file each, or of files that `save_cases` wrote."""
    cases: dict[str, list[Decision]] = {}
    for path in files:
        if path.suffix != ".gz":
            cases[path.stem] = read_decisions(path.read_text(encoding="utf-8"))
            continue
        for line in gzip.decompress(path.read_bytes()).decode().splitlines():
            saved = json.loads(line)
            cases[saved["case"]] = read_decisions("\n".join(json.dumps(each) for each in saved["decisions"]))
    return cases


def save_cases(cases: Mapping[str, Sequence[Decision]], path: Path) -> None:
    """Write the decisions of all cases to one file, a line of JSON each, compressed."""
    lines = (
        json.dumps({"case": name, "decisions": [json.loads(line) for line in as_lines(own).splitlines()]})
        for name, own in sorted(cases.items())
    )
    path.write_bytes(gzip.compress("".join(f"{line}\n" for line in lines).encode(), mtime=0))


def table(cases: Mapping[str, Sequence[Decision]], cfg: DiagnosisCfg = DEFAULT) -> str:
    """For each rule: how often it was asked, how often it changed a joint, in which cases, and what another way.

    Args:
        cases: Decisions of each case.
        cfg: Numbers that the decisions are made by again.
    """
    asked, acted, otherwise = Counter[str](), Counter[str](), Counter[str]()
    where: dict[str, list[str]] = defaultdict(list)
    for name, decisions in cases.items():
        for decision in decisions:
            asked[decision.rule] += 1
            if any(decision.taken):
                acted[decision.rule] += 1
                where[decision.rule].append(name)
            if decided(decision, cfg) != decision.taken:
                otherwise[decision.rule] += 1
    rows = [
        "| rule | asked | acted | cases it acted in | decided otherwise by the numbers given |",
        "|---|---|---|---|---|",
    ]
    for rule in sorted(asked, key=lambda rule: -asked[rule]):
        count = len(set(where[rule]))
        rows.append(f"| {rule} | {asked[rule]} | {acted[rule]} | {count} of {len(cases)} | {otherwise[rule]} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
