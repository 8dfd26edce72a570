"""Does the diagnosis name what an independent plant hid? Many seeded cases, resumable.

python benchmarks/hidden_effects.py --cases effects,clean --seeds 5 --workers 2
python benchmarks/hidden_effects.py --table

Each case's decisions lie beside its recordings: python benchmarks/decisions.py reads them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from pathlib import Path
from typing import Any

from decisions import with_numbers
from hidden_effects_cases import GROUPS, ROBOTS, Job, make_jobs, run_job
from hidden_effects_table import make_table
from workers import pinned_pool

from pace_optim.diagnosis.diagnosis_cfg import DiagnosisCfg


def read_results(path: Path) -> list[dict[str, Any]]:
    """The finished cases; of a case that ran again, the last."""
    if not path.is_file():
        return []
    lines = (json.loads(text) for text in path.read_text(encoding="utf-8").splitlines() if text.strip())
    return list({line["case"]: line for line in lines}.values())


def run_all(jobs: list[Job], results: Path, workers: int, limit: int | None = None) -> None:
    """Run what is not done and add a line for each; an interrupted run goes on where it was."""
    done = {line["case"] for line in read_results(results) if "error" not in line}
    left = [job for job in jobs if job.case.name not in done]
    left.sort(key=lambda job: hashlib.sha256(job.case.name.encode()).digest())  # a part of them is a fair sample
    print(f"{len(jobs)} cases, {len(jobs) - len(left)} done before")
    left = left[:limit]
    results.parent.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with pinned_pool(workers) as pool, results.open("a") as file:
        for i, line in enumerate(pool.imap_unordered(run_job, left), start=1):
            file.write(json.dumps(line) + "\n")
            file.flush()
            told = line.get("error") or f"{line.get('verdict', 'not diagnosed')} {' + '.join(line.get('added', []))}"
            print(f"{i}/{len(left)} {time.perf_counter() - start:6.0f} s  {line['case']}: {told[:160]}", flush=True)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="effects,clean,outside,pairs,harmonic", help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--only", nargs="+", metavar="EFFECT", help="cases that hide one of these (default: all)")
    parser.add_argument("--seeds", type=int, default=5, help="cases of each kind")
    parser.add_argument("--first_seed", type=int, default=0, help="seed of the first of them")
    parser.add_argument("--recordings", choices=("battery", "chirp"), default="battery")
    parser.add_argument("--robot", choices=tuple(ROBOTS), default="bench")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--max_effects", type=int, default=3, help="how many the diagnosis may add")
    parser.add_argument("--off", nargs="+", default=[], metavar="RULE", help="rules to switch off")
    parser.add_argument(
        "--numbers", nargs="+", default=[], metavar="PART.NAME=VALUE", help="other numbers, as judging.alike=1.05"
    )
    parser.add_argument("--physics_dt", type=float, default=0.00125, help="of the model [s]")
    parser.add_argument(
        "--ratio",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="diagnose only where effect / background is within",
    )
    parser.add_argument("--device", default="cpu", help="where single joints are simulated: cpu or cuda:0")
    parser.add_argument("--limit", type=int, metavar="N", help="only N of the cases that are left")
    parser.add_argument("--folder", type=Path, default=Path("logs/hidden_effects"), help="recordings, runs, results")
    parser.add_argument("--table", action="store_true", help="only print what the results say")
    args = parser.parse_args()
    results = args.folder / f"{args.robot}_{args.recordings}.jsonl"
    if not args.table:
        try:
            jobs = make_jobs(
                args.cases.split(","),
                range(args.first_seed, args.first_seed + args.seeds),
                args.robot,
                args.recordings,
                args.folder / f"{args.robot}_{args.recordings}",
                physics_dt=args.physics_dt,
                max_effects=args.max_effects,
                cfg=with_numbers(DiagnosisCfg(off=tuple(args.off)), args.numbers),
                ratio=tuple(args.ratio) if args.ratio else None,
                device=args.device,
            )
        except ValueError as error:
            sys.exit(f"error: {error}")
        if args.only:
            jobs = [job for job in jobs if set(args.only) & set(job.case.effects)]
        run_all(jobs, results, args.workers, args.limit)
    print(make_table(read_results(results)))


if __name__ == "__main__":
    main()
