"""Find out which physical effect a run's model lacks."""

from pathlib import Path

import torch

from pace_optim.diagnosis import DiagnosisSettings, diagnose
from pace_optim.diagnosis.findings.text import first_line, lines_of, size_lines
from pace_optim.run.result import FitResult
from pace_optim.run.summary import error_line, next_lines, summary
from pace_optim.terminal.choices import MEASURED_FACTS
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_common_options, add_device_option, add_several, number, take_common_options
from pace_optim.terminal.progress import ProgressLine

_SHARES = {
    "fitting the base": 0.08,
    "looking for effect 1": 0.17,
    "fitting .* on windows": 0.23,
    "fitting .* on whole recordings": 0.38,
    "simulating the whole robot": 0.45,
    "trying replacements": 0.65,
    "leaving out": 0.72,
    "fitting curves": 0.75,
    "fitting the whole robot": 0.8,
}
"""Part of a diagnosis' time that has passed where a step begins: medians of 8 diagnoses of 7 robots."""


def main() -> None:
    """Parse the command line, diagnose, print the verdict and what to do next."""
    parser = make_parser(
        "Find out which physical effect a run's model lacks. It tries all known ones, judges them on recordings that "
        "were not fitted, and fits the robot with those that pay.",
        example="scripts/diagnose.py logs/pace/anymal_d/26_11_21_12-00-00",
    )
    parser.add_argument("run", metavar="RUN", help="folder of a fit")
    add_several(parser, "--effects", "NAME", "more candidates: your own as module:Class")
    parser.add_argument("--only", action="store_true", help="try nothing but --effects")
    measured = f"facts that you measured ({', '.join(MEASURED_FACTS)}): effects that contradict them are not tried"
    add_several(parser, "--measured", "FACT", measured)
    links = "do not look for wrong links of the model file first"
    parser.add_argument("--no_links", dest="links", action="store_false", help=links)
    parser.add_argument("--max_effects", type=int, default=3, metavar="K", help="most effects of a joint (default 3)")
    parser.add_argument("--physics_dt", type=number, metavar="S", help="physics step (default: half a control step)")
    refit = parser.add_mutually_exclusive_group()
    always = "fit the robot with what lowers the error although it is not what is missing (default: only with what is)"
    refit.add_argument("--refit", action="store_true", default=None, help=always)
    never = "do not fit the robot with what was found"
    refit.add_argument("--no_refit", dest="refit", action="store_false", help=never)
    add_common_options(parser, run=True)
    add_device_option(parser, needs="torch for CUDA")
    options = take_common_options(vars(parser.parse_args()))
    options["device"] = options["device"] or "cpu"

    torch.set_num_threads(1)  # many small tensors
    run_and_tell(DiagnosisSettings(**options))


def run_and_tell(settings: DiagnosisSettings) -> None:
    """Diagnose; print one line before the robot is fitted again, then that fit, the verdict and what to do next."""
    progress = ProgressLine()
    progress.expect(_SHARES)
    diagnosis = diagnose(settings, progress, on_verdict=lambda found: print(first_line(found), flush=True))
    first, last = Path(diagnosis.runs[0]), Path(diagnosis.runs[-1])
    if not first.is_absolute() and last.is_relative_to(Path.cwd()):  # as the run was named
        last = last.relative_to(Path.cwd())
    fitted, lines = FitResult.load(last), []
    if first != last:
        with_what = [*(link["link"] for link in diagnosis.links), *diagnosis.paying]
        lines = ["", f"whole robot with {' and '.join(with_what)}:", *summary(fitted)]
        lines += [error_line(FitResult.load(first), "error before, all joints"), ""]
    lines += [*lines_of(diagnosis), *size_lines(diagnosis.sizes), *next_lines(fitted, last, diagnosed=True)]
    print(*lines, f"report: {last / 'report.html'}", f"run: {last}", sep="\n")
