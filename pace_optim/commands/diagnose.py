"""Find out which physical effect a run's model lacks."""

import torch

from pace_optim.diagnosis import DiagnosisSettings, diagnose
from pace_optim.report import write_report
from pace_optim.terminal.cli import make_parser


def main() -> None:
    """Parse the command line, diagnose, print the verdict and what to do next."""
    parser = make_parser(
        "Find out which physical effect a run's model lacks: try all known ones, judge them on recordings that were "
        "not fitted, and fit the robot with those that pay.",
        example="scripts/diagnose.py logs/pace/anymal_d/26_11_21_12-00-00",
    )
    parser.add_argument("run", metavar="RUN", help="folder of a fit")
    parser.add_argument(
        "--effects", nargs="+", default=[], metavar="NAME", help="more candidates: your own as module:Class"
    )
    parser.add_argument("--only", action="store_true", help="try nothing but --effects")
    parser.add_argument("--max_effects", type=int, default=3, metavar="K", help="most effects of a joint (default 3)")
    parser.add_argument("--physics_dt", type=float, metavar="S", help="physics step (default: half a control step)")
    parser.add_argument(
        "--no_refit", dest="refit", action="store_false", help="do not fit the robot with what was found"
    )
    args = parser.parse_args()

    torch.set_num_threads(1)  # many small tensors
    diagnosis = diagnose(DiagnosisSettings(**vars(args)))
    print(f"verdict: {diagnosis.verdict}")
    print(diagnosis.summary)
    for entry in diagnosis.ranking[:8]:
        before, after = 1e3 * entry["validation_rmse_before"], 1e3 * entry["validation_rmse_after"]
        mark = "added" if entry["added"] else ("pays" if entry["significant"] else "does not pay")
        where = f"on {len(entry['joints'])} of {len(diagnosis.joints)} joints" if len(diagnosis.joints) > 1 else ""
        print(f"  {entry['effect']:26s} {before:8.3f} -> {after:8.3f} mrad  {mark:13s}  {where}".rstrip())
    for sentence in (*diagnosis.data, *diagnosis.advice):
        print(f"- {sentence}")
    for run in diagnosis.runs:
        print(f"report: {write_report(run)}")
    print(f"run: {diagnosis.runs[-1]}")
