"""Play a trained policy: figures, a film, a window, an export. Or replay a fit where it is to be trained with."""

import os
import sys
from ctypes.util import find_library

HAS_SCREEN = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
if sys.platform == "linux" and not HAS_SCREEN and find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported: films need no screen

from pace_envs.rl import PlaySettings, RunSettings, load_cfg, play  # noqa: E402
from pace_optim.terminal.cli import make_parser  # noqa: E402
from pace_optim.terminal.options import (  # noqa: E402
    add_common_options,
    add_device_option,
    add_overwrite_option,
    number,
    take_common_options,
)
from pace_optim.terminal.progress import ProgressLine  # noqa: E402


def main() -> None:
    """Parse the command line, play, print the figures."""
    parser = make_parser(
        "Let a trained policy walk and print how well it follows the commanded velocity, how often it falls, and its "
        "cost of transport.",
        example="scripts/play.py --checkpoint logs/rsl_rl/anymal_d_velocity/<run> --video walk.mp4",
    )
    parser.add_argument("--checkpoint", metavar="FILE", help="model_<n>.pt, or a run for its last one")
    add_common_options(parser, run=True)
    add_device_option(parser)
    parser.add_argument("--num_envs", type=int, default=256, help="robots that are judged (default 256)")
    parser.add_argument("--seconds", type=number, default=20.0, metavar="S", help="how long (default 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--command", type=number, nargs=3, metavar=("VX", "VY", "WZ"), help="one command for all robots"
    )
    parser.add_argument("--video", metavar="FILE", help="film of the first robot, .mp4 or .gif; without a screen too")
    parser.add_argument("--viewer", action="store_true", help="open a window instead")
    parser.add_argument("--export", metavar="DIR", help="write the policy as TorchScript and ONNX")
    add_overwrite_option(parser)
    parser.add_argument("--identified", metavar="FILE", help="walk on the drives of this fit: its result.json")
    parser.add_argument(
        "--replay",
        metavar="RUN",
        help="instead, replay the recordings of this fit in --task (default: its own environment), the base held",
    )
    parser.add_argument("--physics_dt", type=number, metavar="S", help="with --replay: step of physics and drives")
    args = take_common_options(vars(parser.parse_args()))
    run, physics_dt, progress = args.pop("replay"), args.pop("physics_dt"), ProgressLine()
    if run is not None:
        from pace_optim.run.training_replay import replay_in_training  # as large as all of a fit

        training = RunSettings(task=args["task"] or "", identified=run, physics_dt=physics_dt)
        progress.wait_for("replaying the recordings")
        replay = replay_in_training(run, load_cfg(training) if args["task"] else None)
        progress.close()
        print(*replay.table, sep="\n")
        return
    if args["checkpoint"] is None:
        raise ValueError("--checkpoint is missing: name a model_<n>.pt or a training's folder, or a fit with --replay.")
    args["command"] = tuple(args["command"]) if args["command"] else None
    args["device"] = args["device"] or "cpu"
    if not args["viewer"]:
        progress.wait_for(f"playing {args['num_envs']} robots for {args['seconds']:g} s")
    result = play(PlaySettings(**args))
    progress.close()
    if result is not None:
        print(*str(result).split("\n"), sep="\n")
