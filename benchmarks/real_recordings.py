"""Fit recordings of real drives: a small servo, a larger one, an arm of hobby servos, a legged robot.

The recordings are not part of this project; --source names the folder that holds them. real_recordings.md says whose
they are, how they are divided and what was found.

python benchmarks/real_recordings.py convert --output data/real
python benchmarks/real_recordings.py fit xl330
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from real_robots import ROBOTS, RealRobot, convert_robot, source_folder
from static_sag import sag_table, static_sag

from pace_envs import load_env_cfg
from pace_optim.diagnosis import DiagnosisSettings, diagnose
from pace_optim.identification.fit import fit
from pace_optim.report import write_report
from pace_optim.report.plots import plot_trajectories
from pace_optim.run.open import find_run
from pace_optim.run.result import FitResult
from pace_optim.run.settings import OPTIMIZERS, FitSettings
from pace_optim.run.summary import summary
from pace_optim.run.tensors import Trajectories
from pace_optim.terminal.cli import run_cli

SOURCE = Path(__file__).resolve().parents[2] / "shared" / "measurements"
PLOT_DPI = 90


def main() -> None:
    """Run a subcommand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, what, run in (
        ("convert", "write the recordings in our format", convert_command),
        ("fit", "convert, fit and say how large the error is on what was held out", fit_command),
        ("diagnose", "look for what is missing in the newest fit", diagnose_command),
        ("sag", "check the SO-101's signs and zeros by its lean under gravity", sag_command),
    ):
        command = commands.add_parser(name, help=what, description=what)
        command.set_defaults(run=run)
        command.add_argument(
            "--source", type=Path, default=SOURCE, help="folder of the recordings (default %(default)s)"
        )
        if name == "convert":
            command.add_argument("robots", nargs="*", metavar="ROBOT", help=f"of {', '.join(ROBOTS)} (default: all)")
        elif name != "sag":
            command.add_argument("robot", metavar="ROBOT", choices=ROBOTS, help=", ".join(ROBOTS))
            command.add_argument("--log_dir", type=Path, default=Path("logs/real"), help="where runs are kept")
        if name in ("convert", "fit"):
            command.add_argument("--output", type=Path, default=Path("data/real"), help="default %(default)s")
            command.add_argument("--whole", action="store_true", help="keep all of each file, not the usual part of it")
        if name == "fit":
            command.add_argument("--optimizer", choices=OPTIMIZERS, help="default: what the robot needs")
            command.add_argument("--effects", nargs="+", default=[], metavar="NAME", help="physical effects to add")
            command.add_argument(
                "--unknown", nargs="+", default=[], metavar="FACT", help="facts of the drive to identify"
            )
            command.add_argument("--physics_dt", type=float, metavar="S", help="finer physics step")
            command.add_argument("--delay_mode", help="command or effort")
            command.add_argument("--seed", type=int, default=0)
        if name == "diagnose":
            command.add_argument("--max_effects", type=int, default=3, help="largest number of effects to add")
            command.add_argument("--device", default="cpu", help="where single joints are simulated: cpu or cuda:0")
    args = parser.parse_args()
    torch.set_num_threads(1)  # the physics takes the cores; the tensors are small
    args.run(args)


def convert_command(args: argparse.Namespace) -> None:
    """Write recordings in our format."""
    if unknown := [name for name in args.robots if name not in ROBOTS]:
        raise ValueError(f"Unknown robot {unknown[0]!r}. Available: {', '.join(ROBOTS)}.")
    for name in args.robots or ROBOTS:
        robot = ROBOTS[name]
        for path in convert_robot(robot, args.source, args.output, args.whole):
            print(f"recording: {path}")
        print(f"{name}: {robot.licence}; the licence lies in {args.output / name}")


def fit_command(args: argparse.Namespace) -> None:
    """Convert, fit with the documented split, print errors by recording, draw."""
    robot = ROBOTS[args.robot]
    paths = {path.stem: str(path) for path in convert_robot(robot, args.source, args.output, args.whole)}
    more = {"effects": args.effects, "unknown": args.unknown}
    settings = FitSettings(
        task=robot.task,
        data=[paths[stem] for stem in robot.train],
        validation=[paths[stem] for stem in robot.validation],
        optimizer=args.optimizer or robot.optimizer,
        physics_dt=args.physics_dt,
        delay_mode=args.delay_mode,
        seed=args.seed,
        log_dir=str(args.log_dir / robot.name),
        **more,
    )
    result, folder = fit(settings)
    print(*summary(result), sep="\n")
    content = torch.load(folder / "best_trajectory.pt", weights_only=True)
    print("", *errors_table(content, result).split("\n"), sep="\n")
    for name, figure in plot_trajectories(Trajectories.of(content), title=robot.name).items():
        figure.savefig(folder / f"{name}.png", dpi=PLOT_DPI)
    print(f"plots: {folder}")
    print(f"run: {folder}")


def diagnose_command(args: argparse.Namespace) -> None:
    """Diagnose the newest run of a robot."""
    run = newest_run(ROBOTS[args.robot], args.log_dir)
    found = diagnose(DiagnosisSettings(run=str(run), max_effects=args.max_effects, device=args.device))
    print(f"{found.verdict}: {found.summary}", *found.evidence, sep="\n")
    for name, joint in found.joints.items():
        before, after = (1e3 * joint[f"validation_rmse_{when}"] for when in ("before", "after"))
        print(f"  {name:20s} {before:7.2f} -> {after:7.2f} mrad  {', '.join(joint['effects'])}")
    for each in found.runs:
        print(f"report: {write_report(each)}")
    print(f"run: {found.runs[-1]}")


def sag_command(args: argparse.Namespace) -> None:
    """Print the lean of the SO-101's joints and what follows from it."""
    folder = source_folder(ROBOTS["so101"], args.source)
    print(sag_table(static_sag(folder / "friction_gravity.npz")))


def newest_run(robot: RealRobot, log_dir: Path) -> Path:
    """The newest run of a robot.

    Raises:
        ValueError: If there is none.
    """
    return find_run(log_dir / robot.name, load_env_cfg(robot.task).sim2real.robot_name)


def errors_table(content: dict, result: FitResult) -> str:
    """Root mean square errors of every recording and joint [mrad], trained on and held out."""
    joints = content["joint_names"]
    lines = ["  ".join(["error [mrad]".ljust(34), *(joint[-13:].rjust(13) for joint in joints), "all".rjust(8)])]
    for recording in content["recordings"]:
        error = (recording["sim_dof_pos"] - recording["dof_pos"]).numpy()
        train = recording["train"].numpy().astype(bool)
        for part, what in ((train, "train"), (~train, "held out")):
            if part.any():
                values = 1e3 * np.sqrt(np.square(error[part]).mean(axis=0))
                cells = [f"{value:13.2f}" for value in values]
                total = 1e3 * np.sqrt(np.square(error[part]).mean())
                lines.append("  ".join([f"{recording['name']} ({what})".ljust(34), *cells, f"{total:8.2f}"]))
    for what in ("train", "validation"):
        cells = [f"{1e3 * result.rmse[what][joint]:13.2f}" for joint in joints]
        lines.append("  ".join([f"all ({what})".ljust(34), *cells, f"{1e3 * result.rmse[what]['all']:8.2f}"]))
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(run_cli(main))
