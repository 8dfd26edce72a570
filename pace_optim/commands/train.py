"""Train a policy with rsl-rl."""

import os

# Before torch is imported: threads that wait for work must not keep the cores from the physics, or from other programs.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from pace_actuators import IdentifiedDrives
from pace_envs.registration import registered_tasks
from pace_envs.rl import RunSettings, resume, train
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_common_options, add_device_option, number, take_common_options
from pace_optim.terminal.processes import own_device


def main() -> None:
    """Parse the command line, train, print the run's folder."""
    parser = make_parser(
        "Train a policy that walks after a commanded velocity, with rsl-rl.",
        example="scripts/train.py --task Pace-AnymalD-Velocity-v0 --max_iterations 500",
    )
    add_common_options(parser)
    add_device_option(parser)
    parser.add_argument("--num_envs", type=int, help="robots at once (default: the task's)")
    parser.add_argument("--max_iterations", type=int, help="iterations in all (default: the task's)")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--reward", help="reward set (default: the task's own); walking tasks have velocity and energy")
    parser.add_argument("--randomize", action="store_true", help="train with pushes, over many frictions and loads")
    parser.add_argument("--identified", metavar="FILE", help="train with the drives of this fit: its result.json")
    parser.add_argument(
        "--randomize_identified", type=number, metavar="K", help="drives within K of their error bars (usually 1)"
    )
    parser.add_argument(
        "--physics_dt", type=number, metavar="S", help="step of physics and drives (default: the fit's)"
    )
    parser.add_argument(
        "--start_from", metavar="CHECKPOINT", help="go on from this policy in a new run, such as with other drives"
    )
    parser.add_argument("--log_dir", default="logs/rsl_rl", metavar="DIR", help="where runs are kept")
    parser.add_argument("--resume", metavar="RUN", help="go on with an interrupted or finished run")
    args = take_common_options(vars(parser.parse_args()))
    asked = args.pop("device")
    device = own_device(asked or "cpu")
    if run := args.pop("resume"):
        folder = resume(run, args["max_iterations"], task=args["task"], device=asked and device)
    else:
        if args["task"] is None:
            args["task"] = _task_for(args["identified"])
        folder = train(RunSettings(**args, device=device))
    if folder is not None:
        print(f"run: {folder}")


def _task_for(identified: str | None) -> str:
    """The task in which the robot of a fit walks or reaches."""
    known = [task for task in registered_tasks() if "-Velocity-" in task or "-Reach-" in task]
    if identified is None:
        raise ValueError(f"--task is missing. Available: {', '.join(known)}, or a task of yours (module:Task).")
    fitted = IdentifiedDrives.load(identified).task
    base = fitted.removesuffix("-v0")
    if task := next((task for task in known if task in (f"{base}-Velocity-v0", f"{base}-Reach-v0")), None):
        return task
    raise ValueError(
        f"{identified} is a fit of {fitted}, which has no task to train in. Available: {', '.join(known)}, or a task "
        "of yours: --task module:Task or FILE.py:Task."
    )
