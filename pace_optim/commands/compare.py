"""Say where a run's model fails, and put several runs side by side."""

from pathlib import Path

import torch

from pace_optim.comparison import compare, comparison_lines
from pace_optim.run.result import FitResult
from pace_optim.run.summary import next_lines
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import (
    add_common_options,
    add_device_option,
    add_log_options,
    add_several,
    number,
    take_common_options,
)
from pace_optim.terminal.progress import ProgressLine


def main() -> None:
    """Parse the command line, compare, print what was found."""
    parser = make_parser(
        "Where the model fails: the error that noise does not explain, by frequency, speed, reversals, position, load\n"
        "and acceleration. Writes comparison.json into each run's folder and its report.html anew; several runs, base\n"
        "model first, also become the ladder of the error in the last one's.",
        example="scripts/compare.py logs/pace/anymal_d/26_01_01_12-00-00",
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="folder of a run, as fit.py prints it")
    add_several(parser, "--data", "FILE", "simulate these recordings instead")
    add_log_options(parser)
    parser.add_argument("--physics_dt", type=number, metavar="S", help="simulate at this physics step instead")
    add_common_options(parser, run=True)
    add_device_option(parser)
    options = take_common_options(vars(parser.parse_args()))

    torch.set_num_threads(1)  # the physics takes the cores; the tensors are small
    progress = ProgressLine()
    progress.wait_for("simulating the recordings, and looking for where the error lies")
    content = compare(
        options["runs"],
        options["data"],
        options["physics_dt"],
        options["task"],
        options["columns"],
        options["strict"],
        options["device"] or "cpu",
    )
    progress.close()
    print(*comparison_lines(content), sep="\n")
    run = Path(content["run"])
    print(f"report: {run / 'report.html'}")
    following = []
    if len(options["runs"]) == 1 and not options["data"] and not (run / "diagnosis.json").is_file():
        following = next_lines(FitResult.load(run), run)
    print(*following, f"run: {run}", sep="\n")
