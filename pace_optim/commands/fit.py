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
    add_facts_option,
    add_log_options,
    add_rate_option,
    add_several,
    number,
    take_common_options,
)
from pace_optim.terminal.progress import ProgressLine

_WITH_RESUME = ("--resume", "--max_iteration", "--task", "--import", "--diagnose", "--headless", "--device")
"""Options that a resumed run takes; it has the others from its start."""


_SHARES = {
    "fit on pieces from start": 0.45,
    "fit on pieces": 0.17,
    "far above the noise": 0.23,
    "fitting from the best of the search": 0.42,
    "fit on whole recordings": 0.62,
    "simulating with a finer step": 0.85,
    "fitting again": 0.88,
}
"""Part of a fit's time that has passed where a step begins: medians of 20 fits of 8 robots."""
_SHARES_WITH_RATES = {
    **{step: 0.55 * share for step, share in _SHARES.items()},
    "simulating other loop rates": 0.42,
    "simulating with a finer step": 0.9,
    "fitting again": 0.93,
}
"""The same where the rate of the drives' loops is not stated, so that others are tried."""


def main() -> None:
    """Parse the command line, fit, print the result."""
    parser = make_parser(
        "Identify armature, viscous friction, Coulomb friction and encoder bias of every joint, and the delay.",
        example="scripts/fit.py --task Pace-AnymalD-v0 --num_envs 512",
    )
    add_common_options(parser)
    add_device_option(parser)
    add = parser.add_argument
    add("--num_envs", type=int, default=512, help="simulations at once in a search (default 512)")
    add_several(parser, "--data", "FILE", "recordings or logs (default: the robot's sample)")
    add_log_options(parser)
    add_facts_option(parser)
    add_rate_option(parser)
    add("--trust_log", action="store_true", help="fit a log as it is although its checks name a fault, with a warning")
    joints = "joints to identify, the others are held where the log or the keyframe says (default: those of the log)"
    add("--joints", metavar="REGEX", help=joints)
    add_several(parser, "--validation", "FILE", "recordings kept for validation")
    add_several(parser, "--effects", "NAME", "effects to add: NAME, NAME@JOINTS, NAME[@JOINTS]@shared")
    links = "links whose inertial parameters are identified too: REGEX, or REGEX@mass,com,inertia,load with some of "
    add_several(parser, "--links", "REGEX", f"{links}these; load is a point mass on the link, such as a tool")
    unknown = f"unknown facts of the drives, to be identified: {', '.join(UNKNOWN_FACTS)}"
    add_several(parser, "--unknown", "FACT", unknown)
    residual = "what is fitted: position (default), or position effort with the measured torques too"
    add_several(parser, "--residual", "NAME", residual, choices=RESIDUALS)
    optimizer = f"{', '.join(OPTIMIZERS)} (default hybrid), or module:Class, a subclass of CMAESOptimizer whose tell() "
    add("--optimizer", default="hybrid", metavar="NAME", help=f"{optimizer}adds the scores")
    stop = "further rules that end the search: plateau, window, gradient, early_stopping, parameters, "
    stop += "target:score=S; with numbers as in plateau:generations=30,improvement=0.01"
    add_several(parser, "--stop", "RULE", stop)
    add("--max_iteration", type=int, help="largest number of generations of the search")
    add("--epsilon", type=number, help="stop at this relative spread of a generation's scores")
    add("--sigma", type=number, help="initial standard deviation of the search, normalised")
    add("--seed", type=int, default=0)
    longest = "fit at most so much of each recording, where it moves the joints most (default: what can be)"
    add("--max_duration", type=number, metavar="S", help=longest)
    add("--delay_mode", choices=DELAY_MODES, help="what is delayed: the command or the whole torque")
    add("--physics_dt", type=number, metavar="S", help="finer physics step under the same control rate")
    add_control_option(parser)
    rate = "time between two runs of the drives' own controllers (PD loops); 0: they run continuously"
    add("--drive_dt", type=number, metavar="S", help=rate)
    add("--joint_strategy", action="store_true", help="one search over all joints, not one per leg")
    add("--save_optimization_process", action="store_true", help="keep every generation in progress.pt")
    alone = "do not fit each recording alone to see whether they agree"
    add("--no_consistency", dest="check_consistency", action="store_false", help=alone)
    add("--log_dir", default="logs/pace", metavar="DIR", help="where runs are kept (default logs/pace)")
    add("--resume", metavar="RUN", help="go on with an interrupted run")
    diagnose = "then find out what the model lacks, as pace diagnose does with the run"
    add("--diagnose", action="store_true", help=diagnose)
    add("--headless", action="store_true", help="accepted for PACE's command lines; nothing is shown")
    args = vars(parser.parse_args())
    del args["headless"]
    then_diagnose = args.pop("diagnose")

    files = [os.path.basename(path) for path in (*args["data"], *args["validation"])]
    progress = ProgressLine()
    tries_rates = args["drive_dt"] is None and not args["resume"] and str(args["task"]).endswith((".xml", ".urdf"))
    progress.expect(_SHARES_WITH_RATES if tries_rates else _SHARES)
    progress.wait_for(f"reading {listed(files, 6) if files else 'the recording'}")  # the imports take a while too
    import torch

    from pace_optim.identification.fit import fit_with_torques, help_fit, resume
    from pace_optim.run.settings import FitSettings
    from pace_optim.run.summary import next_lines, summary
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
    if then_diagnose and not result.is_interrupted:
        from pace_optim.commands.diagnose import run_and_tell
        from pace_optim.diagnosis import DiagnosisSettings

        print(flush=True)
        run_and_tell(DiagnosisSettings(run=folder, device=device))
    else:
        print(f"report: {folder / 'report.html'}", *next_lines(result, folder), sep="\n")
        print(f"run: {folder}")


def missing_task() -> str:
    """What to say where ``--task`` is missing."""
    from pace_envs import load_env_cfg, registered_tasks

    known = [name for name in registered_tasks() if hasattr(load_env_cfg(name), "sim2real")]
    return (
        f"--task is missing. It takes a registered name ({', '.join(known)}), my_module:Name, my_file.py:Name, or a "
        "model file (robot.xml, robot.urdf). PACE's example is --task Pace-AnymalD-v0."
    )
