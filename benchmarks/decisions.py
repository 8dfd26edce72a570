"""Which rules of the diagnosis decided anything, and what other numbers would have decided; nothing is simulated.

python benchmarks/hidden_effects.py --cases effects,clean --seeds 5
python benchmarks/decisions.py logs/hidden_effects/bench_battery/*.jsonl
python benchmarks/decisions.py logs/hidden_effects/bench_battery/*.jsonl --number alike=1.05 --number next_effect=1.15
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.judging.decisions import Decision, read_decisions
from pace_optim.diagnosis.judging.rules import decided


def main() -> None:
    """Read and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="decisions.jsonl of diagnoses")
    parser.add_argument(
        "--number", action="append", default=[], metavar="NAME=VALUE", help="another value of a field of JudgingCfg"
    )
    args = parser.parse_args()
    numbers = dict(each.split("=") for each in args.number)
    cfg = replace(DEFAULT, judging=replace(DEFAULT.judging, **{name: float(value) for name, value in numbers.items()}))
    print(table({path.stem: read_decisions(path.read_text(encoding="utf-8")) for path in args.files}, cfg))


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
