"""Look at a run: what was commanded, measured and simulated, and how the score fell."""

import argparse
import io
import sys
from pathlib import Path

import matplotlib
import torch
from matplotlib.figure import Figure

from pace_actuators.files import refuse_taken, write_together
from pace_optim.report.plots import plot_scores, plot_trajectories
from pace_optim.run.history import History
from pace_optim.run.open import find_mean, find_run, newest_mean, replay, run_folder
from pace_optim.run.result import FitResult
from pace_optim.run.tensors import existing, read_mean, read_trajectory
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_common_options, add_overwrite_option, take_common_options


def main() -> None:
    """Parse the command line, draw, show or save."""
    parser = make_parser(
        "Plot a run's trajectories and score: on screen, or as PNG files without a screen.",
        example="scripts/plot_trajectory.py logs/pace/anymal_d/26_01_01_12-00-00 --plot_trajectory --output plots",
    )
    parser.add_argument("run", nargs="?", metavar="RUN", help="the run's folder (default: the newest)")
    parser.add_argument("--robot_name", help="whose newest run (default: that of any robot)")
    parser.add_argument("--folder_name", help="which run (default: the newest)")
    parser.add_argument("--mean_name", help="simulate this mean of the search, as mean_020.pt, instead of the best")
    parser.add_argument("--plot_trajectory", action="store_true", help="positions and errors of every joint")
    parser.add_argument("--plot_score", action="store_true", help="score over iterations (neither: both plots)")
    parser.add_argument("--output", metavar="DIR", help="write PNG files there instead of showing windows")
    parser.add_argument("--log_dir", default="logs/pace", metavar="DIR", help="where runs are kept (default logs/pace)")
    parser.add_argument("--headless", action="store_true", help="show nothing; without --output, write to the run")
    add_overwrite_option(parser)
    add_common_options(parser, run=True)
    args = argparse.Namespace(**take_common_options(vars(parser.parse_args())))
    both = not (args.plot_trajectory or args.plot_score)

    torch.set_num_threads(1)
    run = run_folder(args.run) if args.run else find_run(args.log_dir, args.robot_name, args.folder_name)
    if args.mean_name is None and not (run / "best_trajectory.pt").exists() and (newest := newest_mean(run)):
        print(f"note: the fit has not ended, so this is {newest}, the newest so far", file=sys.stderr)
        args.mean_name = newest
    on_screen = not (args.output or args.headless) and has_display()
    if not on_screen:
        matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figures: dict[str, Figure] = {}
    types = FitResult.load(run).joint_types if (run / "result.json").exists() else ()
    title = f"{run.resolve().parent.name} · {run.name}"
    if args.plot_trajectory or both:
        if args.mean_name:
            path = find_mean(run, args.mean_name)
            mean, of = read_mean(path), path.stem
            try:
                content = replay(run, mean, args.task)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
        else:
            content, of = read_trajectory(run), "best"
        drawn = plot_trajectories(content, joint_types=types, title=f"{title} · {of}", make_figure=plt.figure)
        figures |= {stem if of == "best" else f"{stem}_{of}": figure for stem, figure in drawn.items()}
    if args.plot_score or both:
        history = History.load(existing(run / "history.json"))
        figures["score"] = plot_scores(history, joint_types=types or ("hinge",), title=title, make_figure=plt.figure)
    if on_screen:
        plt.show()
        return
    output = Path(args.output) if args.output else run
    files = {output / f"{name}.png": png(figure) for name, figure in figures.items()}
    own = [run / path.name for path in files]
    refuse_taken(files, option="--output", overwrite=args.overwrite, own=own)
    output.mkdir(parents=True, exist_ok=True)
    write_together(files)
    for path in files:
        print(f"plot: {path}")


def png(figure: Figure) -> bytes:
    """A figure as a file."""
    made = io.BytesIO()
    figure.savefig(made, format="png", dpi=110)
    return made.getvalue()


def has_display() -> bool:
    """Whether matplotlib can open windows here."""
    try:
        import matplotlib.pyplot as plt

        plt.figure()
        plt.close()
    except ImportError:
        return False
    return matplotlib.get_backend().lower() != "agg"
