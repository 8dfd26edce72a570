"""Make recordings with known parameters in simulation, or write the commands for a real robot."""

import sys

import torch

from pace_optim.data_collection import cfg_from_args, collect, make_collection_parser
from pace_optim.motion.design import design_table
from pace_optim.terminal.progress import ProgressLine


def main() -> None:
    """Parse the command line, make what is asked for, print where it is."""
    torch.set_num_threads(1)  # the physics takes the cores; the tensors are small
    progress = ProgressLine()
    cfg = cfg_from_args(make_collection_parser().parse_args())
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
