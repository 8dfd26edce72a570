"""Make recordings with known parameters in simulation, or write the commands for a real robot."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from pace_optim.data_collection import CollectionCfg, collect
from pace_optim.data_collection.plant import library_effects, outside_effects
from pace_optim.motion.design import design_table
from pace_optim.motion.design.motion_check import MAX_SHARE_AT_LIMIT
from pace_optim.motion.signals import excitations
from pace_optim.recording import Load
from pace_optim.terminal.cli import Parser, make_parser
from pace_optim.terminal.options import (
    add_common_options,
    add_control_option,
    add_overwrite_option,
    add_paces_options,
    add_several,
    drop_paces_options,
    number,
    take_common_options,
)
from pace_optim.terminal.progress import ProgressLine


def main() -> None:
    """Parse the command line, make what is asked for, print where it is."""
    torch.set_num_threads(1)  # the physics takes the cores; the tensors are small
    progress = ProgressLine()
    cfg = _cfg_from_args(_parser().parse_args())
    progress.wait_for("writing the commands" if cfg.command_only else "simulating the recordings")
    collection = collect(cfg, progress.say)
    progress.close()
    if collection.design is not None:
        print(*design_table(collection.design), sep="\n")
    for warning in collection.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for line in collection.hidden:
        print(f"hidden: {line}")
    for kind in ("recordings", "commands", "plots"):
        for path in getattr(collection, kind):
            print(f"{kind[:-1]}: {path}")
    if collection.truth is not None:
        print(f"truth: {collection.truth}")


_CHECKS = f"""\
The motion is checked before anything is written. Targets outside the joint limits are refused (exit code 2), and so is
a motion in which a drive is at its torque limit for more than {MAX_SHARE_AT_LIMIT:.0%} of the time. Targets faster than
a drive's no-load speed, and torques that touch their limit, are warnings: the drive limits them itself. Steps have no
commanded speed, so theirs is not checked. Torques are those of the simulation, so --command_only does not check them.

