"""Identify a robot's drives from recordings."""

import os
import sys

from pace_actuators.text import listed
from pace_optim.terminal.choices import DELAY_MODES, OPTIMIZERS, RESIDUALS, UNKNOWN_FACTS
from pace_optim.terminal.cli import given_options, make_parser
from pace_optim.terminal.options import (
    add_common_options,
    add_control_option,
    add_device_option,
    add_log_options,
    add_rate_option,
    number,
    take_common_options,
)
from pace_optim.terminal.progress import ProgressLine

_WITH_RESUME = ("--resume", "--max_iteration", "--task", "--import", "--diagnose", "--headless", "--device")
"""Options that a resumed run takes; it has the others from its start."""


def main() -> None:
    """Parse the command line, fit, print the result."""
    parser = make_parser(
        "Identify armature, viscous friction, Coulomb friction and encoder bias of every joint, and the delay.",
        example="scripts/fit.py --task Pace-AnymalD-v0 --num_envs 512",
    )
    add_common_options(parser)
    add_device_option(parser)
    parser.add_argument("--num_envs", type=int, default=512, help="simulations at once in a search (default 512)")
    parser.add_argument(
        "--data", nargs="+", default=[], metavar="FILE", help="recordings or logs (default: the robot's sample)"
    )
    add_log_options(parser)
    add_rate_option(parser)
    parser.add_argument(
        "--trust_log", action="store_true", help="fit a log as it is although its checks name a fault, with a warning"
    )
    parser.add_argument(
        "--joints",
        metavar="REGEX",
        help="joints to identify, the others are held where the log or the keyframe says (default: those of the log)",
    )
    parser.add_argument("--validation", nargs="+", default=[], metavar="FILE", help="recordings kept for validation")
    parser.add_argument(
        "--effects",
        nargs="+",
        default=[],
        metavar="NAME",
        help="effects to add: NAME, NAME@JOINTS, NAME[@JOINTS]@shared",
    )
    parser.add_argument(
        "--links",
        nargs="+",
        default=[],
        metavar="REGEX",
        help="links whose inertial parameters are identified too: REGEX, or REGEX@mass,com,inertia,load with some of "
        "these; load is a point mass on the link, such as a tool",
    )
    parser.add_argument(
        "--unknown",
        nargs="+",
        default=[],
        metavar="FACT",
        help=f"unknown facts of the drives, to be identified: {', '.join(UNKNOWN_FACTS)}",
    )
    parser.add_argument(
        "--residual",
        nargs="+",
        default=[],
        choices=RESIDUALS,
        metavar="NAME",
        help="what is fitted: position (default), or position effort with the measured torques too",
    )
    parser.add_argument(
        "--optimizer",
        default="hybrid",
        metavar="NAME",
        help=f"{', '.join(OPTIMIZERS)} (default hybrid), or module:Class, a subclass of CMAESOptimizer whose tell() "
        "adds the scores",
    )
    parser.add_argument(
        "--stop",
        nargs="+",
        default=[],
        metavar="RULE",
        help="further rules that end the search: plateau, window, gradient, early_stopping, parameters, "
        "target:score=S; with numbers as in plateau:generations=30,improvement=0.01",
    )
    parser.add_argument("--max_iteration", type=int, help="largest number of generations of the search")
    parser.add_argument("--epsilon", type=number, help="stop at this relative spread of a generation's scores")
    parser.add_argument("--sigma", type=number, help="initial standard deviation of the search, normalised")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--max_duration",
        type=number,
        metavar="S",
        help="fit at most so much of each recording, where it moves the joints most (default: what can be)",
    )
    parser.add_argument("--delay_mode", choices=DELAY_MODES, help="what is delayed: the command or the whole torque")
    parser.add_argument("--physics_dt", type=number, metavar="S", help="finer physics step under the same control rate")
    add_control_option(parser)
    parser.add_argument(
        "--drive_dt",
        type=number,
        metavar="S",
        help="time between two runs of the drives' own controllers (PD loops); 0: they run continuously",
    )
    parser.add_argument("--joint_strategy", action="store_true", help="one search over all joints, not one per leg")
    parser.add_argument("--save_optimization_process", action="store_true", help="keep every generation in progress.pt")
    parser.add_argument(
        "--no_consistency",
        dest="check_consistency",
        action="store_false",
        help="do not fit each recording alone to see whether they agree",
    )
    parser.add_argument("--log_dir", default="logs/pace", metavar="DIR", help="where runs are kept (default logs/pace)")
    parser.add_argument("--resume", metavar="RUN", help="go on with an interrupted run")
    parser.add_argument(
        "--diagnose", action="store_true", help="then find out what the model lacks, as pace diagnose does with the run"
    )
    parser.add_argument("--headless", action="store_true", help="accepted for PACE's command lines; nothing is shown")
    args = vars(parser.parse_args())
    del args["headless"]
    then_diagnose = args.pop("diagnose")

    files = [os.path.basename(path) for path in (*args["data"], *args["validation"])]
    progress = ProgressLine()
    progress.wait_for(f"reading {listed(files, 6) if files else 'the recording'}")  # the imports take a while too
    import torch

    from pace_optim.identification.fit import fit_with_torques, help_fit, resume
    from pace_optim.run.settings import FitSettings
    from pace_optim.run.summary import next_line, summary
    from pace_optim.terminal.processes import join

    args = take_common_options(args)
    torch.set_num_threads(1)  # the physics takes the cores; the tensors are small
    asked = args.pop("device")
    processes, device = join(asked or "cpu")
    if not processes.writes:
        progress.close()
        help_fit(processes, device, args["resume"], args["task"])
        return
    if run := args.pop("resume"):
        if ignored := [option for option in given_options(parser) if option not in _WITH_RESUME]:
            print(f"note: --resume goes on with the run's own settings; ignored: {', '.join(ignored)}", file=sys.stderr)
        own = asked and device
        result, folder = resume(
            run, args["max_iteration"], progress=progress, task=args["task"], device=own, processes=processes
        )
    else:
        if args["task"] is None:
            raise ValueError(missing_task())
        result, folder = fit_with_torques(FitSettings(**args, device=device), progress=progress, processes=processes)
    print(*summary(result), sep="\n")
    interrupted = any("interrupted" in reason for reason in result.stop_reasons)
    if then_diagnose and not interrupted:
        from pace_optim.commands.diagnose import run_and_tell
        from pace_optim.diagnosis import DiagnosisSettings

        print(flush=True)
        run_and_tell(DiagnosisSettings(run=folder, device=device))
    else:
        print(f"report: {folder / 'report.html'}", *([] if interrupted else next_line(result, folder)), sep="\n")
        print(f"run: {folder}")


def missing_task() -> str:
    """What to say where ``--task`` is missing."""
    from pace_envs import load_env_cfg, registered_tasks

    known = [name for name in registered_tasks() if hasattr(load_env_cfg(name), "sim2real")]
    return (
        f"--task is missing. It takes a registered name ({', '.join(known)}), my_module:Name, my_file.py:Name, or a "
        "model file (robot.xml, robot.urdf). PACE's example is --task Pace-AnymalD-v0."
    )
