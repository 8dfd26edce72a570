"""The whole way on ANYmal D with a hidden effect: record, fit, compare, diagnose, add what is missing, fit again."""

import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch

from pace_actuators.files import refuse_taken
from pace_optim.comparison import compare, comparison_lines
from pace_optim.data_collection import CollectionCfg, collect
from pace_optim.diagnosis import DiagnosisSettings, diagnose
from pace_optim.identification.fit import fit
from pace_optim.report import write_report
from pace_optim.run.settings import FitSettings
from pace_optim.run.summary import summary
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_overwrite_option, number
from pace_optim.terminal.progress import ProgressLine

TASK = "Pace-AnymalD-v0"
NOISE = 1e-4  # [rad]
PHYSICS_DT = 0.00125  # [s], as in the diagnosis: then the ladder shows what the effect does, and not the step
LOG_DIR = Path("logs/demo")
"""Its own folder: what it recorded there before is replaced."""
MOTIONS = {"train": ("chirp", "ramp", "steps"), "validation": ("multisine",)}


def record(effect: str, joints: str, duration: float, seed: int, folder: Path, overwrite: bool) -> dict[str, list[str]]:
    """Recordings to fit and, of another kind, to validate on, by a simulator that shares no code with ours."""
    cfgs = {
        motion: CollectionCfg(
            task=TASK,
            excitation=motion,
            duration=duration,
            seed=seed,
            effects=(effect,),
            effect_joints=joints,
            noise=NOISE,
            output=folder / f"{motion}.npz",
            overwrite=overwrite,
        )
        for motions in MOTIONS.values()
        for motion in motions
    }
    outputs = [cfg.output for cfg in cfgs.values() if cfg.output is not None]
    refuse_taken(outputs, option="--log_dir", overwrite=overwrite)  # all of them, before one is written
    with ProcessPoolExecutor() as pool:
        made = dict(zip(cfgs, pool.map(collect, cfgs.values()), strict=True))
    return {part: [str(made[motion].recordings[0]) for motion in motions] for part, motions in MOTIONS.items()}


def _compared(runs: Sequence[str | Path], progress: ProgressLine) -> list[str]:
    """The comparison of runs with their recordings, as lines."""
    progress.restart()
    progress.wait_for("simulating the recordings")
    lines = comparison_lines(compare(runs))
    progress.close()
    return lines


def main() -> None:
    """Run and print the five steps."""
    parser = make_parser(__doc__, example="scripts/demo.py --effect backlash --effect_joints '.*KFE'")
    parser.add_argument("--effect", default="stribeck_friction", help="what is hidden (default stribeck_friction)")
    parser.add_argument("--effect_joints", default=".*KFE", metavar="REGEX", help="where (default: the knees)")
    parser.add_argument("--seed", type=int, default=0, help="of the hidden parameters and the noise")
    parser.add_argument("--duration", type=number, default=6.0, metavar="S", help="of each recording (default 6)")
    parser.add_argument("--log_dir", type=Path, default=LOG_DIR, help="where all goes (default logs/demo)")
    add_overwrite_option(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)  # the physics takes the cores; the tensors are small

    print(f"1. Record: a simulated ANYmal D whose {args.effect_joints} have {args.effect}.", flush=True)
    progress = ProgressLine()
    progress.wait_for("simulating the recordings")
    files = record(
        args.effect,
        args.effect_joints,
        args.duration,
        args.seed,
        args.log_dir,
        args.overwrite or args.log_dir == LOG_DIR,
    )
    progress.close()
    print("2. Fit the base model, which does not have it.", flush=True)
    progress.restart()
    progress.wait_for("reading the recordings")
    result, base = fit(
        FitSettings(
            task=TASK,
            data=files["train"],
            validation=files["validation"],
            optimizer="least_squares",
            physics_dt=PHYSICS_DT,
            check_consistency=False,  # the story is another
            log_dir=str(args.log_dir),
        ),
        progress,
    )
    print(*summary(result), sep="\n")
    print("", "3. Compare: where does it fail?", sep="\n", flush=True)
    print(*_compared([base], progress), sep="\n")
    print("", "4. Diagnose: which effect is missing?", sep="\n", flush=True)
    diagnosis = diagnose(DiagnosisSettings(run=base, max_effects=2))
    print(diagnosis.summary, *diagnosis.evidence, sep="\n")
    hidden = json.loads(Path(files["train"][0]).with_suffix(".truth.json").read_text())["effects"]
    print("", f"The truth: {', '.join(hidden)} on {args.effect_joints}.", sep="\n")
    if len(diagnosis.runs) > 1:
        print("", "5. The ladder of the error, from the base model to the last effect:", sep="\n", flush=True)
        print(*_compared(diagnosis.runs, progress), sep="\n")
    for run in diagnosis.runs:
        print(f"report: {write_report(run)}")
    print(f"run: {diagnosis.runs[-1]}")
