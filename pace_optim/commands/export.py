"""Write what was identified for other programs: a robot model, or the configuration of its drives."""

import sys

from pace_actuators.files import refuse_taken
from pace_optim.export import FORMATS, export
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_common_options, add_overwrite_option, take_common_options


def main() -> None:
    """Parse the command line, write, say what the format cannot hold."""
    parser = make_parser(
        "Write an identified robot for other programs: an MJCF with its drives as actuators, JSON, or configurations "
        "of its drives. These are for this project (cfg), mjlab (mjlab_native needs no code of ours), Isaac Lab and "
        "Newton.",
        example="scripts/export.py logs/pace/anymal_d/<run>/result.json --format mjcf --output anymal_d.xml",
    )
    parser.add_argument("result", metavar="FILE", help="result.json of a fit, or its run's folder")
    parser.add_argument("--format", required=True, choices=tuple(FORMATS), help="what to write")
    parser.add_argument("--joints_only", action="store_true", help="mjcf: leave the actuators as they were")
    parser.add_argument("--output", metavar="FILE", help="where (default: standard output)")
    add_overwrite_option(parser)
    add_common_options(parser, run=True)
    options = take_common_options(vars(parser.parse_args()))
    output = options["output"]
    if output is not None:
        refuse_taken([output], option="--output", overwrite=options["overwrite"])
    exported = export(options["result"], options["format"], joints_only=options["joints_only"], task=options["task"])
    if output is None:
        print(*exported.text.split("\n"), sep="\n", end="")
    else:
        exported.write(output)
    said = [*(f"warning: {each}" for each in exported.warnings), *(f"note: {each}" for each in exported.notes)]
    for line in said:  # after the text on standard output, they go where they do not mix with it
        print(line, file=sys.stdout if output else sys.stderr)
    if output is not None:
        print(f"written: {output}")
