"""Show a run's robot in 3-D: measured and simulated motion over each other."""

import os
import sys
import webbrowser
from pathlib import Path

from pace_actuators.files import refuse_taken
from pace_optim.report.motion import motions_of
from pace_optim.report.page import write_replay
from pace_optim.report.run_data import RunData
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_overwrite_option, number

VIEWERS = ("browser", "mujoco", "none")


def main() -> None:
    """Parse the command line, write the page, open it."""
    parser = make_parser(
        "Measured and simulated motion of a run over each other, coloured by error: play, scrub, slow motion.",
        example="scripts/replay.py logs/pace/anymal_d/26_01_01_12-00-00",
    )
    parser.add_argument("run", metavar="RUN", help="folder of a run, as fit.py prints it")
    parser.add_argument("--viewer", choices=VIEWERS, default="browser", help="where to show it (default browser)")
    parser.add_argument("--output", type=Path, metavar="FILE", help="the page (default: replay.html in RUN)")
    add_overwrite_option(parser)
    parser.add_argument("--recording", metavar="NAME", help="what MuJoCo's viewer shows (default: the worst)")
    parser.add_argument("--speed", type=number, default=1.0, help="of MuJoCo's viewer, 1 is real time")
    args = parser.parse_args()

    own = Path(args.run) / "replay.html"
    refuse_taken([args.output or own], option="--output", overwrite=args.overwrite, own=[own])
    page = write_replay(args.run, args.output)
    print(f"replay: {page}")
    if args.viewer == "browser" and not webbrowser.open(page.resolve().as_uri()):
        print("No browser could be opened here; open that file in one.")
    if args.viewer == "mujoco":
        _watch(RunData.load(Path(args.run)), args.recording, args.speed)
    print(f"run: {args.run}")


def _watch(run: RunData, recording: str | None, speed: float) -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ValueError("There is no screen to open MuJoCo's viewer on. Open the page in a browser instead.")
    if not 0 < speed <= 100:
        raise ValueError(f"--speed is {speed:g}, expected a number above 0 and up to 100.")
    from pace_optim.report.motion.motion import watch

    model = run.model()
    bias = run.result.parameters["encoder_bias"]
    motions = motions_of(model, run.joint_names, run.recordings, [bias[name] for name in run.joint_names])
    names = [motion.name for motion in motions]
    if recording is not None and recording not in names:
        raise ValueError(f"There is no recording {recording!r} in the run. Available: {', '.join(names)}.")
    watch(model, motions[names.index(recording or run.worst(1)[0].name)], speed)
