"""Write a robot's configuration, to be edited, from its model file."""

from pathlib import Path

from pace_actuators.files import refuse_taken, write_atomically
from pace_envs.from_model.writing import configuration_text
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_control_option, add_overwrite_option


def main() -> None:
    """Read the model file, write the configuration."""
    parser = make_parser(
        "Write the configuration that a model file (MJCF or URDF) stands for as a short Python file to edit.",
        example="scripts/new_robot.py robot.urdf --output my_robot.py",
    )
    parser.add_argument("model", metavar="MODEL", help="model file, .xml or .urdf")
    parser.add_argument("--output", required=True, type=Path, metavar="FILE.py", help="Python file to write")
    add_control_option(parser)
    add_overwrite_option(parser)
    args = parser.parse_args()
    if args.output.suffix != ".py" or not args.output.stem.isidentifier():
        raise ValueError(f"--output {args.output}: expected a name that Python can import, such as my_robot.py.")
    refuse_taken([args.output], option="--output", overwrite=args.overwrite)
    text, task, cfg = configuration_text(args.model, args.output, args.control_dt)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(args.output, lambda file: file.write(text.encode()))
    for note in cfg.sim2real.notes:
        print(f"note: {note}")
    print(f"{len(cfg.sim2real.joint_order)} joints, task {args.output}:{task}")
    print(f"configuration: {args.output}")