The encoder reads noise and quantisation: they are recorded, and the position loop sees them. The derivative gain acts
on the true speed of the joint. dof_vel is that speed, without noise."""


def _parser() -> Parser:
    parser = make_parser(
        "Make recordings with known parameters in simulation, or write the commands for a real robot.\n\n" + _CHECKS,
        example="scripts/data_collection.py --task Pace-AnymalD-v0 --noise 1e-4 --parameter friction/LF_KFE=0.3",
    )
    kinds = "; ".join(f"{e.name}: {e.description} ({e.duration:g} s)" for e in excitations())
    add = parser.add_argument
    add_common_options(parser, required=True)
    add_control_option(parser)
    add("--output", type=Path, metavar="FILE", help=".npz, .pt or .csv (default data/<robot>/<excitation>.npz)")
    motion = parser.add_argument_group("motion")
    motion.add_argument("--excitation", default="chirp", metavar="NAME", help=f"(default chirp) {kinds}")
    motion.add_argument("--duration", type=number, metavar="S", help="of each trajectory (default: as listed above)")
    motion.add_argument("--min_frequency", type=number, default=0.1, metavar="HZ", help="of the band (default 0.1)")
    motion.add_argument("--max_frequency", type=number, default=10.0, metavar="HZ", help="of the band (default 10)")
    motion.add_argument("--seed", type=int, default=0, metavar="N", help="of the motion and the noise (default 0)")
    motion.add_argument(
        "--optimize",
        action="store_true",
        help="choose each joint's amplitude, centre, band and phases, within its limits, for the smallest error bars "
        "expected with --noise (default here 1e-4); prints them before and after",
    )
    reach = "with --optimize, width of the range of targets as a multiple of PaceCfg.excitation's (default 1)"
    motion.add_argument("--reach", type=number, default=1.0, metavar="FACTOR", help=reach)
    robot = parser.add_argument_group("simulated robot")
    truth = "true parameters of all joints or one, in place of the robot's sample_params"
    add_several(robot, "--parameter", "NAME[/JOINT]=VALUE", truth, action="extend")
    hidden = (
        "hide physical effects of a random size (by --seed) in the recordings; they are made by the independent "
        "plant, and what was hidden goes to <recording>.truth.json. Available: "
        f"{', '.join(library_effects())}; unknown to the diagnosis: {', '.join(outside_effects())}"
    )
    add_several(robot, "--effect", "NAME", hidden, action="extend")
    which = "joints that have the effects (default: all)"
    robot.add_argument("--effect_joints", default=".*", metavar="REGEX", help=which)
    robot.add_argument("--stiffness", type=number, metavar="KP", help="gain of all joints [N m/rad], noted in the file")
    robot.add_argument("--damping", type=number, metavar="KD", help="gain of all joints [N m s/rad], noted in the file")
    by_speed = "joints whose drives follow speeds: commanded in des_dof_vel (default: those whose stiffness is 0)"
    robot.add_argument("--velocity_joints", metavar="REGEX", help=by_speed)
    robot.add_argument("--delay_mode", metavar="MODE", help="command or effort: what the delay delays")
    robot.add_argument("--physics_dt", type=number, metavar="S", help="finer physics step under the same control rate")
    robot.add_argument("--load_mass", type=number, metavar="KG", help="test bench: mass at the end of the arm")
    robot.add_argument("--load_length", type=number, metavar="M", help="test bench: length of the arm")
    robot.add_argument("--arm_mass", type=number, metavar="KG", help="test bench: mass of the arm")
    add_several(robot, "--added_mass", "BODY=KG[@X,Y,Z]", "masses added to bodies", action="extend")
    encoder = parser.add_argument_group("encoder")
    encoder.add_argument(
        "--noise", type=number, default=0.0, metavar="RAD", help="standard deviation, of slides 0.1 m/rad (default 0)"
    )
    encoder.add_argument(
        "--encoder_bits", type=int, metavar="B", help="2^B steps per turn, of slides per 0.63 m (default: exact)"
    )
    files = parser.add_argument_group("files")
    add_overwrite_option(files)
    files.add_argument("--positions_only", action="store_true", help="leave dof_vel out: half the size")
    files.add_argument(
        "--export_command", type=Path, metavar="FILE.csv", help="write time and targets alone, to play on a robot"
    )
    files.add_argument("--command_only", action="store_true", help="write the commands and simulate nothing")
    files.add_argument("--plot", type=Path, metavar="FILE.png", help="default: beside the recording")
    files.add_argument("--no_plot", action="store_true", help="draw nothing")
    add_paces_options(parser)
    return parser


def _cfg_from_args(args: argparse.Namespace) -> CollectionCfg:
    """The request that parsed arguments make."""
    options = take_common_options(vars(args))
    drop_paces_options(options)
    added = options.pop("added_mass")
    load = Load(
        added_mass=_pairs("--added_mass", [word.partition("@")[0] for word in added], "BODY=KG"),
        added_mass_at=dict(_place(word) for word in added if "@" in word),
        **{key: options.pop(key) for key in ("load_mass", "load_length", "arm_mass")},
    )
    parameters = _pairs("--parameter", options.pop("parameter"), "NAME=VALUE or NAME/JOINT=VALUE")
    effects = tuple(options.pop("effect"))
    return CollectionCfg(load=load, parameters=parameters, effects=effects, **options)


def _place(word: str) -> tuple[str, tuple[float, float, float]]:
    """Body and place of BODY=KG@X,Y,Z."""
    mass, _, text = word.partition("@")
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"--added_mass {word}: expected BODY=KG@X,Y,Z with three numbers [m] in the body's frame.")
    return mass.partition("=")[0], (x, y, z)


def _pairs(option: str, words: Sequence[str], form: str) -> dict[str, float]:
    pairs: dict[str, float] = {}
    for word in words:
        name, _, text = word.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not name or not math.isfinite(value):
            raise ValueError(f"{option} {word}: expected {form} with a finite number.")
        if name in pairs:
            raise ValueError(f"{option} {name} is given twice. Give it once.")
        pairs[name] = value
    return pairs
